"""Forces that joints and force elements exert."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar, State
from ..linalg.rotations import cross
from . import AbstractSystem, RigidBodySystem


class Reaction(NamedTuple):
    """What a joint does to the last of its bodies that is not the ground.

    **Fields:** `force` [N], world axes; `moment` [N m] about the joint's point on that body (its mass centre where
    the joint has none), world axes, a scalar in the plane; `multipliers` of the joint's rows. The other body gets the
    opposite.
    """

    force: Float[Array, "*times d"]
    moment: Float[Array, "..."]
    multipliers: Float[Array, "*times rows"]


def joint_names(system: AbstractSystem) -> tuple[str, ...]:
    """Names of the parts that exert constraint forces."""
    return tuple(dict.fromkeys(name for name, _ in system.rows))


def force_names(system: RigidBodySystem) -> tuple[str, ...]:
    """Names of the parts that exert applied forces."""
    return tuple(dict.fromkeys(name for g in system.forces for name in g.group.names))


def applied_force(system: RigidBodySystem, name: str, t: Scalar, y: State) -> Float[Array, "bodies v"]:
    """Wrenches of one force element on its bodies, those of its components added up."""
    poses, velocities = system.prepared_poses(y.q), system.all_velocities(y.u)
    own = [
        g.wrenches(t, poses, velocities)[k]
        for g in system.forces
        for k, other in enumerate(g.group.names)
        if other == name
    ]
    return sum(own[1:], start=own[0])


def constraint_force(
    system: AbstractSystem, name: str, t: Scalar, y: State, multipliers: Float[Array, "rows"]
) -> Float[Array, "nu"]:
    """The part of `Aᵀ λ` that is of one constraint."""
    own = jnp.array([row == name for row, _ in system.rows])
    return system.constraint_force(t, y.q, y.u, jnp.where(own, multipliers, jnp.zeros_like(multipliers)))


def reaction(system: RigidBodySystem, name: str, t: Scalar, y: State, multipliers: Float[Array, "rows"]) -> Reaction:
    """Reaction of one joint at one state from the multipliers of all rows."""
    poses, velocities = system.prepared_poses(y.q), system.all_velocities(y.u)
    row, force, moment, own = 0, 0.0, 0.0, []
    for group in system.joints:
        if name in group.group.names:
            k = group.group.names.index(name)
            values = multipliers[row + k * group.rows : row + (k + 1) * group.rows]
            wrenches = jnp.einsum("r,rkv->kv", values, group.jacobian(t, poses, velocities)[k])
            f, m = _on_last_body(system, group.group, k, poses, wrenches)
            force, moment = force + f, moment + m
            own.append(values)
        row += len(group.group.names) * group.rows
    return Reaction(jnp.asarray(force), jnp.asarray(moment), jnp.concatenate(own))


def _on_last_body(system, group, k, poses, wrenches):
    bodies = group.bodies[k]
    last = max(i for i, body in enumerate(bodies) if body < system.layout.bodies)
    pose, wrench = group.own(poses)[k, last], wrenches[last]
    part = jax.tree.map(lambda leaf: leaf[k], group.part)
    point = getattr(part, "point_b" if last else "point_a", None)
    if not system.spatial:
        force, moment = wrench[:2], wrench[2]
        if point is not None:
            arm = system.layout.space.direction(pose, point)
            moment = moment - (arm[0] * force[1] - arm[1] * force[0])
        return force, moment
    force, moment = wrench[:3], system.layout.space.direction(pose, wrench[3:])
    if point is not None:
        moment = moment - cross(system.layout.space.direction(pose, point), force)
    return force, moment
