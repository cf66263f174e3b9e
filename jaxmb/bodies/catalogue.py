"""The motions, quantities and forces of a compiled scene by name."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..parts.base import AbstractLink
from ..parts.coordinate_parts import AbstractCoordinatePart
from ..parts.drivers import AbstractDriver
from ..system.catalogue import Catalogue
from ..system.quantities import Measure, entries_along, view_of_motion
from ..system.structures import of_structure
from .joint_coordinates import beyond_half_turns, joint_coordinates, joint_measures, jumping_couplings
from .motion import body_measures, body_motion, frame_measures, scalar_measures
from .picture import picture
from .reactions import (
    applied_wrenches,
    joint_places,
    lifted_ropes,
    places,
    reaction_measures,
    reactions,
    undetermined,
)


class SceneCatalogue(Catalogue):
    """The names of a compiled scene."""

    def motion_names(self):
        return self.system.body_names

    def motion(self, name, ys):
        return body_motion(self.system.layout, self.system.body_names.index(name), ys)

    @of_structure
    def measures(self):
        system = self.system
        out = body_measures(system.layout, system.body_names) | system.state_table.measures()
        out |= reaction_measures(system, self.joint_names()) | scalar_measures(system.layout)
        out |= joint_measures(self.joint_coordinates()) | frame_measures(system.frames, system.layout)
        return out | _drive_measures(system)

    @property
    def lost_headings(self):
        told = ((g.group.part.lost_heading, name) for g in self.system.with_headings for name in g.group.names)
        return tuple(text.format(name=repr(name)) for text, name in told)

    def cautions(self, motion, reach):
        turned = [] if reach is None else beyond_half_turns(self.system, np.asarray(reach))
        return lifted_ropes(self.system, motion) + turned

    def jumps_of_rows(self, t, q):
        return jumping_couplings(self.system, t, q)

    @of_structure
    def joint_coordinates(self):
        return joint_coordinates(self.system.measured, self.system.layout)

    def joint_coordinate(self, coordinate, t, q):
        alone = self.system.measured[coordinate.group].only(coordinate.member)
        return alone.coordinates(t, self.system.bodies.prepared_poses(q))[coordinate.field][0]

    def position_quantities(self):
        return tuple(f"{name}.position" for name in self.system.body_names)

    def joint_names(self):
        return self.constraint_names()

    def reaction(self, name, ts, ys, multipliers):
        return reactions(self.system, joint_places(self.system.constraints, name), ts, ys, multipliers)

    def undetermined(self, ts, ys):
        return undetermined(self.system, ts, ys)

    def force_names(self):
        groups = (*self.system.forces.groups, *self.system.constraints.nonideal)
        return tuple(dict.fromkeys(name for g in groups for name in g.group.names))

    def applied_wrenches(self, name, ts, ys, multipliers):
        place = places(self.system.forces.groups, name), places(self.system.constraints.nonideal, name)
        return applied_wrenches(self.system, place, ts, ys, multipliers)

    def picture(self, ts, ys, deformation=1.0):
        acting = [g.group for g in (*self.system.constraints.groups, *self.system.forces.groups)]
        names = {name for group in acting for name in group.names}
        tendons = [g.group for g in self.system.bodies.tendons if names.isdisjoint(g.group.names)]
        return picture(self.system, [*acting, *tendons], ts, ys, deformation)

    def limits(self, t, q):
        space, poses, out = self.system.layout.space, np.asarray(self.system.bodies.prepared_poses(q)), []
        groups = (*self.system.constraints.groups, *self.system.forces.groups)
        for group in (g.group for g in groups if isinstance(g.group.part, AbstractLink) and g.group.part.has_limits):
            for member, name in enumerate(group.names):
                part = group.single(member, t).named(name)
                reached = part.limit_reached(space, part.seen_poses(space, poses[group.body_index[member]]))
                out += [f"{part.label} is at its limit: {reached}"] if reached else []
        return tuple(dict.fromkeys(out))

    def not_finite(self, t, q, u):
        names = [
            f"the {kind} of {name!r}"
            for kind, of_kind in _values_of_parts(self.system, t, q, u).items()
            for name, value in of_kind
            if not np.all(np.isfinite(value))
        ]
        return tuple(dict.fromkeys(names))


def _drive_measures(system):
    """The forces of drives along the quantities that they drive, `"turn.drive_force"`."""
    out, constraints = {}, system.constraints
    first_servo = len(constraints.position) + len(constraints.velocity)
    for number, g in enumerate(constraints.groups):
        if number >= first_servo or isinstance(g.group.part, AbstractDriver):
            shape = () if g.rows == 1 else (g.rows,)
            for k, name in enumerate(g.group.names):
                place = number, np.array(k), shape
                out[f"{name}.drive_force"] = Measure(shape, _drive_force, place, of_forces=True)
    table = system.state_table
    for state in table.fields:
        part = table.group(state).group.part
        if isinstance(part, AbstractCoordinatePart) and part.drives_by == state.name:
            for k, name in enumerate(state.members):
                place = "z", np.array(state.start + k * state.size), state.shape
                out[f"{name}.drive_force"] = Measure(state.shape, entries_along, place)
    return out


@view_of_motion
def _drive_force(system, place, ts, ys, solved):
    number, member, shape = place

    def single(t, y, multipliers):
        group, values = system.constraints.of_groups(multipliers)[number]
        now, alone = system.kinematics(t, y.q, y.u), group.group.only(member)
        if not isinstance(alone.part, AbstractDriver):
            return values[member].reshape(shape)

        def of_part(at, poses, values):
            part = at(now.t)
            return part.drive_force(alone.layout.space, part.seen_poses(alone.layout.space, poses), now.t, values)

        return alone.map(of_part, alone.gather(now.poses), values[member][None]).reshape(shape)

    return jax.vmap(single)(ts, ys, solved.multipliers)


def _values_of_parts(system, t, q, u):
    """Residuals of positions and of accelerations, wrenches, and rates of internal states, by part."""
    constraints, forces = system.constraints, system.forces
    position, acceleration, wrenches, rates = _values(system, t, q, u)
    named = lambda g, values: zip(g.group.names, np.asarray(values), strict=True)
    by_part = lambda groups, of_groups: itertools.chain(*map(named, groups, of_groups))
    return {
        "residual": (*by_part(constraints.position, position), *by_part(constraints.groups, acceleration)),
        "force": by_part(forces.groups, wrenches),
        "rate": [(name, np.asarray(rates)[index]) for name, index in system.state_names().items()],
    }


@eqx.filter_jit
def _values(system, t, q, u):
    now, (constraints, forces) = system.kinematics(t, q, u), (system.constraints, system.forces)
    return (
        [g.residual(now.t, now.poses) for g in constraints.position],
        [g.acceleration(now, jnp.zeros_like(now.velocities)) for g in constraints.groups],
        [wrenches for wrenches, _ in forces.wrenches(now)],
        system.state_table.rates(now),
    )
