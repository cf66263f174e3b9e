"""Curves of a suspension over wheel travel, or over steer."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..studies.suspension import KinematicsAndCompliance
from .figure import chosen, color, draw_legend, new_figure

_DEGREES, _MM = 180 / np.pi, 1e3
# By name of the curve: label and unit, and the factor from SI units.
_CURVES = {
    "toe": ("toe, front inward [°]", _DEGREES),
    "camber": ("camber, top outward [°]", _DEGREES),
    "track": ("contact patch, outward [mm]", _MM),
    "wheelbase": ("contact patch, forward [mm]", _MM),
    "roll_centre": ("roll centre, height [mm]", _MM),
    "bump_steer": ("bump steer [°/m]", _DEGREES),
    "bump_camber": ("bump camber [°/m]", _DEGREES),
    "caster": ("caster, top rearward [°]", _DEGREES),
    "kingpin_inclination": ("kingpin, top inward [°]", _DEGREES),
    "scrub_radius": ("scrub radius [mm]", _MM),
    "caster_trail": ("caster trail [mm]", _MM),
}
_DEFAULT = ("toe", "camber", "track", "roll_centre", "motion_ratio")
# The largest number of steers that have a curve, and of panels in a row.
_STEERS, _ACROSS = 5, 3


def plot(curves: KinematicsAndCompliance, names: Sequence[str] = ()) -> Any:
    """As `KinematicsAndCompliance.plot`."""
    known = [name for name in _CURVES if getattr(curves, name) is not None]
    known += ["motion_ratio"] if curves.motion_ratio else []
    names = chosen("curve", names, known) if names else [name for name in _DEFAULT if name in known]
    travel = np.asarray(curves.travel)
    steer = None if curves.steer is None else np.asarray(curves.steer)
    if not travel.ndim and (steer is None or not steer.ndim):
        raise ValueError("plot needs several values of travel or of steer; this is one position, which print shows.")
    rows, across = -(-len(names) // _ACROSS), min(_ACROSS, len(names))
    figure = new_figure(9.0, 2.9 * rows + 0.5)
    places: Any = figure.subplots(rows, across, sharey=True, squeeze=False).ravel()
    for axes in places[len(names) :]:
        axes.remove()
    for axes, name in zip(places, names, strict=False):
        if name == "motion_ratio":
            for k, (spring, ratio) in enumerate(curves.motion_ratio.items()):
                _draw(axes, travel, steer, np.asarray(ratio), spring, k)
        else:
            _draw(axes, travel, steer, _CURVES[name][1] * np.asarray(getattr(curves, name)), "", 0)
        axes.set_xlabel(_CURVES[name][0] if name in _CURVES else "motion ratio, spring to wheel")
        axes.grid(alpha=0.3)
        axes.axhline(0.0, color="0.7", linewidth=0.8, zorder=0)
    for axes in places[: len(names) : across]:
        axes.set_ylabel("travel of the wheel, up [mm]" if travel.ndim else "steer")
    # The steers are named once, at the end of the first row, and springs above their ratios.
    draw_legend(places[across - 1])
    if "motion_ratio" in names and (steer is None or len(curves.motion_ratio) > 1):
        draw_legend(places[names.index("motion_ratio")])
    return figure


def _draw(axes, travel, steer, values, spring, first):
    """Curves upward along the travel, as suspensions are drawn, one for each of a few steers; or along the steer."""
    if steer is None or not steer.ndim or not travel.ndim:
        axes.plot(values, _MM * travel if travel.ndim else steer, color=color(first), label=spring or None)
        return
    shown = np.unique(np.linspace(0, steer.size - 1, min(steer.size, _STEERS)).round().astype(int))
    for n, k in enumerate(shown):
        label = f"{spring} steer {steer[k]:.3g}".strip().replace("-", "−")
        axes.plot(values[:, k], _MM * travel, color=color(n), linestyle="-" if first == 0 else "--", label=label)
