"""The actuators of a machine by name, and the machine without their drives and forces."""

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...bodies.groups import together
from ...parts.coordinate_parts import AbstractCoordinatePart
from ...parts.drivers import AbstractDriver
from ...parts.names import unknown
from ...system import AbstractSystem, parameters, with_parameters
from ...system.equation import Ranks
from ...system.instant import Instant
from ...system.quantities import rates_of


class Place(NamedTuple):
    """The place of a part in a system: a field of the system, a field of this set, the number of the group there, the
    part's number in it, and the part's name.
    """

    path: str
    kind: str
    number: int
    member: int
    name: str

    def group(self, system: Any) -> Any:
        """The group of the part."""
        return getattr(getattr(system, self.path), self.kind)[self.number]


class Drive(NamedTuple):
    """An actuator.

    **Fields:** its `name`; `of`: whether its force acts along a "velocity", the coordinate of a "joint" or the quantity
    of a "part", or is a "parameter" of forces; `where` this is found, static; the `shape` of its force.
    """

    name: str
    of: str
    where: Any
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """The number of components."""
        return int(np.prod(self.shape))

    def rows(self, system: AbstractSystem, at: Instant) -> Float[Array, "n nu"]:
        """The rates of the quantity by u; of a parameter the generalized forces of unit values.

        **Arguments:** the `system` with all parts; `at`: an instant of the system without the named parts.
        """
        match self.of:
            case "velocity":
                return jnp.eye(at.system.nu, dtype=at.u.dtype)[np.array(self.where)]
            case "parameter":
                rest: Any = at.system
                force = lambda value: with_parameters(rest, {self.where: value}).force(at.t, at.q, at.u)
                by_value = jax.jacfwd(force)(jnp.zeros(self.shape, at.u.dtype))
                return by_value.reshape(-1, self.size).T
            case "joint":
                value = lambda q: system.catalogue.joint_coordinate(self.where, at.t, q).reshape(-1)
            case _:
                value = lambda q: _measured(system, self.where, at.t, q)
        rate = lambda u: jax.jvp(value, (at.q,), (at.system.rates(at.t, at.q, u),))[1]
        return jax.jacfwd(rate)(at.u)


def drives_of(system: AbstractSystem, by: Iterable[str]) -> tuple[Drive, ...]:
    """The actuators of these names.

    **Raises:** `ValueError` for unknown names, and for parts that drive nothing.
    """
    if isinstance(by, str) or not isinstance(by, Iterable):
        raise ValueError(f"required_forces: by names actuators in a sequence, [{by!r}], also a single one.")
    names = tuple(by)
    if not names or len(set(names)) < len(names):
        raise ValueError(f"required_forces: by names each actuator once, and at least one; got {list(names)}.")
    velocities, joints, numbers = rates_of(system.rate_names()), system.joint_coordinates(), parameters(system)
    parts = _parts(system)

    def drive(name):
        if name in joints:
            return Drive(name, "joint", joints[name], joints[name].shape)
        if name in velocities:
            index = tuple(velocities[name])
            return Drive(name, "velocity", index, () if len(index) == 1 else (len(index),))
        if name in parts:
            return _of_part(system, parts[name])
        if name in numbers:
            return Drive(name, "parameter", name, numbers[name].shape)
        raise unknown("actuator", name, [*parts, *joints, *velocities, *numbers], "required_forces")

    return tuple(map(drive, names))


def _parts(system) -> dict[str, Place]:
    """The constraints on positions and accelerations, and the forces, by name."""
    if not system.body_names:
        return {}
    kinds = (("constraints", "position"), ("constraints", "servos"), ("forces", "groups"))
    return {
        name: Place(path, kind, number, k, name)
        for path, kind in kinds
        for number, group in enumerate(getattr(getattr(system, path), kind))
        for k, name in enumerate(group.group.names)
    }


def _of_part(system, place: Place) -> Drive:
    name, part = place.name, place.group(system).group.part
    if place.kind == "position" and not isinstance(part, AbstractDriver):
        known = [repr(other) for other in system.joint_coordinates() if other.split(".")[0] == name]
        cure = f"name its coordinate {' or '.join(known)}" if known else "name the coordinate of a joint"
        raise ValueError(f"required_forces: {name!r} is a {part.kind}, which drives nothing; {cure}.")
    if place.kind == "groups" and not isinstance(part, AbstractCoordinatePart):
        known = [repr(other) for other in parameters(system) if other.split(".")[0] == name]
        raise ValueError(
            f"required_forces: {name!r} is a {part.kind}, which acts along no single coordinate. Name coordinates of "
            f"joints, or the parameter that its forces are proportional to: {', '.join(known) or 'it has none'}."
        )
    if name in {joint for law in system.constraints.laws for joint in law.joints}:
        raise ValueError(f"required_forces: {name!r} rubs, so it is not an actuator; name a coordinate instead.")
    t = jnp.zeros((), system.guess.q.dtype)
    (size,) = jax.eval_shape(lambda q: _measured(system, place, t, q), system.guess.q).shape
    return Drive(name, "part", place, () if size == 1 else (size,))


