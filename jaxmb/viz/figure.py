"""Figures of results: panels of curves with one unit, legends beside them; matplotlib is imported when needed."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..parts.names import unknown
from .solids import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The largest numbers of curves in a panel, and of panels in a column.
MOST, _STACKED = 8, 4
# The largest numbers of names in a row above a panel, and of their letters in a row as wide as the figure.
_IN_ROW, _LETTERS = 4, 116
# Of the components of a vector.
STYLES = ("-", "--", ":", "-.")
# Units that are shown with prefixes, each from its size on.
_PREFIXED = {"N": "kM", "N m": "kM", "N s": "kM", "Pa": "kMG", "W": "kM", "J": "kM", "m": "µm"}
_SIZES = {"G": 1e9, "M": 1e6, "k": 1e3, "m": 1e-3, "µ": 1e-6}
# A length is shown in metres from this size on.
_LONG = 0.1


class Curve(NamedTuple):
    """A curve of a panel; `color` and `style` as matplotlib takes them; `held`: constant between times."""

    label: str
    values: np.ndarray
    color: Any
    style: str = "-"
    held: bool = False


class Panel(NamedTuple):
    """Curves with one unit, "" for numbers without."""

    label: str
    unit: str
    curves: Sequence[Curve]


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure of a size in inches, without a window or any global state.

    **Raises:** `ImportError` that names the extra to install if matplotlib is missing.
    """
    try:
        import matplotlib.figure  # noqa: F401

        from .shown import ShownFigure
    except ImportError as error:
        raise ImportError('Figures need matplotlib; install it with: pip install "jaxmb[plot]"') from error
    return ShownFigure(figsize=(width, height), layout="constrained")


def color(k: int) -> tuple[float, ...]:
    """The colour of the k-th body of a scene, or of the k-th curve."""
    return tuple(x / 255 for x in COLORS[k % len(COLORS)])


def colors_of(names: Iterable[str], bodies: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """Colours by name: of a body and its quantities as in all pictures of its scene, of other names those that are
    left.
    """
    names = dict.fromkeys(names)
    out = {name: color(bodies.index(body)) for name in names if (body := name.split(".")[0]) in bodies}
    left = [x for x in map(color, range(len(COLORS))) if x not in out.values()] or list(map(color, range(len(COLORS))))
    others = [name for name in names if name not in out]
    return out | {name: left[k % len(left)] for k, name in enumerate(others)}


def empty_panels(count: int, xlabel: str = "t [s]") -> tuple["Figure", list["Axes"]]:
    """A figure of empty panels over one axis."""
    across = 1 if count <= _STACKED else 2
    rows = -(-count // across)
    figure = new_figure(9.0, max(3.0, 2.0 * rows + 0.5))
    names = [str(k) if k < count else "." for k in range(rows * across)]
    layout: Any = [names[k : k + across] for k in range(0, rows * across, across)]
    places = list(figure.subplot_mosaic(layout, sharex=True).values())
    places[0].locator_params(axis="x", nbins=8 if across == 1 else 5)
    for axes in places[-across:]:
        axes.set_xlabel(xlabel)
        axes.tick_params(labelbottom=True)
    return figure, places


def draw(axes: "Axes", panel: Panel, x: Any) -> float:
    """Draw a panel; returns the factor from its unit to the unit that is shown."""
    factor, unit = shown_unit(panel.unit, *(curve.values for curve in panel.curves))
    for label, values, of_curve, style, held in panel.curves:
        steps: Any = "steps-post" if held else "default"
        axes.plot(x, factor * np.asarray(values), style, color=of_curve, linewidth=1.4, label=label, drawstyle=steps)
    finish_panel(axes, with_unit(panel.label, unit))
    return factor


def finish_panel(axes: "Axes", label: str) -> None:
    """Give a panel its label, a grid and a legend."""
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    draw_legend(axes)


def draw_legend(axes: "Axes") -> None:
    """A legend that hides nothing: a few short names stand above the axes, others beside them."""
    handles, labels = axes.get_legend_handles_labels()
    place: Any = axes.get_subplotspec()
    if len(labels) <= _IN_ROW and sum(map(len, labels)) <= _LETTERS * place.get_position(axes.figure).width:
        outside = {"loc": "lower left", "bbox_to_anchor": (0.0, 0.98), "ncols": _IN_ROW, "columnspacing": 1.2}
    else:
        outside = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.03)}
    if labels:
        options: Any = {"fontsize": "small", "handlelength": 1.6, "borderaxespad": 0.2, "frameon": False}
        axes.legend(handles, labels, **options, **outside)


def shown_unit(unit: str, *values: Any) -> tuple[float, str]:
    """A factor for values, and their unit with a prefix: of large forces, moments, pressures, powers and energies, and
    of small lengths.
    """
    size = max((float(np.max(np.abs(x[np.isfinite(x)]), initial=0.0)) for x in map(np.asarray, values)), default=0.0)
    if unit == "m" and (size >= _LONG or size == 0):
        return 1.0, unit
    prefixes = [prefix for prefix in _PREFIXED.get(unit, "") if size >= _SIZES[prefix]]
    if not prefixes:
        return 1.0, unit
    return 1 / _SIZES[prefixes[-1]], prefixes[-1] + unit


def with_unit(label: str, unit: str) -> str:
    """A label with its unit."""
    return label if unit in ("", "1") else f"{label} [{unit}]"


def chosen(what: str, names: str | Sequence[str], known: Iterable[str]) -> list[str]:
    """The names that a picture shows, default all.

    **Raises:** `ValueError` with the nearest names for an unknown name.
    """
    names, known = (names,) if isinstance(names, str) else names, list(known)
    for name in names:
        if name not in known:
            raise unknown(what, name, known, "plot")
    return list(names) or known


def share_legends(places: Sequence["Axes"]) -> None:
    """Remove legends beside panels in the left of two columns where the panel to the right has the same."""
    for left, right in zip(places[::2], places[1::2], strict=False) if len(places) > _STACKED else ():
        labels, others = (axes.get_legend_handles_labels()[1] for axes in (left, right))
        if len(labels) > _IN_ROW and labels == others and (legend := left.get_legend()):
            legend.remove()


def check_single(ts: Any) -> None:
    """Raise a `ValueError` for a batch of results, from an array with one axis in a single result."""
    if np.ndim(ts) != 1:
        raise ValueError(
            f"plot shows a single result, and this is a batch of shape {np.shape(ts)[:-1]}; take a member by "
            "jax.tree.map(lambda x: x[0], batch)."
        )


def components(name: str, values: Any, of_spans: bool = False) -> list[tuple[str, np.ndarray, str]]:
    """The components of a quantity along axis 0: labels, values and styles of lines."""
    table = np.asarray(values).reshape(len(values), -1)
    words = [component(k, of_spans) if table.shape[1] > 1 else "" for k in range(table.shape[1])]
    return [(name + word, table[:, k], STYLES[k % len(STYLES)]) for k, word in enumerate(words)]


def component(k: int, of_spans: bool = False) -> str:
    """The word for a component of a vector, x, y, z or a number, or for a span of a rope."""
    return f" span {k + 1}" if of_spans else f" {'xyz'[k] if k < 3 else k + 1}"
