"""A mechanism drawn at several times of its motion."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from ..system import RigidBodySystem
from ..trajectory import Trajectory
from .figure import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_mechanism(trajectory: Trajectory, frames: int = 5) -> "Figure":
    """Draw the bodies at evenly spaced saved times, earlier ones fainter, with the paths of their mass centres.

    A body is drawn as lines from its mass centre to the points where joints and forces act on it.

    **Arguments:** `trajectory`: a motion of a planar or spatial scene; `frames`: how many poses to draw, at least 1.

    **Returns:** a matplotlib `Figure`, axes in m.

    **Raises:** `ValueError` for `frames < 1`, and for a system that has no bodies; `ImportError` without matplotlib.
    """
    if frames < 1:
        raise ValueError(f"frames must be at least 1, got {frames}.")
    system = trajectory.system
    if not isinstance(system, RigidBodySystem):
        raise ValueError(
            f"plot_mechanism draws bodies, and a {type(system).__name__} has none; plot_motion shows its coordinates."
        )
    times = trajectory.ts.shape[0]
    shown = np.unique(np.linspace(0, times - 1, min(frames, times)).round().astype(int))
    poses = jax.vmap(system.poses)(trajectory.ys.q)
    world = lambda pose, point: np.asarray(system.layout.space.point(pose, jnp.asarray(point)))
    figure = new_figure(6.0, 6.0)
    axes = figure.add_subplot(projection="3d" if system.spatial else None)
    for k, (name, points) in enumerate(zip(system.body_names, _attachments(system), strict=True)):
        centre = np.asarray(poses[:, k, : system.layout.space.dimension])
        axes.plot(*centre.T, color=f"C{k % 10}", linewidth=0.8, alpha=0.5)
        for order, time in enumerate(shown):
            fade = (order + 1) / len(shown)
            for point in points:
                axes.plot(
                    *np.stack([centre[time], world(poses[time, k], point)]).T,
                    color=f"C{k % 10}",
                    linewidth=2,
                    alpha=fade,
                )
            last = order == len(shown) - 1
            axes.plot(*centre[time], "o", color=f"C{k % 10}", markersize=4, alpha=fade, label=name if last else None)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(fontsize="small")
    return figure


def _attachments(system: RigidBodySystem) -> list[list[np.ndarray]]:
    """For every body the body-fixed points [m] of the joints and forces on it, each once."""
    points: list[dict[tuple, np.ndarray]] = [{} for _ in system.body_names]
    for group in (*system.constraints, *system.velocity_constraints, *system.forces):
        stacked = group.group
        for which, field in enumerate(("point_a", "point_b")):
            values = getattr(stacked.part, field, None)
            if values is None or stacked.body_index.shape[1] <= which:
                continue
            for body, point in zip(stacked.body_index[:, which], np.asarray(values), strict=True):
                if body < len(points):
                    points[body][tuple(np.round(point, 12))] = point
    return [list(own.values()) for own in points]
