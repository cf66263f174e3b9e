"""Bodies, scalar coordinates and frames by name: their entries in q and u, their motions and their quantities."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._types import State
from ..system.quantities import BodyMotion, Measure, entries_along, view_of_motion
from .groups import FrameGroup
from .layout import Layout


def coordinate_names(layout: Layout, bodies: tuple[str, ...]) -> dict[str, list[int]]:
    """Indices in q by name: `x`, `y`, `angle`, `position` of planar bodies; `x`, `y`, `z`, `e0` … `e3`, `position`,
    `orientation` of spatial bodies; and names of scalar coordinates that move.
    """
    if layout.space.dimension == 3:
        fields = ["x", "y", "z", "e0", "e1", "e2", "e3"]
        groups = {"position": slice(0, 3), "orientation": slice(3, 7)}
        return _names(layout, bodies, layout.pose_index, fields, groups)
    return _names(layout, bodies, layout.pose_index, ["x", "y", "angle"], {"position": slice(0, 2)})


def rate_names(layout: Layout, bodies: tuple[str, ...]) -> dict[str, list[int]]:
    """Indices in u by name: `x_rate`, `y_rate`, `angle_rate`, `velocity` of planar bodies; `x_rate`, `y_rate`,
    `z_rate`, `wx`, `wy`, `wz`, `velocity`, `angular_velocity` of spatial bodies; and rates of scalar coordinates.
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
        count = len(fields) if rotates else layout.space.dimension
        for k in range(count):
            names[f"{body}.{fields[k]}"] = [row[k]]
        for group, where in groups.items():
            if where.stop <= count:
                names[f"{body}.{group}"] = row[where]
    scalars = zip(layout.scalars, rows[layout.bodies :], strict=True)
    return names | {f"{scalar.name}{of_scalars}": [row[0]] for scalar, row in scalars if scalar.moves}


def body_motion(layout: Layout, body: int, ys: State) -> BodyMotion:
    """The motion of one body, or its motions in a batch."""
    return _cut(layout.space.dimension, layout.rotates[body], _starts(layout, body), ys.q, ys.u)


def _starts(layout: Layout, body: int) -> np.ndarray:
    """First indices in q and u of the entries of a body or scalar coordinate; the entries are contiguous."""
    return np.array([layout.pose_index[body][0], layout.velocity_index[body][0]])


# One program for all bodies.
@functools.partial(jax.jit, static_argnums=(0, 1))
def _cut(d: int, rotates: bool, starts: Any, q: Array, u: Array) -> BodyMotion:
    entries = lambda values, start, count: lax.dynamic_slice_in_dim(values, start, count, axis=-1)
    i, j = starts
    position, velocity = entries(q, i, d), entries(u, j, d)
    if not rotates:
        return BodyMotion(position, velocity, None, None, None)
    if d == 2:
        angle, rate = (entries(values, start + 2, 1)[..., 0] for values, start in ((q, i), (u, j)))
        return BodyMotion(position, velocity, angle, None, rate)
    return BodyMotion(position, velocity, None, entries(q, i + 3, 4), entries(u, j + 3, 3))


def body_measures(layout: Layout, names: Sequence[str]) -> dict[str, Measure]:
    """The fields of `BodyMotion` of every body, `"crank.angle"`, and the accelerations of its velocities,
    `"crank.acceleration"`.
    """
    d = layout.space.dimension
    turning = () if d == 2 else (3,)
    translation = {"position": (d,), "velocity": (d,)}
    rotation = {"angle": (), "angular_velocity": ()} if d == 2 else {"orientation": (4,), "angular_velocity": turning}
    rates = {"acceleration": ("velocity", (d,)), "angular_acceleration": ("angular_velocity", turning)}
    out = {}
    for body, name in enumerate(names):
        rotates, starts = layout.rotates[body], _starts(layout, body)
        fields = translation | rotation if rotates else translation
        for field, shape in fields.items():
            out[f"{name}.{field}"] = Measure(shape, _of_body, (field, rotates, False, starts))
        for rate, (field, shape) in rates.items():
            if field in fields:
                place = field, rotates, True, starts
                out[f"{name}.{rate}"] = Measure(shape, _of_body, place, of_forces=True)
    return out


@view_of_motion
def _of_body(system, place, ts, ys, solved):
    del ts
    field, rotates, of_rate, starts = place
    # Velocities of a body are entries of u, so their rates are entries of u̇.
    u = solved.accelerations if of_rate else ys.u
    return getattr(_cut(system.layout.space.dimension, rotates, starts, ys.q, u), field)


def scalar_measures(layout: Layout) -> dict[str, Measure]:
    """Scalar coordinates that move, their rates and accelerations, `"rotor.angle"`, `"rotor.angle_rate"`."""
    out = {}
    for k, scalar in enumerate(layout.scalars, layout.bodies):
        if scalar.moves:
            i, j = _starts(layout, k)
            out[scalar.name] = Measure((), entries_along, ("q", i, ()))
            out[f"{scalar.name}_rate"] = Measure((), entries_along, ("u", j, ()))
            out[f"{scalar.name}_acceleration"] = Measure((), entries_along, ("accelerations", j, ()), of_forces=True)
    return out


def frame_measures(groups: Sequence[FrameGroup], layout: Layout) -> dict[str, Measure]:
    """The quantities of all frames, by name."""
    d = layout.space.dimension
    turning = () if d == 2 else (3,)
    at_velocities = {"position": (d,), "velocity": (d,), "angular_velocity": turning}
    at_velocities |= {"angle": ()} if d == 2 else {"orientation": (4,)}
    at_accelerations = {"acceleration": (d,), "angular_acceleration": turning, "specific_force": (d,)}
    out = {}
    for g, group in enumerate(groups):
        for k, name in enumerate(group.group.names):
            for field, shape in (at_velocities | at_accelerations | group.quantities).items():
                of_forces = field in at_accelerations
                out[f"{name}.{field}"] = Measure(shape, _of_frame, (g, field, of_forces, np.array(k)), of_forces)
    return out


@view_of_motion
def _of_frame(system, place, ts, ys, solved):
    group, field, of_forces, member = place
    frame = system.frames[group].only(member)
    single = lambda t, y, a: _fields(system, frame, t, y, a)[field]
    if of_forces:
        return jax.vmap(single)(ts, ys, solved.accelerations)
    return jax.vmap(lambda t, y: single(t, y, None))(ts, ys)


def _fields(system, frame, t, y, acceleration):
    layout = system.layout
    d = layout.space.dimension

    def rates(t, q, u):
        velocities = frame.velocities(system.kinematics(t, q, u))[0]
        return velocities[:d], velocities[2] if d == 2 else velocities[3:]

    pose = frame.poses(t, system.bodies.prepared_poses(y.q))[0]
    velocity, angular_velocity = rates(t, y.q, y.u)
    out = {"position": pose[:d], "velocity": velocity, "angular_velocity": angular_velocity}
    out |= {"angle": pose[2]} if d == 2 else {"orientation": pose[3:7]}
    if frame.quantities:
        out |= {name: x[0] for name, x in frame.measured(t, system.bodies.prepared_poses(y.q)).items()}
    if acceleration is not None:
        t = jnp.asarray(t, y.q.dtype)
        along = (jnp.ones_like(t), system.rates(t, y.q, y.u), acceleration)
        _, (linear, angular) = jax.jvp(rates, (t, y.q, y.u), along)
        gravity = system.forces.gravity
        felt = linear if gravity is None else linear - gravity
        specific = layout.space.body_direction(pose, felt)
        out |= {"acceleration": linear, "angular_acceleration": angular, "specific_force": specific}
    return out
