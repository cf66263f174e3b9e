"""Views of a motion by body name: the motion of bodies, and measurable quantities."""

from collections.abc import Sequence

from .._types import State
from .layout import Layout
from .quantities import BodyMotion, Quantity


def body_motion(layout: Layout, body: int, ys: State) -> BodyMotion:
    """The motion of one body."""
    d = layout.space.dimension
    # The entries of a body are contiguous.
    i, j = int(layout.pose_index[body][0]), int(layout.velocity_index[body][0])
    position, velocity = ys.q[:, i : i + d], ys.u[:, j : j + d]
    if not layout.rotates[body]:
        return BodyMotion(position, velocity, None, None, None)
    if d == 2:
        return BodyMotion(position, velocity, ys.q[:, i + 2], None, ys.u[:, j + 2])
    return BodyMotion(position, velocity, None, ys.q[:, i + 3 : i + 7], ys.u[:, j + 3 : j + 6])


def body_quantities(layout: Layout, names: Sequence[str]) -> dict[str, Quantity]:
    """The fields of `BodyMotion` of every body, `"crank.angle"`."""
    d = layout.space.dimension
    translation = {"position": (d,), "velocity": (d,)}
    rotation = {"angle": (), "angular_velocity": ()} if d == 2 else {"orientation": (4,), "angular_velocity": (3,)}
    out = {}
    for body, name in enumerate(names):
        for field, shape in (translation | rotation if layout.rotates[body] else translation).items():
            value = lambda ts, ys, _, body=body, field=field: getattr(body_motion(layout, body, ys), field)
            out[f"{name}.{field}"] = Quantity(shape, value)
    return out


def scalar_quantities(layout: Layout) -> dict[str, Quantity]:
    """Scalar coordinates that move, their rates and accelerations, `"rotor.angle"`, `"rotor.angle_rate"`."""
    out = {}
    for k, own in enumerate(layout.scalars, layout.bodies):
        if not own.moves:
            continue
        i, j = int(layout.pose_index[k][0]), int(layout.velocity_index[k][0])
        out[own.name] = Quantity((), lambda ts, ys, _, i=i: ys.q[:, i])
        out[f"{own.name}_rate"] = Quantity((), lambda ts, ys, _, j=j: ys.u[:, j])
        acceleration = lambda ts, ys, solved, j=j: solved.accelerations[:, j]
        out[f"{own.name}_acceleration"] = Quantity((), acceleration, of_forces=True)
    return out
