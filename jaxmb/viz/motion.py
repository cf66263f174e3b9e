"""Time histories of a motion."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..parts.names import names_arguments, unknown
from ..trajectory import Trajectory
from .figure import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Beyond this many lines a legend hides more than it tells.
_LEGEND = 8
# A residual of exactly zero has no logarithm.
_ROUNDING = 1e-17


@names_arguments
def plot_motion(trajectory: Trajectory, names: Sequence[str] | None = None) -> "Figure":
    """Plot positions or angles, velocities, energy and constraint residuals against time.

    **Arguments:** `trajectory`: a motion saved at several times; `names` of the bodies to show, or of the coordinates
    of a system without bodies, default all.

    **Returns:** a matplotlib `Figure` [s; m or rad and their rates; J]: angles for rigid bodies of the plane, positions
    of the mass centres for point masses and in space, or coordinates and their rates q̇. `figure.savefig(path)` writes
    it; in a notebook, `%matplotlib inline` shows it.

    **Raises:** `ValueError` for an unknown name or fewer than two times; `ImportError` without matplotlib.
    """
    system = trajectory.system
    known = system.motion_names()
    names = tuple(names or known)
    for name in names:
        if name not in known:
            raise unknown("body" if system.has_bodies else "coordinate", name, known)
    if trajectory.ts.shape[0] < 2:
        raise ValueError("plot_motion needs a motion saved at two times or more; give simulate saveat=…")
    t = np.asarray(trajectory.ts)
    figure = new_figure(9.0, 6.0)
    (position, rate), (energy, residual) = figure.subplots(2, 2, sharex=True)
    _draw(trajectory, names, position, rate)

    energy.plot(t, trajectory.kinetic_energy, label="kinetic")
    energy.plot(t, trajectory.potential_energy, label="potential")
    energy.plot(t, trajectory.energy, "k", label="sum")
    _finish(energy, "energy [J]")
    if system.velocity_rows:
        violation = trajectory.constraint_violation
        residual.semilogy(t, np.maximum(violation.position, _ROUNDING), label="position")
        residual.semilogy(t, np.maximum(violation.velocity, _ROUNDING), label="velocity [1/s]")
        _finish(residual, "constraint residual, scaled")
    else:
        residual.text(0.5, 0.5, "no constraints", transform=residual.transAxes, horizontalalignment="center")
    for axes in (energy, residual):
        axes.set_xlabel("t [s]")
    return figure


# What is drawn of a body or coordinate, the first that its system measures: quantity, its rate, their names and units.
_DRAWN = (
    (".angle", ".angular_velocity", ("angle", "angular velocity"), ("[rad]", "[rad/s]")),
    (".position", ".velocity", ("position", "velocity"), ("[m]", "[m/s]")),
    ("", ".rate", ("coordinate", "rate of the coordinate"), ("", "")),
)


def _draw(trajectory: Trajectory, names: Sequence[str], position: "Axes", rate: "Axes") -> None:
    t, known = np.asarray(trajectory.ts), trajectory.system.quantities()
    kinds = []
    for name in names:
        kinds.append(next(kind for kind in _DRAWN if name + kind[0] in known))
        for axes, field in zip((position, rate), kinds[-1][:2], strict=True):
            values = np.asarray(known[name + field].value(trajectory.ts, trajectory.ys, None))
            for k, value in enumerate(values.reshape(t.size, -1).T):
                axes.plot(t, value, label=name if values.ndim == 1 else f"{name} {'xyz'[k]}")
    _, _, labels, _ = min(kinds, key=_DRAWN.index)
    units = kinds[0][3] if len(set(kinds)) == 1 else ("", "")
    for axes, label, unit in zip((position, rate), labels, units, strict=True):
        _finish(axes, f"{label} {unit}".rstrip())


def _finish(axes: "Axes", label: str) -> None:
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    if len(axes.lines) <= _LEGEND:
        axes.legend(fontsize="small")
