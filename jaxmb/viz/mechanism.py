"""A mechanism drawn at several times of its motion."""

from typing import TYPE_CHECKING

import numpy as np

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
    bodies = trajectory.system.outline(trajectory.ys)
    if not bodies:
        raise ValueError(
            f"plot_mechanism draws bodies, and a {type(trajectory.system).__name__} has none; plot_motion shows its "
            "coordinates."
        )
    times = trajectory.ts.shape[0]
    shown = np.unique(np.linspace(0, times - 1, min(frames, times)).round().astype(int))
    figure = new_figure(6.0, 6.0)
    outlines = {name: np.asarray(points) for name, points in bodies.items()}
    spatial = next(iter(outlines.values())).shape[-1] == 3
    axes = figure.add_subplot(projection="3d" if spatial else None)
    for k, (name, points) in enumerate(outlines.items()):
        color = f"C{k % 10}"
        centre = points[:, 0]
        axes.plot(*centre.T, color=color, linewidth=0.8, alpha=0.5)
        for order, time in enumerate(shown):
            fade = (order + 1) / len(shown)
            for point in points[time, 1:]:
                axes.plot(*np.stack([centre[time], point]).T, color=color, linewidth=2, alpha=fade)
            last = order == len(shown) - 1
            axes.plot(*centre[time], "o", color=color, markersize=4, alpha=fade, label=name if last else None)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(fontsize="small")
    return figure
