"""The motion of named frames, as quantities: `"imu.position"`, `"imu.specific_force"`."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from .equation import AbstractSystem
from .groups import FrameGroup
from .layout import Layout
from .quantities import Quantity


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
