"""Forces that joints, their friction, and force elements exert on their bodies."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.rotations import cross
from ..system.quantities import Reaction
from .groups import AbstractConstraintGroup, BodyPoses, BodyVelocities, ForceGroup, Group, NonIdealGroup


def applied_wrenches(
    groups: Sequence[ForceGroup | NonIdealGroup], name: str, wrenches: Sequence[Float[Array, "parts k v"]]
) -> Float[Array, "bodies v"]:
    """Wrenches of one force element on its bodies, summed over its components, from those of all parts by groups."""
    own = [
        values[k, g.group.layout.is_place(g.group.bodies[k])]
        for g, values in zip(groups, wrenches, strict=True)
        for k, other in enumerate(g.group.names)
        if other == name
    ]
    return sum(own[1:], start=own[0])


def reaction(
    joints: Sequence[AbstractConstraintGroup],
    name: str,
    t: Scalar,
    poses: BodyPoses,
    velocities: BodyVelocities,
    multipliers: Float[Array, "rows"],
) -> Reaction:
    """Reaction of one joint at one state, from the multipliers of the rows of all joints."""
    row, force, moment, own = 0, 0.0, 0.0, []
    for group in joints:
        if name in group.group.names:
            k = group.group.names.index(name)
            values = multipliers[row + k * group.rows : row + (k + 1) * group.rows]
            wrenches = jnp.einsum("r,rkv->kv", values, group.jacobian(t, poses, velocities)[k])
            f, m = _on_last_body(group.group, k, poses, wrenches)
            force, moment = force + f, moment + m
            own.append(values)
        row += len(group.group.names) * group.rows
    return Reaction(jnp.asarray(force), jnp.asarray(moment), jnp.concatenate(own))


def with_slip(
    stick: Reaction, laws: Sequence[NonIdealGroup], name: str, poses: BodyPoses, wrenches: Sequence[Array]
) -> Reaction:
    """The reaction of dry friction, that of stick and that of slip together, of which one is zero."""
    force, moment = stick.force, stick.moment
    for g, values in zip(laws, wrenches, strict=True):
        k = g.group.names.index(name)
        f, m = _on_last_body(g.group, k, poses, values[k])
        force, moment = force + f, moment + m
    return Reaction(force, moment, stick.multipliers)


def _on_last_body(group: Group, k: int, poses: Any, wrenches: Any) -> tuple[Array, Array]:
    layout = group.layout
    bodies = group.bodies[k]
    # Scalar coordinates and the ground are no bodies.
    last = max(i for i, body in enumerate(bodies) if body < layout.bodies)
    pose, wrench = group.gather(poses)[k, last], wrenches[last]
    part = jax.tree.map(lambda leaf: leaf[k], group.part)
    point = part.anchor(last)
    if layout.space.dimension == 2:
        force, moment = wrench[:2], wrench[2]
        if point is not None:
            arm = layout.space.direction(pose, point)
            moment = moment - (arm[0] * force[1] - arm[1] * force[0])
        return force, moment
    force, moment = wrench[:3], layout.space.direction(pose, wrench[3:])
    if point is not None:
        moment = moment - cross(layout.space.direction(pose, point), force)
    return force, moment
