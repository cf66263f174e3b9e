"""Bodies, scalar coordinates and frames by name: their entries in q and u, their motions, and quantities of these."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._types import State
from ..system.catalogue import AbstractSystem
from ..system.quantities import BodyMotion, Quantity
from .groups import FrameGroup
from .layout import Layout


def coordinate_names(layout: Layout, bodies: tuple[str, ...]) -> dict[str, list[int]]:
    """Indices in q of every name: `x`, `y`, `angle`, `position` of planar bodies; `x`, `y`, `z`, `e0` … `e3`,
    `position`, `orientation` of spatial ones; and of scalar coordinates that move.
    """
    if layout.space.dimension == 3:
        fields = ["x", "y", "z", "e0", "e1", "e2", "e3"]
        groups = {"position": slice(0, 3), "orientation": slice(3, 7)}
        return _names(layout, bodies, layout.pose_index, fields, groups)
    return _names(layout, bodies, layout.pose_index, ["x", "y", "angle"], {"position": slice(0, 2)})


def rate_names(layout: Layout, bodies: tuple[str, ...]) -> dict[str, list[int]]:
    """Indices in u of every name: `x_rate`, `y_rate`, `angle_rate`, `velocity` of planar bodies; `x_rate`, `y_rate`,
    `z_rate`, `wx`, `wy`, `wz`, `velocity`, `angular_velocity` of spatial ones; and rates of scalar coordinates.
    """
    if layout.space.dimension == 3:
        fields = ["x_rate", "y_rate", "z_rate", "wx", "wy", "wz"]
        groups = {"velocity": slice(0, 3), "angular_velocity": slice(3, 6)}
        return _names(layout, bodies, layout.velocity_index, fields, groups, "_rate")
    fields = ["x_rate", "y_rate", "angle_rate"]
    return _names(layout, bodies, layout.velocity_index, fields, {"velocity": slice(0, 2)}, "_rate")


def _names(layout, bodies, index, fields, groups, of_scalars=""):
    names = {}
    rows = index[:-1].tolist()
    for body, row, rotates in zip(bodies, rows[: layout.bodies], layout.rotates, strict=True):
        own = len(fields) if rotates else layout.space.dimension
        for k in range(own):
            names[f"{body}.{fields[k]}"] = [row[k]]
        for group, where in groups.items():
            if where.stop <= own:
                names[f"{body}.{group}"] = row[where]
    scalars = zip(layout.scalars, rows[layout.bodies :], strict=True)
    return names | {f"{own.name}{of_scalars}": [row[0]] for own, row in scalars if own.moves}


def body_motion(layout: Layout, body: int, ys: State) -> BodyMotion:
    """The motion of one body."""
    d = layout.space.dimension
    # The entries of a body are contiguous.
    return _cut(
        int(layout.pose_index[body][0]), int(layout.velocity_index[body][0]), d, layout.rotates[body], ys.q, ys.u
    )


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _cut(i: int, j: int, d: int, rotates: bool, q: Array, u: Array) -> BodyMotion:
    position, velocity = q[:, i : i + d], u[:, j : j + d]
    if not rotates:
        return BodyMotion(position, velocity, None, None, None)
    if d == 2:
        return BodyMotion(position, velocity, q[:, i + 2], None, u[:, j + 2])
    return BodyMotion(position, velocity, None, q[:, i + 3 : i + 7], u[:, j + 3 : j + 6])


def body_quantities(layout: Layout, names: Sequence[str]) -> dict[str, Quantity]:
    """The fields of `BodyMotion` of every body, `"crank.angle"`, and the accelerations of its velocities,
    `"crank.acceleration"`.
    """
    d = layout.space.dimension
    turning = () if d == 2 else (3,)
    translation = {"position": (d,), "velocity": (d,)}
    rotation = {"angle": (), "angular_velocity": ()} if d == 2 else {"orientation": (4,), "angular_velocity": turning}
    rates = {"acceleration": ("velocity", (d,)), "angular_acceleration": ("angular_velocity", turning)}

    def changing(body, field, ys, solved):
        # Velocities of a body are its own entries of u.
        return getattr(body_motion(layout, body, State(ys.q, solved.accelerations)), field)

    out = {}
    for body, name in enumerate(names):
        own = translation | rotation if layout.rotates[body] else translation
        for field, shape in own.items():
            value = lambda ts, ys, _, body=body, field=field: getattr(body_motion(layout, body, ys), field)
            out[f"{name}.{field}"] = Quantity(shape, value)
        for rate, (field, shape) in rates.items():
            if field in own:
                value = lambda ts, ys, solved, body=body, field=field: changing(body, field, ys, solved)
                out[f"{name}.{rate}"] = Quantity(shape, value, of_forces=True)
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


def frame_quantities(system: AbstractSystem, groups: Sequence[FrameGroup], layout: Layout) -> dict[str, Quantity]:
    """The quantities of all frames, by name."""
    d = layout.space.dimension
    turning = () if d == 2 else (3,)
    at_velocities = {"position": (d,), "velocity": (d,), "angular_velocity": turning}
    at_velocities |= {"angle": ()} if d == 2 else {"orientation": (4,)}
    at_accelerations = {"acceleration": (d,), "angular_acceleration": turning, "specific_force": (d,)}
    out = {}
    for g, own in enumerate(groups):
        for k, name in enumerate(own.group.names):
            for field, shape in (at_velocities | at_accelerations).items():
                of_forces = field in at_accelerations
                value = functools.partial(_along, system, g, k, field, of_forces)
                out[f"{name}.{field}"] = Quantity(shape, value, of_forces)
    return out


def _along(system, group, member, field, of_forces, ts, ys, solved):
    single = lambda t, y, a: _fields(system, group, member, t, y, a)[field]
    if of_forces:
        return jax.vmap(single)(ts, ys, solved.accelerations)
    return jax.vmap(lambda t, y: single(t, y, None))(ts, ys)


def _fields(system, group, member, t, y, acceleration):
    layout, own = system.layout, system.frames[group]
    d = layout.space.dimension

    def rates(t, q, u):
        velocities = own.velocities(t, system.prepared_poses(q), system.all_velocities(u))[member]
        return velocities[:d], velocities[2] if d == 2 else velocities[3:]

    pose = own.poses(t, system.prepared_poses(y.q))[member]
    velocity, angular_velocity = rates(t, y.q, y.u)
    out = {"position": pose[:d], "velocity": velocity, "angular_velocity": angular_velocity}
    out |= {"angle": pose[2]} if d == 2 else {"orientation": pose[3:7]}
    if acceleration is not None:
        t = jnp.asarray(t, y.q.dtype)
        along = (jnp.ones_like(t), system.rates(t, y.q, y.u), acceleration)
        _, (linear, angular) = jax.jvp(rates, (t, y.q, y.u), along)
        felt = linear if system.gravity is None else linear - system.gravity
        specific = layout.space.body_direction(pose, felt)
        out |= {"acceleration": linear, "angular_acceleration": angular, "specific_force": specific}
    return out
