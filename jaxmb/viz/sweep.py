"""Results of sweeps as curves and maps."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..parts.names import names_arguments, unknown
from .figure import MOST, color, finish_panel, new_figure, shown_unit, with_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The status of a member that was computed without failure, and the ratio of values from which colours are logarithmic.
_OK, _WIDE = 1, 300.0


@names_arguments
def plot_sweep(runs: Any, name: str, *, at: Mapping[str, float] | None = None) -> "Figure":
    """Plot an output of a sweep over a grid: curves over one dimension, or a map over two.

    ```python
    jaxmb.viz.plot_sweep(runs, "angle", at={"time": 1.0})  # `runs` from `jaxmb.sweep`.
    ```

    One parameter with a dimension of the output, such as time, gives a curve for each of at most eight values; two
    parameters give a map, with logarithmic colours for positive values of several magnitudes. Members that failed are
    left out, and counted in the title.

    **Arguments:** `runs`: the `xarray.Dataset` from `sweep` or `load_sweep`; `name` of the output; `at`: values of
    dimensions that are held, each at the nearest value of the grid.

    **Returns:** a matplotlib `Figure`; units are those that `sweep` was given.

    **Raises:** `ValueError` for unknown names, and for more or fewer than one or two dimensions; `ImportError` without
    matplotlib.
    """
    if "status" not in runs:
        raise ValueError("plot_sweep shows a result of sweep or load_sweep, and this has no status of its members.")
    outputs = [key for key in runs.data_vars if key not in ("status", "message", "num_steps")]
    if name not in outputs:
        raise unknown("output", name, outputs, "plot_sweep")
    bad, held = runs["status"] != _OK, []
    values = runs[name].where(~bad)
    for dimension, number in (at or {}).items():
        if dimension not in values.dims:
            raise unknown("dimension", dimension, values.dims, "plot_sweep: at")
        values = values.sel({dimension: number}, method="nearest")
        bad = bad.sel({dimension: number}, method="nearest") if dimension in bad.dims else bad
        held.append(f"{dimension} = {_value(values[dimension])}")
    if values.ndim not in (1, 2):
        raise ValueError(
            f"plot_sweep shows one or two dimensions, and {name!r} has {', '.join(map(str, values.dims)) or 'none'}; "
            "hold some by at={dimension: value}."
        )
    is_map = values.ndim == 2 == sum(dimension in bad.dims for dimension in values.dims)
    figure = new_figure(9.0, 4.2 if is_map else 3.4)
    (_map if is_map else _curves)(figure.add_subplot(), values)
    failed = f"{int(bad.sum())} of {bad.size} members failed and are left out" if bad.any() else ""
    figure.suptitle("; ".join(filter(None, (", ".join(held), failed))), fontsize="medium")
    return figure


def _shown(values) -> tuple[np.ndarray, str]:
    """Values in the unit that is shown, and their label with it."""
    factor, unit = shown_unit(values.attrs.get("units", ""), values)
    return factor * np.asarray(values), with_unit(str(values.name), unit)


def _value(value) -> str:
    """A value of a dimension with its unit."""
    factor, unit = shown_unit(value.attrs.get("units", ""), value)
    return f"{factor * float(value):.4g} {unit}".removesuffix(" 1").strip()


def _curves(axes, values):
    """One curve, or one for each of a few values of the first dimension, along the last."""
    from matplotlib import colormaps

    x, xlabel = _shown(values[values.dims[-1]])
    table, label = _shown(values)
    if values.ndim == 1:
        axes.plot(x, table, ".-", color=color(0), markersize=4)
    else:
        first = values[values.dims[0]]
        shown = np.unique(np.linspace(0, first.size - 1, min(first.size, MOST)).round().astype(int))
        for n, k in enumerate(shown):
            of_curve = colormaps["viridis"](0.9 * n / shown.size)
            axes.plot(x, table[k], color=of_curve, label=f"{first.name} = {_value(first[k])}")
    axes.set_xlabel(xlabel)
    finish_panel(axes, label)


def _map(axes, values):
    """Colours over two dimensions, the first to the right."""
    (right, xlabel), (up, ylabel) = (_shown(values[dimension]) for dimension in values.dims)
    table, label = _shown(values)
    finite = table[np.isfinite(table)]
    norm = "log" if finite.size and finite.max() > _WIDE * finite.min() > 0 else None
    mesh = axes.pcolormesh(right, up, table.T, shading="nearest", cmap="viridis", norm=norm, rasterized=True)
    axes.figure.colorbar(mesh, ax=axes, label=label)
    axes.set(xlabel=xlabel, ylabel=ylabel)
