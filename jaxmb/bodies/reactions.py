"""Forces that joints, their friction, and force elements exert on their bodies."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.rotations import cross
from ..system.quantities import Reaction
from .groups import AbstractConstraintGroup, AbstractGroup, BodyPoses, BodyVelocities, Group, NonIdealGroup


class Place(NamedTuple):
    """Where a part with a name stands among groups: the number of its group, its number there, and as static numbers
    which of its bodies is the last one that is not the ground, and which are no scalar coordinates.
    """

    group: int
    member: Any
    last: int
    on_bodies: tuple[bool, ...]


def places(groups: Sequence[AbstractGroup], name: str) -> tuple[Place, ...]:
    """Where the parts of a name stand: the components of a part in several groups or more than once in one."""
    found = ((g, k) for g, own in enumerate(groups) for k, other in enumerate(own.group.names) if other == name)
    return tuple(_place(g, k, groups[g].group) for g, k in found)


def _place(number: int, member: int, group: Group) -> Place:
    layout, bodies = group.layout, group.bodies[member]
    # Scalar coordinates and the ground are no bodies.
    last = max((i for i, body in enumerate(bodies) if body < layout.bodies), default=0)
    return Place(number, np.array(member), last, tuple(layout.is_place(bodies).tolist()))


def reaction(
    joints: Sequence[AbstractConstraintGroup],
    places: Sequence[Place],
    t: Scalar,
    poses: BodyPoses,
    velocities: BodyVelocities,
    multipliers: Float[Array, "rows"],
) -> Reaction:
    """Reaction of one joint at one state, from the multipliers of the rows of all joints."""
    counts = [len(own.group.names) * own.rows for own in joints]
    force, moment, found = 0.0, 0.0, []
    for place in places:
        group, first = joints[place.group], sum(counts[: place.group])
        values = multipliers[first : first + counts[place.group]].reshape(-1, group.rows)[place.member]
        alone = group.only(place.member)
        wrenches = jnp.einsum("r,rkv->kv", values, alone.jacobian(t, poses, velocities)[0])
        f, m = _on_last_body(alone.group, place, poses, wrenches)
        force, moment = force + f, moment + m
        found.append(values)
    return Reaction(jnp.asarray(force), jnp.asarray(moment), jnp.concatenate(found))


def with_slip(
    stick: Reaction, laws: Sequence[NonIdealGroup], places: Sequence[Place], poses: BodyPoses, wrenches: Sequence[Array]
) -> Reaction:
    """The reaction of dry friction, that of stick and that of slip together, of which one is zero; of each place the
    group of its law, and the wrenches of this group.
    """
    force, moment = stick.force, stick.moment
    for place, law, own in zip(places, laws, wrenches, strict=True):
        f, m = _on_last_body(law.group.only(place.member), place, poses, own[place.member])
        force, moment = force + f, moment + m
    return Reaction(force, moment, stick.multipliers)


def _on_last_body(alone: Group, place: Place, poses: Any, wrenches: Any) -> tuple[Array, Array]:
    """What acts on the last body of the part of a group of one."""
    space, last = alone.layout.space, place.last
    pose, wrench = alone.gather(poses)[0, last], wrenches[last]
    point = jax.tree.map(lambda leaf: leaf[0], alone.part).anchor(last)
    if space.dimension == 2:
        force, moment = wrench[:2], wrench[2]
        if point is not None:
            arm = space.direction(pose, point)
            moment = moment - (arm[0] * force[1] - arm[1] * force[0])
        return force, moment
    force, moment = wrench[:3], space.direction(pose, wrench[3:])
    if point is not None:
        moment = moment - cross(space.direction(pose, point), force)
    return force, moment
