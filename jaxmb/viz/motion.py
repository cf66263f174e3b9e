"""Time histories of a motion."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .._figure import new_figure
from .._names import unknown
from ..trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Beyond this many lines a legend hides more than it tells.
_LEGEND = 8
# A residual of exactly zero has no logarithm.
_ROUNDING = 1e-17


def plot_motion(trajectory: Trajectory, bodies: Sequence[str] | None = None) -> "Figure":
    """Plot positions or angles, velocities, energy and constraint residuals against time.

    **Arguments:** `trajectory`: a motion saved at several times; `bodies`: names of the bodies to show, default all.

    **Returns:** a matplotlib `Figure` [s; m or rad and their rates; J]: angles for rigid bodies of the plane, positions
    of the mass centres for point masses and in space. `figure.savefig(path)` writes it; in a notebook, `%matplotlib
    inline` shows it.

    **Raises:** `ValueError` for an unknown body or fewer than two times; `ImportError` without matplotlib.
    """
    names = list(trajectory.system.body_names if bodies is None else bodies)
    for name in names:
        if name not in trajectory.system.body_names:
            raise unknown("body", name, trajectory.system.body_names)
    if trajectory.ts.shape[0] < 2:
        raise ValueError("plot_motion needs a motion saved at two times or more; give simulate saveat=…")
    t = np.asarray(trajectory.ts)
    figure = new_figure(9.0, 6.0)
    (position, rate), (energy, residual) = figure.subplots(2, 2, sharex=True)
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

    energy.plot(t, trajectory.kinetic_energy, label="kinetic")
    energy.plot(t, trajectory.potential_energy, label="potential")
    energy.plot(t, trajectory.energy, "k", label="sum")
    _finish(energy, "energy [J]")
    violation = trajectory.constraint_violation
    residual.semilogy(t, np.maximum(violation.position, _ROUNDING), label="position")
    residual.semilogy(t, np.maximum(violation.velocity, _ROUNDING), label="velocity [1/s]")
    _finish(residual, "constraint residual, scaled")
    for axes in (energy, residual):
        axes.set_xlabel("t [s]")
    return figure


def _finish(axes: "Axes", label: str) -> None:
    axes.set_ylabel(label)
    axes.grid(alpha=0.3)
    if len(axes.lines) <= _LEGEND:
        axes.legend(fontsize="small")
