"""An optimisation: the objective along its iterations, parameters and outputs before and after."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..studies.optimise import Optimum
from .figure import chosen, color, components, empty_panels, finish_panel, new_figure, shown_unit, with_unit

# An objective that falls by more than this factor has a logarithmic axis; the largest number of parameters.
_DECADES, _MOST = 30.0, 20


def plot(best: Optimum, names: Sequence[str] = (), along: Any = None, units: Any = None) -> Any:
    """As `Optimum.plot`."""
    return _outputs(best, names, along, units or {}) if names else _progress(best)


def _progress(best) -> Any:
    """The objective and the violation of constraints along the iterations, and the parameters."""
    figure = new_figure(9.0, 4.2)
    violated = any(i.violation > 0 for i in best.iterations)
    sides: Any = figure.subfigures(1, 2, width_ratios=(1.1, 1))
    left, right = sides
    places: Any = left.subplots(1 + violated, 1, sharex=True, squeeze=False)[:, 0]
    log = [(i.number, i.objective, i.accepted) for i in best.iterations] or [(0, best.objective, True)]
    numbers, objective, accepted = (np.array(column) for column in zip(*log, strict=True))
    _draw_course(places[0], numbers, objective, accepted)
    places[0].axhline(best.objective, color="0.4", linewidth=0.8, linestyle="--")
    finish_panel(places[0], "objective")
    if violated:
        places[1].plot(numbers, [100 * i.violation for i in best.iterations], ".-", color=color(1))
        finish_panel(places[1], "violation [%]")
    places[-1].set_xlabel("iteration")
    places[-1].xaxis.get_major_locator().set_params(integer=True)
    _parameters(right.subplots(), best)
    verdict = f"objective {best.objective:.5g}: {best.message}"
    figure.suptitle(verdict if len(verdict) < 110 else verdict[:107] + "…", fontsize="medium")
    return figure


def _draw_course(axes, numbers, objective, accepted):
    """Accepted iterations as a line with dots, others as rings."""
    axes.plot(numbers[accepted], objective[accepted], "o-", color=color(0), markersize=4, label="best so far")
    if not accepted.all():
        axes.plot(numbers[~accepted], objective[~accepted], "o", color="0.6", fillstyle="none", label="tried")
    low, high = objective[accepted].min(initial=np.inf), objective[accepted].max(initial=-np.inf)
    if low > 0 and high > _DECADES * low:
        axes.set_yscale("log")


def _parameters(axes, best):
    """Parameters at start and optimum, relative to the larger of both, with their values in words."""
    rows = best.components
    change = lambda row: abs(row[2] - row[1]) / (max(abs(row[1]), abs(row[2])) or 1.0)
    kept = sorted(rows, key=change)[-_MOST:]
    shown = [row for row in rows if row in kept][::-1]
    for k, (_, a, b) in enumerate(shown):
        size = max(abs(a), abs(b)) or 1.0
        axes.plot([a / size, b / size], [k, k], color="0.75", linewidth=2, zorder=1)
        axes.plot(a / size, k, "o", color="0.55", zorder=2)
        axes.plot(b / size, k, "o", color=color(0), zorder=3)
    axes.set_yticks(range(len(shown)), [f"{name}\n{a:.4g} → {b:.4g}" for name, a, b in shown], fontsize="small")
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_xlabel("value, relative to the larger of both")
    axes.grid(alpha=0.3, axis="x")
    note = f"{len(shown)} of {len(rows)}, those that change most: " if len(shown) < len(rows) else ""
    axes.set_title(f"{note}grey: start, blue: optimum", fontsize="small", loc="left")


def _outputs(best, names, along, units) -> Any:
    """Outputs before and after, one panel each, with bounds that are the same for all components."""
    names = chosen("output", names, best.outputs)
    ((xlabel, x),) = (along or {"component": None}).items()
    figure, places = empty_panels(len(names), xlabel)
    for axes, name in zip(places, names, strict=True):
        factor, unit = shown_unit(units.get(name, ""), best.before[name], best.outputs[name])
        for label, values, of_curve in (("before", best.before[name], "0.55"), ("after", best.outputs[name], color(0))):
            tables = components(label, factor * np.atleast_1d(values))
            ticks = np.arange(np.size(tables[0][1])) if x is None else np.asarray(x)
            if ticks.shape != (count := tables[0][1].shape):
                raise ValueError(f"plot: along must have shape {count}, as {name!r} has; got {ticks.shape}.")
            for words, column, style in tables:
                axes.plot(ticks, column, style, color=of_curve, marker=None if ticks.size > 1 else "o", label=words)
        limited = [c for c in best.constraints if c.name.split("[")[0] == name]
        for bounds in ({c.low for c in limited}, {c.high for c in limited}):
            if len(bounds) == 1 and np.isfinite(bound := bounds.pop()):
                axes.axhline(factor * bound, color="black", linewidth=0.9, linestyle=":")
        finish_panel(axes, with_unit(name, unit))
    return figure
