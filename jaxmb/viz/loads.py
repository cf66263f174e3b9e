"""The loads on a body: arrows at the worst instant, and their sizes over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..studies.loads import Loads
from .figure import MOST, Curve, Panel, check_single, chosen, color, draw, new_figure, shown_unit, with_unit

# Arrows of forces, and moments, below this part of the largest are not drawn.
_SMALL = 0.05
# The longest arrow, distances of texts and the radius of arrows of moments, as parts of the body's size.
_LONGEST, _BESIDE, _LINE, _RADIUS = 0.4, 0.03, 0.07, 0.08
_BODY = "0.82"


def plot(loads: Loads, names: Sequence[str] = (), t: Any = None) -> Any:
    """As `Loads.plot`."""
    check_single(loads.ts)
    names, ts = chosen("load", names, loads.names), np.asarray(loads.ts)
    at = [loads.names.index(name) for name in names]
    forces, moments = (np.asarray(x)[:, at] for x in (loads.forces, loads.moments))
    sizes = np.linalg.norm(forces, axis=2)
    order = np.argsort(-sizes.max(axis=0), kind="stable")[:MOST]
    colors = {int(k): color(n) for n, k in enumerate(sorted(order))}
    if t is not None and not ts.min() <= float(t) <= ts.max():
        raise ValueError(f"plot: t = {float(t):g} is not between {ts.min():g} and {ts.max():g}.")
    # The largest force but for gravity and inertia, if there are others.
    acting = [k for k in range(len(at)) if loads.kinds[at[k]] not in ("gravity", "inertia")] or list(range(len(at)))
    worst = int(np.argmax(sizes[:, acting].max(axis=1)) if t is None else np.argmin(np.abs(ts - float(t))))
    points = np.asarray(loads.points)[worst, at]
    figure = new_figure(9.0, 4.2 if ts.size > 1 else 4.8)
    in_plane = not (np.any(points[:, 2]) or np.any(forces[worst, :, 2]))
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1)) if ts.size > 1 else figure.add_gridspec(1, 1)
    axes: Any = figure.add_subplot(grid[:, 0], projection=None if in_plane else "3d")
    now = names, points, forces[worst], moments[worst]
    if np.ptp(points, axis=0).max() > 0:
        _arrows(axes, now, np.asarray(loads.mass_centre), colors, 2 if in_plane else 3)
        small = len(colors) < len(names) or np.any(sizes[worst] < _SMALL * sizes[worst].max())
        note = "\nsmall loads are not drawn" if small else ""
    else:
        axes.remove()
        axes, note = figure.add_subplot(grid[:, 0]), ""
        _bars(axes, names, sizes[worst], colors)
    axes.set_title(
        f"{'largest ' * (t is None and ts.size > 1)}loads on {loads.body}, at t = {ts[worst]:.4g} s{note}",
        fontsize="medium",
    )
    if ts.size > 1:
        values = ("force", "N", sizes), ("moment", "N m", np.linalg.norm(moments, axis=2))
        for row, (label, unit, of_label) in enumerate(values):
            # The colours of the second panel are those of the first.
            label_of = lambda k, row=row: "_" if row else names[k]
            panel = Panel(label, unit, [Curve(label_of(k), of_label[:, k], colors[k]) for k in sorted(colors)])
            own = figure.add_subplot(grid[row, 1])
            draw(own, panel, ts)
            own.axvline(ts[worst], color="0.4", linewidth=0.8, linestyle="--")
            own.set_xlabel("t [s]" if row else "")
    return figure


def _arrows(axes, now, centre, colors, dimension):
    """The body as bars from its mass centre, and an arrow with name and size for each load that is not small."""
    names, points, forces, moments = now
    points, centre = points[:, :dimension], centre[:dimension]
    for point in points:
        axes.plot(*np.stack([centre, point]).T, color=_BODY, linewidth=9, solid_capstyle="round", zorder=1)
    extent, sizes = float(np.ptp(points, axis=0).max()), np.linalg.norm(forces, axis=1)
    (per_force, force_unit), (per_moment, moment_unit) = shown_unit("N", sizes), shown_unit("N m", moments)
    least = _SMALL * max(float(np.linalg.norm(moments, axis=1).max()), float(sizes.max()) * extent * _SMALL)
    written: list[np.ndarray] = []
    for k in sorted(colors, key=lambda k: -sizes[k]):
        turn = float(np.linalg.norm(moments[k]))
        if sizes[k] < _SMALL * sizes.max() and turn < least:
            continue
        way = forces[k, :dimension] * _LONGEST * extent / max(sizes.max(), np.finfo(float).tiny)
        text = f"{names[k]} {per_force * sizes[k]:.3g} {force_unit}"
        if turn >= least:
            text += f", {per_moment * (moments[k, 2] if dimension == 2 else turn):.3g} {moment_unit}".replace("-", "−")
        axes.plot(*points[k], "o", color=colors[k], markersize=5, zorder=4)
        end = points[k] + way
        if dimension == 2 and turn >= least:
            _turning(axes, points[k], _RADIUS * extent, moments[k, 2], way, colors[k])
        if dimension == 3:
            axes.quiver(*points[k], *way, color=colors[k], linewidth=2, arrow_length_ratio=0.2)
            axes.text(*end, text, color=colors[k], fontsize="small")
            continue
        arrow = {"arrowstyle": "-|>", "color": colors[k], "lw": 2, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 14}
        axes.annotate("", end, points[k], arrowprops=arrow, zorder=3)
        place = end + _BESIDE * extent * way / max(float(np.linalg.norm(way)), np.finfo(float).tiny)
        while any(abs(place - other)[0] < 0.4 * extent and abs(place - other)[1] < _LINE * extent for other in written):
            place = place + np.array([0.0, _LINE * extent * (1 if way[1] >= 0 else -1)])
        written.append(place)
        sides = {"ha": "left" if way[0] >= 0 else "right", "va": "bottom" if way[1] >= 0 else "top"}
        axes.text(*place, text, color=colors[k], fontsize="small", zorder=6, **sides)
        axes.update_datalim([end, place + np.array([0.35 * extent * (1 if way[0] >= 0 else -1), 0.0])])
    axes.autoscale_view()
    axes.margins(0.08)
    axes.set_aspect("equal", **({"adjustable": "datalim"} if dimension == 2 else {}))
    axes.set(xlabel="x of the body [m]", ylabel="y of the body [m]")
    axes.grid(alpha=0.3)
    if dimension == 3:
        axes.set_zlabel("z of the body [m]")


def _turning(axes, point, radius, moment, way, color):
    """An arrow around a point, in the sense of a moment in the plane, that leaves out the direction of the force."""
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path

    around = np.arctan2(way[1], way[0]) + np.radians(np.linspace(40.0, 320.0, 40))[:: 1 if moment > 0 else -1]
    corners = point + radius * np.column_stack([np.cos(around), np.sin(around)])
    arrow = {"arrowstyle": "-|>", "color": color, "lw": 1.6, "fill": True, "mutation_scale": 14}
    axes.add_patch(FancyArrowPatch(path=Path(corners), zorder=3, **arrow))
    axes.update_datalim(corners)


def _bars(axes, names, sizes, colors):
    """The sizes of the forces, where all act at one point."""
    factor, unit = shown_unit("N", sizes)
    shown = sorted(colors, key=lambda k: sizes[k])
    axes.barh([names[k] for k in shown], factor * sizes[shown], color=[colors[k] for k in shown])
    axes.set_xlabel(with_unit("force", unit))
    axes.grid(alpha=0.3, axis="x")
