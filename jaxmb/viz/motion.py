"""Time histories of a motion."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..parts.names import unknown
from ..system import RigidBodySystem
from ..trajectory import Trajectory
from .figure import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Beyond this many lines a legend hides more than it tells.
_LEGEND = 8
# A residual of exactly zero has no logarithm.
_ROUNDING = 1e-17


def plot_motion(trajectory: Trajectory, names: Sequence[str] | None = None) -> "Figure":
    """Plot positions or angles, velocities, energy and constraint residuals against time.

    **Arguments:** `trajectory`: a motion saved at several times; `names` of the bodies to show, or of the coordinates
    of a system that has no bodies, default all.

    **Returns:** a matplotlib `Figure` [s; m or rad and their rates; J]: angles for rigid bodies of the plane, positions
    of the mass centres for point masses and in space, or coordinates and their rates q̇. `figure.savefig(path)` writes
    it; in a notebook, `%matplotlib inline` shows it.

    **Raises:** `ValueError` for an unknown name or fewer than two times; `ImportError` without matplotlib.
    """
    system = trajectory.system
    bodies = isinstance(system, RigidBodySystem)
    known = tuple(system.body_names if bodies else system.coordinate_names())
    names = known if names is None else tuple(names)
    for name in names:
        if name not in known:
            raise unknown("body" if bodies else "coordinate", name, known)
    if trajectory.ts.shape[0] < 2:
        raise ValueError("plot_motion needs a motion saved at two times or more; give simulate saveat=…")
    t = np.asarray(trajectory.ts)
    figure = new_figure(9.0, 6.0)
    (position, rate), (energy, residual) = figure.subplots(2, 2, sharex=True)
    (_draw_bodies if bodies else _draw_coordinates)(trajectory, names, position, rate)

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


def _draw_bodies(trajectory: Trajectory, names: Sequence[str], position: "Axes", rate: "Axes") -> None:
    t = np.asarray(trajectory.ts)
    angles = [name for name in names if trajectory[name].angle is not None]
    for name in names:
        motion = trajectory[name]
        if motion.angle is not None:
            position.plot(t, motion.angle, label=name)
            rate.plot(t, motion.angular_velocity, label=name)
        else:
            for k, axis in enumerate("xyz"[: motion.position.shape[1]]):
                position.plot(t, motion.position[:, k], label=f"{name} {axis}")
                rate.plot(t, motion.velocity[:, k], label=f"{name} {axis}")
    units = ("[rad]", "[rad/s]") if len(angles) == len(names) else ("[m]", "[m/s]") if not angles else ("", "")
    _finish(position, f"angle {units[0]}" if angles else f"position {units[0]}")
    _finish(rate, f"angular velocity {units[1]}" if angles else f"velocity {units[1]}")


def _draw_coordinates(trajectory: Trajectory, names: Sequence[str], position: "Axes", rate: "Axes") -> None:
    index, rates = trajectory.system.coordinate_names(), np.asarray(trajectory.rates)
    for name in names:
        position.plot(trajectory.ts, trajectory[name], label=name)
        rate.plot(trajectory.ts, rates[:, index[name][0]], label=name)
    _finish(position, "coordinate")
    _finish(rate, "rate of the coordinate")


def _finish(axes: "Axes", label: str) -> None:
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    if len(axes.lines) <= _LEGEND:
        axes.legend(fontsize="small")