def _measured(system, place: Place, t, q) -> Float[Array, "n"]:
    """The quantity along which a part acts."""
    alone, poses = place.group(system).group.only(place.member), system.bodies.prepared_poses(q)
    space = alone.layout.space

    def of_part(at, poses):
        part = at(t)
        seen = part.seen_poses(space, poses)
        if isinstance(part, AbstractDriver | AbstractCoordinatePart):
            return part.measured(space, seen)
        return alone.kernel("residual")(part, seen, t)

    return alone.map(of_part, alone.gather(poses))[0].reshape(-1)


def without_drives(system: Any, drives: Iterable[Drive]) -> Any:
    """The system without the parts among some actuators; its ranks follow from those of the system."""
    names = frozenset(drive.name for drive in drives if drive.of == "part")
    if not names:
        return system
    constraints, forces = system.constraints, system.forces
    kept = lambda groups: tuple(part for group in groups for part in _kept(group, names))
    position, servos = kept(constraints.position), kept(constraints.servos)
    lost, ranks = _lost_rank(system, names), system.ranks
    servo_rows = sum(g.row_count for g in constraints.servos) - sum(g.row_count for g in servos)
    of_velocities = lost - servo_rows
    fewer = ranks.position - of_velocities, ranks.coordinate - of_velocities, ranks.velocity - of_velocities
    return dataclasses.replace(
        system,
        constraints=dataclasses.replace(constraints, position=position, servos=servos, elements=None),
        forces=dataclasses.replace(forces, groups=kept(forces.groups)),
        ranks=Ranks(*fewer, ranks.acceleration - lost),
        implied=tuple(row for row in system.implied if names.isdisjoint((row.name, *row.by))),
        elimination=None,
    )


def released(system: Any, drives: Iterable[Drive]) -> Any:
    """The system with constant numbers in place of the inputs that are sought."""
    inputs = system.parameter_table.input_names()
    names = frozenset(drive.where for drive in drives if drive.of == "parameter" and drive.where in inputs)
    if not names:
        return system

    def constant(group):
        singles = [single for several in group.group.inputs for single in several.alone()]
        kept = together([single for single in singles if names.isdisjoint(single.names)])
        return dataclasses.replace(group, group=dataclasses.replace(group.group, inputs=kept))

    groups = tuple(map(constant, system.forces.groups))
    return dataclasses.replace(system, forces=dataclasses.replace(system.forces, groups=groups))


def without_limits(system: Any, drives: Iterable[Drive]) -> tuple[Any, dict[str, Float[Array, "2"]]]:
    """The system without the ranges to which sought parameters are clipped, and the ranges by the actuators' names."""
    sought = {drive.where: drive.name for drive in drives if drive.of == "parameter"}
    if not sought or not system.body_names:
        return system, {}
    ranges, groups = {}, []
    for group in system.forces.groups:
        for parameter, field in group.group.part.ranges.items():
            where = lambda group, field=field: getattr(group.group.part, field)
            for k, part in enumerate(group.group.names):
                name = sought.get(f"{part}.{parameter}")
                if name is not None and where(group) is not None:
                    ranges[name] = where(group)[k]
                    group = eqx.tree_at(where, group, where(group).at[k].set(jnp.array([-jnp.inf, jnp.inf])))
        groups.append(group)
    if not ranges:
        return system, ranges
    return dataclasses.replace(system, forces=dataclasses.replace(system.forces, groups=tuple(groups))), ranges


def _kept(group, names) -> tuple[Any, ...]:
    """A group without some of its parts: the group itself, or one group for each remaining part."""
    stacked = group.group
    if names.isdisjoint(stacked.names):
        return (group,)
    out = []
    for k, name in enumerate(stacked.names):
        if name in names:
            continue
        inputs = (single for several in stacked.inputs for single in several.alone() if single.members == (k,))
        alone = dataclasses.replace(
            stacked.only(k),
            names=(name,),
            bodies=(stacked.bodies[k],),
            inputs=tuple(dataclasses.replace(single, members=(0,)) for single in inputs),
            inner=tuple((keys, (inner[k],)) for keys, inner in stacked.inner),
            chosen=None,
        )
        out.append(dataclasses.replace(group.only(k), group=alone))
    return tuple(out)


def _lost_rank(system, names) -> int:
    """By how much the rank of A decreases without the rows of these parts.

    A row of another part that rows of these parts imply takes the place of one of them.
    """
    implied = {(row.name, row.row): names.intersection(row.by) for row in system.implied}
    kept = [name for name, row in system.rows if name in names and (name, row) not in implied]
    waiting = [by for (name, _), by in implied.items() if name not in names and by]
    replaced = frozenset().union(*waiting)
    return len(kept) - min(len(waiting), sum(name in replaced for name in kept))
