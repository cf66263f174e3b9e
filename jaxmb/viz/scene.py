"""A scene drawn before it moves: bodies and joints with their names, and joints that do not close."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .._types import State
from ..bodies.scene import Scene, as_given
from ..parts.names import unknown
from ..parts.shapes import AbstractShape
from ..simulate.arguments import checked_state
from ..system import AbstractSystem
from ..trajectory import picture_of, still
from .figure import color as color_of
from .mechanism import drawn, finish, flat, in_world
from .motion_nodes import check_shapes
from .placed_names import Name, place_names
from .solids import solids

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Joints are open from this residual on, relative to the system's size.
_OPEN = 1e-6
# Largest numbers of names in a picture, and of open joints in its title.
_NAMES, _TITLE = 30, 3
_RED = (0.8, 0.05, 0.1)


def plot_scene(
    scene: Scene | AbstractSystem,
    state: State | None = None,
    *,
    shapes: Mapping[str, AbstractShape | Sequence[AbstractShape]] | None = None,
    names: Sequence[str] | None = None,
    t: float = 0.0,
) -> "Figure":
    """Draw a scene with the names of its bodies and joints, before it is compiled, assembled or moved.

    ```python
    scene = jaxmb.mechanisms.get("four_bar").scene
    jaxmb.viz.plot_scene(scene)  # At the poses given with the bodies.
    jaxmb.viz.plot_scene(system, state)
    ```

    Points of a joint that do not meet are joined by a red line with their distance: where `compile` or `assemble`
    fails, the picture shows which joint is open.

    **Arguments:** `scene`: a `Scene`, at the poses given with its bodies, or a compiled system; `state` of a system,
    default the poses found when it was compiled; `shapes` as in `show`; `names`: the bodies and joints whose names are
    written, default all, up to 30; open joints have theirs; `t`: the time, for driven joints [s].

    **Returns:** a matplotlib `Figure`, axes in m, which a notebook's cell shows.

    **Raises:** `ValueError` for a state without a system, a system without bodies, and unknown bodies or joints;
    `ImportError` without matplotlib.
    """
    # A concrete class, since there is one kind of scene, and it has no state.
    if isinstance(scene, Scene):
        if state is not None:
            raise ValueError("plot_scene draws a Scene at the poses of its bodies; a state needs a compiled system.")
        system: Any = as_given(scene)
    elif isinstance(scene, AbstractSystem):
        system = scene
    else:
        raise ValueError(f"plot_scene draws a Scene or a compiled system, got a {type(scene).__name__}.")
    if not system.body_names:
        raise ValueError(f"plot_scene draws bodies, and a {type(system).__name__} has none.")
    y: Any = system.guess if state is None else checked_state(system, state)
    check_shapes(system, shapes or {})
    picture = picture_of(still(system, y, t))
    placed = solids(picture, shapes or {}, None)
    figure, axes = drawn(picture, placed, [0])
    dimension, written = 2 if picture.planar else 3, []
    bodies = picture.bodies
    joints = {name: part for name, part in picture.parts.items() if any(x is not None for x in part.points)}
    known = [*bodies, *joints]
    if names is None:
        names = known if len(known) <= _NAMES else bodies if len(bodies) <= _NAMES else []
        marked = list(joints)
    else:
        marked = names
    for name in names:
        if name not in known:
            raise unknown("body or joint", name, known, "plot_scene")
    for k, name in enumerate(bodies):
        color, place = color_of(k), picture.positions[name][0, :dimension]
        axes.plot(*place, "o", color=color, markersize=4, zorder=4)
        if name in names:
            written.append(Name(name, place, 1, {"color": color, "weight": "bold"}))
    residuals = _residuals(system, t, y)
    least = _OPEN * float(system.length)
    largest = {name: float(np.max(np.abs(values))) for name, values in residuals.items()}
    for name, part in joints.items():
        points = [
            in_world(picture, body, point[None], 0)[0, :dimension]
            for body, point in zip(part.bodies, part.points, strict=True)
            if point is not None
        ]
        is_open = largest.get(name, 0.0) > least
        if not (is_open or name in marked):
            continue
        for point in points:
            axes.plot(*point, "o", color=_RED if is_open else "black", markerfacecolor="white", markersize=5, zorder=5)
        text = name
        if is_open:
            gap, text = points[-1] - points[0], f"{name}: off by {largest[name]:.3g}"
            # The first rows of joints whose points meet are the distances of these points.
            unmet = np.linalg.norm(residuals[name][:dimension])
            if unmet > least and np.isclose(unmet, np.linalg.norm(gap), atol=least):
                largest[name] = float(np.linalg.norm(gap))
                text = f"{name}: {largest[name]:.3g} m apart"
                axes.plot(*np.stack([points[0], points[-1]]).T, color=_RED, linewidth=2, zorder=6)
        if is_open or name in names:
            written.append(Name(text, np.mean(points, axis=0), -1, {"color": _RED if is_open else "0.25"}))
    title, style = _title(largest, least)
    finish(figure, axes, picture, placed, title, **style)
    if not picture.planar:
        written = [name._replace(place=flat(axes, name.place)) for name in written]
    place_names(figure, axes, written)
    return figure


def _residuals(system, t, state):
    """The residuals [m, rad] of each joint."""
    out: dict[str, list[float]] = {}
    values = np.asarray(system.position_residual(np.asarray(t, state.q.dtype), state.q))
    for (name, _), value in zip(system.rows, values, strict=False):
        out.setdefault(name, []).append(float(value))
    return out


def _title(largest, least) -> tuple[str, dict[str, Any]]:
    """Words that say whether all joints close, from their gaps or largest residuals, and their style."""
    unmet = sorted((name for name, x in largest.items() if x > least), key=largest.__getitem__, reverse=True)
    if unmet:
        named = ", ".join(f"{name} by {largest[name]:.3g}" for name in unmet[:_TITLE])
        more = f" and {len(unmet) - _TITLE} more" if len(unmet) > _TITLE else ""
        return f"open joints [m, rad]: {named}{more}", {"color": _RED}
    return "all joints are closed" if largest else "", {}
