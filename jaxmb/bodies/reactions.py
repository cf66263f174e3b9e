"""Forces that joints, their friction, and force elements exert on their bodies."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._types import State
from ..linalg.arrays import add_up, is_traced
from ..linalg.rotations import cross
from ..parts.modes import IMPLIED, IMPLIED_STICK
from ..system.instant import Instant
from ..system.quantities import Measure, Reaction, view_of_motion
from .constraint_set import ConstraintSet
from .groups import AbstractGroup, Group

# Shares of unit rows below this are zero.
_SHARES = 1e-6
# A negative angle [rad] of rope beyond rounding.
_LIFTED = 1e-6


class Place(NamedTuple):
    """The place of a part among groups.

    **Fields:** `group`: the index of the group; `member`: the part's index in the group; `last`: the index of its last
    moving body in the part; `on_bodies`: which of its bodies are not scalar coordinates.
    """

    group: int
    member: Any
    last: int
    on_bodies: tuple[bool, ...]


def places(groups: Sequence[AbstractGroup], name: str) -> tuple[Place, ...]:
    """Places of all parts with a name: the components of a part may stand in several groups, or twice in a group."""
    numbers = ((g, k) for g, group in enumerate(groups) for k, other in enumerate(group.group.names) if other == name)
    return tuple(_place(g, k, groups[g].group) for g, k in numbers)


def _place(number: int, member: int, group: Group) -> Place:
    layout, bodies = group.layout, group.bodies[member]
    # Scalar coordinates and the ground have larger numbers than bodies.
    last = max((i for i, body in enumerate(bodies) if body < layout.bodies), default=0)
    return Place(number, np.array(member), last, tuple(layout.is_place(bodies).tolist()))


def joint_places(constraints: ConstraintSet, name: str) -> tuple[tuple[Place, ...], tuple[Place, ...]]:
    """Places of a joint's constraints among all constraints, and of its dry friction among all dry friction."""
    return places(constraints.groups, name), places(constraints.frictions, name)


def reaction_measures(system: Any, names: Sequence[str]) -> dict[str, Measure]:
    """The forces and moments of joints, the tensions of ropes, and the quantities of force elements."""
    d = system.layout.space.dimension
    fields = {"force": (d,), "moment": () if d == 2 else (3,)}
    joints = {name: joint_places(system.constraints, name) for name in names}
    of_joints = {
        f"{name}.{field}": Measure(shape, _field_of_reaction, (field, joint), of_forces=True)
        for name, joint in joints.items()
        for field, shape in fields.items()
    }
    return of_joints | _tension_measures(system) | _force_measures(system)


def _tension_measures(system) -> dict[str, Measure]:
    out = {}
    for g, group in enumerate(system.constraints.groups):
        if group.group.part.has_tension:
            # Of a rope with friction, whose constraint comes first, each side of a pulley.
            spans = group.group.part.sides
            shape = () if spans == 1 else (spans,)
            for k, name in enumerate(group.group.names):
                out[f"{name}.tension"] = Measure(
                    shape, _tension, (g, shape, np.array(k)), of_forces=True, of_spans=True
                )
    return out


def _force_measures(system) -> dict[str, Measure]:
    """The quantities that force elements have, `"blade.section_force"`."""
    guess, out = system.guess, {}
    for g, group in enumerate(system.forces.groups):
        at_guess = lambda group, q, u: group.observables(system.kinematics(jnp.zeros((), q.dtype), q, u))
        for field, values in jax.eval_shape(at_guess, group, guess.q, guess.u).items():
            for k, name in enumerate(group.group.names):
                out[f"{name}.{field}"] = Measure(values.shape[1:], _of_force, (g, field, np.array(k)))
    return out


@view_of_motion
def _of_force(system, place, ts, ys, solved):
    del solved
    number, field, member = place

    def single(t, y):
        alone = system.at(y).forces.groups[number].only(member)
        return alone.observables(system.kinematics(t, y.q, y.u))[field][0]

    return jax.vmap(single)(ts, ys)


def lifted_ropes(system: Any, motion: Any) -> list[str]:
    """A sentence for each rope that has left a pulley in a saved state of a concrete motion."""
    out = {}
    for group in (*system.constraints.groups, *system.forces.groups):
        part = group.group.part
        if not (part.has_tension and part.passed_pulleys.size):
            continue
        for name in group.group.names:
            wraps = np.asarray(motion.quantity(f"{name}.wrap"))[:, part.passed_pulleys]
            tensions = np.asarray(motion.quantity(f"{name}.tension")).reshape(len(wraps), -1)
            off = (wraps < -_LIFTED) & np.any(tensions, axis=1)[:, None]
            if np.any(off):
                k, pulley = np.argwhere(off)[0]
                out[name] = (
                    f"Rope {name!r} is off its pulley path[{part.passed_places[pulley]}] at t = "
                    f"{float(motion.ts[k]):.6g}: its angle there is {wraps[k, pulley]:.3g} rad, and it is still guided "
                    "by the pulley. Leave the pulley out, end the run by an event where the angle is zero, or in the "
                    "plane let an elastic rope leave a Pulley(..., lifts=True)."
                )
    return list(out.values())


@view_of_motion
def _tension(system, place, ts, ys, solved):
    group, shape, member = place
    if not (friction := system.constraints.groups[group]).of_poses:

        def with_friction(t, y, multipliers):
            now = system.kinematics(t, y.q, y.u)
            (reactions,) = system.constraints.reactions([friction.law], now, multipliers)
            return friction.law.tensions(now, reactions)[member]

        return jax.vmap(with_friction)(ts, ys, solved.multipliers)
    pulls = jax.vmap(lambda multipliers: system.constraints.of_groups(multipliers)[group][1][member])
    return pulls(solved.multipliers).reshape(-1, *shape)


