"""A mechanism drawn at several times of its motion."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from .._arguments import whole_number
from .._types import State
from ..linalg.rotations import rotation_matrix
from ..parts.base import GROUND
from ..parts.shapes import DARK, GROUND as GROUND_COLOR, AbstractShape, Color
from ..studies.inverse import RequiredForces
from ..system import AbstractSystem
from ..system.picture import Picture
from ..trajectory import Trajectory, picture_of
from .figure import color as color_of, new_figure
from .meshes import heights
from .motion_nodes import check_shapes
from .one_motion import check_finite, one_motion, poses_of
from .silhouettes import area, faces, size, strip, stroke
from .solids import Placed, color_in, solids

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Largest number of bodies with a legend and paths.
_FEW = 8
# Largest number of times in a title.
_TIMES = 6
# The least width of a picture, relative to its height, and the other way round.
_THIN = np.array([0.4, 0.2])
# A machine in space is in one plane if it is this thin, relative to its size.
_FLAT = 0.1
_EDGE: Color = (40, 40, 40)
# In space: the direction of the light, the brightness of faces along it, and the opacity of joints and of the ground.
_LIGHT, _DIM, _CLEAR = np.array([0.4, -0.7, 0.6]), 0.65, 0.25
# Between the vertical axis of space and its numbers [points].
_OFF = 14.0
# Of a figure in space, in inches: the margin, the height of a title, and the largest height of the axes.
_PAD, _TITLE, _HIGHEST = 0.12, 0.35, 6.0


def plot_mechanism(
    trajectory: Trajectory | RequiredForces | State | list[State],
    frames: int = 5,
    *,
    shapes: Mapping[str, AbstractShape | Sequence[AbstractShape]] | None = None,
    system: AbstractSystem | None = None,
    deformation: float = 1.0,
) -> "Figure":
    """Draw the bodies at evenly spaced saved times, fainter at earlier times, with the paths of their mass centres; or
    at states.

    ```python
    jaxmb.viz.plot_mechanism(motion, frames=4).savefig("poses.png")
    jaxmb.viz.plot_mechanism([state, motion.end], system=system)
    ```

    Bodies are drawn as in `show`: in the shapes of their parts, such as wheels, and as bars from the mass centre to the
    points where parts act; in space the blocks of joints and of the ground are clear. Springs, rods and tracks are
    drawn between their points, and in the plane the terrain. Up to 8 bodies have paths, along a motion, and a legend.

    **Arguments:** `trajectory`: a motion, also from `required_forces`, or a `State` or a list of states, with their
    `system`; `frames`: the number of poses of a motion, at least 1; `shapes` as in `show`; `deformation`: the factor by
    which deformations of elastic bars and bodies are magnified, from the chord of a bar that a joint holds at another
    point than its origin.

    **Returns:** a matplotlib `Figure`, axes in m, which a notebook's cell shows. Times that a run did not reach are
    left out.

    **Raises:** `ValueError` for `frames < 1`, unknown bodies, a batch, states that are not finite, and a system without
    bodies; `ImportError` without matplotlib.
    """
    # A state has no time.
    several = isinstance(trajectory, list)
    timed = not isinstance(trajectory, State | list)
    frames = len(trajectory) if several else whole_number("frames", frames)
    trajectory = poses_of(trajectory, system)
    if not trajectory.system.body_names:
        raise ValueError(
            f"plot_mechanism draws bodies, and a {type(trajectory.system).__name__} has none; plot_motion shows its "
            "coordinates."
        )
    trajectory = one_motion(trajectory, "plot_mechanism", 1)
    check_finite(trajectory)
    check_shapes(trajectory.system, shapes or {})
    picture = picture_of(trajectory, deformation)
    placed = solids(picture, shapes or {}, None)
    times = trajectory.ts.shape[0]
    shown = np.unique(np.linspace(0, times - 1, min(frames, times)).round().astype(int))
    figure, axes = drawn(picture, placed, shown.tolist())
    if len(picture.bodies) <= _FEW:
        for k, name in enumerate(picture.bodies):
            path, color = picture.positions[name][:, : 2 if picture.planar else 3], color_of(k)
            if shapes and name in shapes:
                # Given shapes may have colours.
                color = next((faded(shape.color, 1.0) for body, shape in placed if body == name), color)
            if not several:
                axes.plot(*path.T, color=color, linewidth=0.8, alpha=0.6, zorder=1)
            axes.plot(*path[-1], "o", color=color, markersize=4, zorder=4, label=name)
        figure.legend(loc="outside right upper", fontsize="small")
    instants = ", ".join(f"{trajectory.ts[k]:.3g}" for k in shown)
    title = f"t = {instants} s" if timed and len(shown) <= _TIMES else ""
    finish(figure, axes, picture, placed, "  ·  ".join(filter(None, [title, *picture.notes])))
    return figure


def drawn(picture: Picture, shapes: Sequence[Placed], shown: Sequence[int]) -> tuple[Any, Any]:
    """A figure and its axes, with bodies, springs and tracks at the `shown` times, fainter at earlier times."""
    figure = new_figure(8.0, 6.0)
    axes: Any = figure.add_subplot(projection=None if picture.planar else "3d")
    # Objects on the ground are drawn once.
    of_ground = [placed for placed in shapes if placed[0] == GROUND and placed[1].primitive != "ground"]
    moving = [placed for placed in shapes if placed[0] != GROUND]
    fades = [(order + 1) / len(shown) for order in range(len(shown))]
    poses = [(of_ground, 0, 1.0), *((moving, time, fade) for time, fade in zip(shown, fades, strict=True))]
    if picture.planar:
        for pose in poses:
            _draw_areas(axes, picture, *pose)
    else:
        _draw_faces(axes, picture, poses)
    for time, fade in zip(shown, fades, strict=True):
        _draw_paths(axes, picture, time, fade)
    return figure, axes


def finish(figure: Any, axes: Any, picture: Picture, shapes: Sequence[Placed], title: str, **style: Any) -> None:
    """Draw the terrain, and give the axes labels, equal scales and a title; upwards is up in space, too."""
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    style = {"fontsize": "medium", **style}
    if picture.planar:
        for ground in [shape for _, shape in shapes if shape.primitive == "ground"]:
            _draw_ground(axes, ground)
        limits = np.array([axes.get_xlim(), axes.get_ylim()])
        # Labels need room beside a machine in one line.
        size, middle = np.ptp(limits, axis=1), np.mean(limits, axis=1)
        half = np.maximum(size, _THIN * size.max()) / 2
        axes.set(**{name: (x - h, x + h) for name, x, h in zip(("xlim", "ylim"), middle, half, strict=True)})
        figure.set_figheight(float(np.clip(6.5 * half[1] / half[0] + 1.0, 2.2, 6.5)))
        axes.set_title(title, **style)
    else:
        upright = int(np.argmax(np.abs(picture.up)))
        axes.view_init(vertical_axis="xyz"[upright], **front_view(axes, picture.up))
        axes.set(zlabel="z [m]", aspect="equal")
        sizes = np.ptp([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()], axis=1)
        # The signs of numbers stand clear of the axis. Their distances are relative to the other sides.
        axes.tick_params(axis="xyz"[upright], pad=_OFF * sizes.max() / np.delete(sizes, upright).max() - 8.0)
        for k, name in enumerate("xyz"):
            axes.locator_params(axis=name, nbins=max(1, round(8 * sizes[k] / sizes.max())), min_n_ticks=1)
            # A label stands beyond the numbers at thin boxes, too.
            far = 24.0 if k == upright else 13.5
            getattr(axes, f"{name}axis").labelpad = far * sizes.max() / np.delete(sizes, k).max() - 9.5
        _fill(figure, axes, title, style)


def front_view(axes: Any, up: Float[np.ndarray, "3"]) -> dict[str, float]:
    """The angles [°] to look at a machine in an upright plane nearly from its front; none for another machine."""
    sizes = np.ptp([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()], axis=1)
    upright = int(np.argmax(np.abs(up)))
    level = [(upright + 1) % 3, (upright + 2) % 3]
    thin = int(np.argmin(sizes[level]))
    if sizes[level[thin]] > _FLAT * sizes.max():
        return {}
    return {"elev": 12.0, "azim": (20.0, 290.0)[thin]}


def _fill(figure, axes, title, style):
    """Let the box of axes in space with its labels fill a figure that is as high as they need."""
    axes.set_in_layout(False)
    legends = [legend.get_window_extent().width / figure.dpi + _PAD for legend in figure.legends]
    width, side = figure.get_figwidth() - 2 * _PAD - max(legends, default=0.0), figure.get_figheight()
    fits = lambda box: min(width / (box[2] - box[0]), _HIGHEST / (box[3] - box[1]))
    side *= fits(_extents(figure, axes, side))
    # Words do not grow with the box: a second look.
    box = _extents(figure, axes, side)
    side, (left, low, right, high) = side * fits(box), fits(box) * box
    figure.set_figheight(high - low + 2 * _PAD + _TITLE)
    size = figure.get_size_inches()
    place = np.array([_PAD + 0.5 * (width - (right - left)) - left, _PAD - low])
    axes.set_position([*(place / size), *(side / size)])
    # The title stands above the box, and in the middle of it.
    x, y = (_PAD + 0.5 * width - place[0]) / side, (_PAD + high - low + 0.1 - place[1]) / side
    axes.set_title(title, y=y, **style).set_position((x, y))


def _extents(figure, axes, side):
    """The least x and y, and the largest ones, of the box with its labels [in], if the axes are as wide as `side`."""
    from matplotlib.transforms import Bbox

    axes.set_position([0.0, 0.0, *(side / figure.get_size_inches())])
    figure.draw_without_rendering()
    # The box reaches beyond the limits of its axes.
    limits = [x + np.ptp(x) / 24 * np.array([-1, 1]) for x in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    corners = axes.transData.transform(flat(axes, np.reshape(np.meshgrid(*limits), (3, -1))))
    seen = Bbox([corners.min(axis=0), corners.max(axis=0)])
    labels = [axis.get_tightbbox() for axis in (axes.xaxis, axes.yaxis, axes.zaxis)]
    return np.array(Bbox.union([seen, *labels]).extents) / figure.dpi


def _draw_areas(axes, picture, shapes, time, fade):
    areas = [(in_world(picture, body, area(shape), time), shape.color) for body, shape in shapes]
    # From the back to the front; of one depth, small areas before large ones.
    order = lambda polygon: (round(polygon[0][0, 2] / picture.width, 3), -size(polygon[0]))
    for corners, color in sorted(areas, key=order):
        axes.fill(
            *corners[:, :2].T, facecolor=faded(color, fade), edgecolor=faded(_EDGE, fade), linewidth=0.4, zorder=2
        )


def _draw_faces(axes, picture, poses):
    """All faces of all times, of which the nearer ones hide the others; blocks of joints and of the ground let them be
    seen.
    """
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    polygons, colors, rims = [], [], []
    for shapes, time, fade in poses:
        for body, shape in shapes:
            own = faces(shape)
            corners = in_world(picture, body, own.reshape(-1, 3), time).reshape(own.shape)
            normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
            size = np.linalg.norm(normals, axis=1)
            bright = np.abs(normals @ _LIGHT) / np.where(size > 0, size, 1.0)
            shades = np.array(faded(shape.color, fade)) * (_DIM + (1 - _DIM) * bright[:, None])
            opacity = np.full((len(own), 1), _CLEAR if body == GROUND or shape.color == DARK else 1.0)
            polygons.append(corners)
            colors.append(np.hstack([shades, opacity]))
            # Of round shapes only the light shows the faces.
            rims.append(np.broadcast_to(faded(_EDGE, fade), shades.shape) if shape.primitive == "box" else shades)
    if polygons:
        polygons, colors, rims = map(np.concatenate, (polygons, colors, rims))
        axes.add_collection3d(Poly3DCollection(polygons, facecolors=colors, edgecolors=rims, linewidths=0.4))
        axes.auto_scale_xyz(*polygons.reshape(-1, 3).T)


def _draw_paths(axes, picture, time, fade):
    for name, line in picture.paths.items():
        color = faded(color_in(picture, name), fade)
        if line.kind == "bar" and picture.planar:
            for corners in strip(line.points[time], picture.width):
                axes.fill(*corners.T, color=color, linewidth=0.6, zorder=2)
            continue
        points = stroke(line, time, picture.width)[:, : 2 if picture.planar else 3]
        axes.plot(*points.T, color=color, linewidth=1.0 if line.kind in ("rod", "coil") else 2.0, zorder=2)


def _draw_ground(axes, ground):
    """The ground as far as the picture reaches."""
    low, high = axes.get_xlim()
    x = np.linspace(low, high, 400)
    profile = np.stack([x - ground.position[0], heights(ground, (x - ground.position[0])[:, None]), 0 * x], axis=1)
    line = ground.position + profile @ rotation_matrix(ground.orientation).T
    bottom = min(axes.get_ylim()[0], float(line[:, 1].min()) - 0.02 * (high - low))
    axes.fill_between(line[:, 0], line[:, 1], bottom, color=faded(GROUND_COLOR, 1.0), linewidth=0, zorder=1)
    # Its edge is visible on wheels that hide a bump.
    axes.plot(*line[:, :2].T, color=faded(_EDGE, 1.0), linewidth=1.0, zorder=3)
    axes.set(xlim=(low, high), ylim=(bottom, axes.get_ylim()[1]))


def flat(axes: Any, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "n 2"]:
    """Points of axes in space, as the figure shows them."""
    from mpl_toolkits.mplot3d.proj3d import proj_transform

    x, y, z = points
    return np.stack(proj_transform(x, y, z, axes.get_proj())[:2], axis=-1)


def in_world(picture: Picture, body: str, points: Float[np.ndarray, "n 3"], time: int) -> Float[np.ndarray, "n 3"]:
    """The places of points of a body at a time."""
    return picture.positions[body][time] + points @ rotation_matrix(picture.orientations[body][time]).T


def faded(color: Color, share: float) -> tuple[float, ...]:
    """A colour of matplotlib, mixed with white."""
    return tuple(1 - share * (1 - np.array(color) / 255))