@view_of_motion
def _field_of_reaction(system, place, ts, ys, solved):
    field, joint = place
    return getattr(reactions(system, joint, ts, ys, solved.multipliers), field)


@view_of_motion
def reactions(system: Any, place: Any, ts: Any, ys: State, multipliers: Any) -> Reaction:
    """Reactions of a joint at its `joint_places` along a motion, from the multipliers of all rows."""
    of_constraints, of_frictions = place

    def single(t, y, multipliers):
        now = system.kinematics(t, y.q, y.u)
        out = _reaction(system.constraints, of_constraints, now, multipliers)
        constraints = system.at(y).constraints
        slips = [constraints.frictions[at.group].law for at in of_frictions]
        if not slips:
            return out
        wrenches = constraints.nonideal_wrenches(slips, now, multipliers)
        return _with_slip(out, slips, of_frictions, now, wrenches)

    return jax.vmap(single)(ts, ys, multipliers)


@view_of_motion
def applied_wrenches(system: Any, place: Any, ts: Any, ys: State, multipliers: Any) -> Array:
    """Wrenches of a force element or of a non-ideal law along a motion.

    **Arguments:** `place`: its places among forces, and among laws.
    """
    of_forces, of_laws = place

    def single(t, y, multipliers):
        now = system.kinematics(t, y.q, y.u)
        if of_laws:
            constraints = system.at(y).constraints
            laws = [constraints.nonideal[at.group] for at in of_laws]
            wrenches = constraints.nonideal_wrenches(laws, now, multipliers)
            of_parts = [values[at.member] for (values, _), at in zip(wrenches, of_laws, strict=True)]
        else:
            alone = [system.at(y).forces.groups[at.group].only(at.member) for at in of_forces]
            of_parts = [group.wrenches(now)[0] for group in alone]
        # A force element may have several components.
        return add_up(values[np.array(at.on_bodies)] for values, at in zip(of_parts, of_laws or of_forces, strict=True))

    return jax.vmap(single)(ts, ys, multipliers)


def undetermined(system: Any, ts: Any, ys: State) -> tuple[str, ...]:
    """Names of the parts that share forces which the equations leave open: joints with redundant rows; and closed
    contacts, and friction that sticks, that other parts imply in a saved state of a concrete motion.
    """
    names = {name for row in system.implied for name in (row.name, *row.by)}
    if is_traced((system, ts, ys)):
        return tuple(sorted(names))
    contacts = system.contacts
    modes = np.asarray(jax.vmap(lambda q: contacts.modes(q).kinds)(ys.q))
    alone = np.repeat([IMPLIED, IMPLIED_STICK], [contacts.n, contacts.m])
    implied = modes == alone
    # One state for each choice of laws.
    states = {tuple(modes[k]): k for k in np.flatnonzero(np.any(implied, axis=1))}
    for k in states.values():
        names |= _sharing(Instant(system, ts[k], ys.q[k], ys.u[k]), implied[k])
    return tuple(sorted(names))


def _sharing(at: Instant, implied: np.ndarray) -> set[str]:
    """Names of the rows that imply the contacts and the friction that are `implied`, and of these."""
    system: Any = at.system
    contacts = system.contacts
    bound = contacts.bound(at.q)
    modes = jnp.where(implied, contacts.modes(bound).numbers, contacts.modes(at.q).numbers)
    jacobian = np.asarray(at.with_(q=contacts.with_modes(at.q, modes)).jacobian) * np.asarray(system.velocity_scale())
    sizes = np.linalg.norm(jacobian, axis=1, keepdims=True)
    jacobian = jacobian / np.maximum(sizes, np.finfo(sizes.dtype).tiny)
    rows = np.array(contacts.rows)[implied]
    others = np.setdiff1d(np.arange(len(jacobian)), rows)
    shares = np.linalg.lstsq(jacobian[others].T, jacobian[rows].T, rcond=None)[0]
    sharing = [*rows, *others[np.any(np.abs(shares) > _SHARES, axis=1)]]
    return {system.rows[k][0] for k in sharing}


def _reaction(constraints, places, now, multipliers) -> Reaction:
    """The reaction of one joint at one state."""
    of_groups = constraints.of_groups(multipliers)
    force, moment, of_joint = 0.0, 0.0, []
    for place in places:
        group, values = of_groups[place.group]
        values = values[place.member]
        wrenches = jnp.einsum("r,rkv->kv", values, group.jacobian_of(place.member, now))
        f, m = _on_last_body(group.group.only(place.member), place, now.poses, wrenches)
        force, moment = force + f, moment + m
        of_joint.append(values)
    return Reaction(jnp.asarray(force), jnp.asarray(moment), jnp.concatenate(of_joint))


def _with_slip(stick, laws, places, now, wrenches) -> Reaction:
    """The sum of the reactions of stick and of slip; one of them is zero.

    **Arguments:** `laws` and `wrenches`: for each place the group of its law, and the wrenches of the group.
    """
    force, moment = stick.force, stick.moment
    for place, law, (values, _) in zip(places, laws, wrenches, strict=True):
        f, m = _on_last_body(law.group.only(place.member), place, now.poses, values[place.member])
        force, moment = force + f, moment + m
    return Reaction(force, moment, stick.multipliers)


def _on_last_body(alone: Group, place: Place, poses: Any, wrenches: Any) -> tuple[Array, Array]:
    """Force and moment on the last moving body, for the part of a group of one."""
    space, last = alone.layout.space, place.last
    poses = alone.gather(poses)[0]
    pose, wrench = poses[last], wrenches[last]
    point = jax.tree.map(lambda leaf: leaf[0], alone.part).anchor(space, last, poses)
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
