"""Systems of bodies and other parts: sizes, names, and views of a motion, for a scene whose parts are stacked."""

import dataclasses
import itertools
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._types import State
from ..linalg.arrays import is_traced
from ..linalg.block_jacobian import JointOrder
from ..parts.base import AbstractInertialConstraint
from ..parts.forces import Gravity
from .body_kinematics import AbstractBodies
from .body_motion import body_motion, body_quantities, scalar_quantities
from .constraint_groups import AbstractConstraintGroup, ConstraintGroup, ServoGroup, VelocityConstraintGroup
from .describe import describe_scene
from .design_variables import DesignVariables, description_rows, in_range
from .equation import Ranks
from .force_groups import ForceGroup, NonIdealGroup
from .frame_motion import frame_quantities
from .group_inputs import signals_of, with_signals
from .groups import BodyGroup, CoordinateGroup, FrameGroup
from .internal_states import (
    StateField,
    initial_states,
    state_fields,
    state_names,
    state_quantities,
    state_rates,
    state_scale,
    with_states,
)
from .joint_coordinates import held_groups, joint_coordinates, joint_quantities
from .layout import Layout
from .parameter_checks import are_in_range, check_parts, stacked_part
from .parameter_paths import parameter_paths, positive_parameters
from .picture import picture
from .quantities import Quantity
from .reactions import applied_wrenches, nonideal_wrenches, reaction


class Implied(NamedTuple):
    """A row that other joints imply: `row` of part `name` follows from the joints `by`."""

    name: str
    row: int
    by: tuple[str, ...]


class AbstractBodySystem(AbstractBodies):
    """The bodies, parts and names of a compiled scene, for a class that knows the equations of their motion.

    **Fields:** the groups of bodies and of other parts, `free_joints` those of joints without rows; `gravity`
    [m/s²] or None; `guess`, the state given with the bodies; `length` [m], the scene's size; `body_names`;
    `elimination`, the order in which the joints are eliminated, or None; `design`.
    """

    bodies: tuple[BodyGroup, ...]
    gravity: Float[Array, "d"] | None
    constraints: tuple[ConstraintGroup, ...]
    velocity_constraints: tuple[VelocityConstraintGroup, ...]
    servos: tuple[ServoGroup, ...]
    nonideal: tuple[NonIdealGroup, ...]
    forces: tuple[ForceGroup, ...]
    guess: State
    length: Float[Array, ""]
    layout: Layout = eqx.field(static=True)
    body_names: tuple[str, ...] = eqx.field(static=True)
    gravity_name: str = eqx.field(static=True)
    ranks: Ranks
    implied: tuple[Implied, ...] = eqx.field(static=True)
    elimination: JointOrder | None = eqx.field(static=True)
    design: tuple[DesignVariables, ...] = ()
    frames: tuple[FrameGroup, ...] = ()
    tendons: tuple[CoordinateGroup, ...] = ()
    free_joints: tuple[CoordinateGroup, ...] = ()

    # Sizes

    @property
    def position_rows(self) -> int:
        return sum(len(g.group.names) * g.rows for g in self.constraints)

    @property
    def coordinate_rows(self) -> int:
        counts = sum(len(g.group.names) * g.rows for g in self.turn_counts)
        return self.position_rows + counts + (sum(self.layout.rotates) if self.spatial else 0)

    @property
    def velocity_rows(self) -> int:
        return self.position_rows + sum(len(g.group.names) * g.rows for g in self.velocity_constraints)

    @property
    def acceleration_rows(self) -> int:
        return self.velocity_rows + sum(len(g.group.names) * g.rows for g in self.servos)

    @property
    def joints(self) -> tuple[AbstractConstraintGroup, ...]:
        """All groups of constraints, in the order of the rows of A."""
        return (*self.constraints, *self.velocity_constraints, *self.servos)

    @property
    def has_bodies(self) -> bool:
        return True

    @property
    def ideal(self) -> bool:
        return not self.nonideal

    @property
    def friction_parts(self) -> frozenset[str]:
        return frozenset(name for g in self.nonideal for name in g.joints)

    @property
    def positive_definite_mass(self) -> bool:
        return True

    @property
    def linear(self) -> bool:
        return all(g.group.part.linear for g in self.velocity_constraints)

    @property
    def drift_free(self) -> bool:
        return not any(g.rheonomic for g in self.constraints) and all(g.homogeneous for g in self.velocity_constraints)

    @property
    def rows(self) -> tuple[tuple[str, int], ...]:
        """Name and number within its part of every row of A."""
        groups = [(g.group.names, range(g.rows)) for g in self.joints]
        return tuple((name, k) for names, rows in groups for name in names for k in rows)

    # Scalar coordinates

    @property
    def _inertial(self) -> tuple[ConstraintGroup, ...]:
        """The groups of parts that have scalar coordinates."""
        return tuple(g for g in self.constraints if _is_inertial(g))

    @property
    def turn_counts(self) -> tuple[ConstraintGroup, ...]:
        """The groups of tendons that have scalar coordinates; their residuals vanish as coordinates are normalised."""
        return tuple(ConstraintGroup(g.group) for g in self.tendons if g.group.part.rows)

    def with_initial_scalars(self) -> Self:
        """The system with the scalar coordinates and their rates in its guess that satisfy their constraints there."""
        if not self.layout.scalars:
            return self
        return dataclasses.replace(self, guess=_with_scalars(self, self.guess))

    # Internal states

    @property
    def _state_fields(self) -> tuple[StateField, ...]:
        return state_fields(self.forces)

    @property
    def state_ends(self) -> tuple[int, ...]:
        return tuple(own.stop for own in self._state_fields)

    def state_names(self):
        return state_names(self._state_fields)

    def with_states(self, z):
        return dataclasses.replace(self, forces=with_states(self.forces, self._state_fields, z))

    def state_rates(self, t, q, u):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        return state_rates(self.forces, self._state_fields, t, poses, velocities)

    def state_scale(self):
        return lax.stop_gradient(state_scale(self.forces, self._state_fields, self.length.dtype))

    def with_initial_states(self) -> Self:
        """The system with the internal states that its parts were given in its guess, and none in its parts."""
        fields = self._state_fields
        if not fields:
            return self
        z = jax.device_put(initial_states(self.forces, fields))
        return dataclasses.replace(
            self,
            guess=dataclasses.replace(self.guess, z=z),
            forces=jax.device_put(with_states(self.forces, fields, None)),
        )

    # Parameters and names

    def parameter_paths(self):
        return parameter_paths(self._gravity_name, self._groups, self.servos)

    def with_frames_of(self, before):
        centre = lambda group: getattr(group.group.part, "centre", None)
        pairs = zip(self.bodies, before.bodies, strict=True)
        moved = [(group, centre(group), centre(old)) for group, old in pairs]
        changed = [(group, new - old) for group, new, old in moved if new is not None and new is not old]
        if not changed:
            return self
        space, q, u = self.layout.space, self.guess.q, self.guess.u
        poses, velocities = self.poses(q), self.velocities(u)
        for group, shift in changed:
            bodies, d = group.group.body_index[:, 0], space.dimension
            velocity = jax.vmap(space.point_velocity)(poses[bodies], velocities[bodies], shift)
            q = q.at[self.layout.pose_index[bodies, :d]].add(jax.vmap(space.direction)(poses[bodies], shift))
            u = u.at[self.layout.velocity_index[bodies, :d]].set(velocity)
        return dataclasses.replace(self, guess=dataclasses.replace(self.guess, q=q, u=u))

    def positive_parameters(self):
        return frozenset(positive_parameters(self._groups))

    def check_parameters(self, names):
        parts = {name.split(".")[0] for name in names}
        dimension = self.layout.space.dimension
        if self.gravity is not None and self.gravity_name in parts and not is_traced(self.gravity):
            self._gravity.check(dimension)
        check_parts(itertools.chain(*self._groups.values()), parts, dimension)

    def parameters_in_range(self):
        gravity = () if self.gravity is None else (self._gravity,)
        parts = (*gravity, *map(stacked_part, itertools.chain(*self._groups.values())))
        return are_in_range(parts) & in_range(self.design)

    @property
    def _gravity(self):
        return Gravity(self.gravity, name=self.gravity_name)

    @property
    def _groups(self):
        kinds = ("bodies", "constraints", "velocity_constraints", "servos", "forces", "nonideal", "frames", "tendons")
        return {kind: getattr(self, kind) for kind in (*kinds, "free_joints")}

    @property
    def _gravity_name(self):
        return None if self.gravity is None else self.gravity_name

    def signals(self):
        return signals_of(self._groups)

    def with_signals(self, signals):
        return dataclasses.replace(self, **with_signals(self._groups, signals))

    def describe(self):
        kinds: dict[str, list[str]] = {}
        for g in self.bodies:
            kinds.setdefault(g.group.part.kind, []).extend(g.group.names)
        plain = [g for g in self.constraints if not _is_inertial(g)]
        return describe_scene(
            self,
            spatial=self.spatial,
            bodies=kinds,
            joints=[
                (plain, ""),
                (self._inertial, ", each with a velocity of its own"),
                (self.free_joints, ", which have coordinates only"),
                (self.velocity_constraints, ", between velocities"),
                (self.servos, ", a program of a Servo"),
            ],
            forces=self.forces,
            tendons=self.tendons,
            laws=self.nonideal,
            gravity=self._gravity_name,
            implied=self.implied,
            design=description_rows(self.design),
            frames=self.frames,
        )

    # Views of a motion

    def motion_names(self):
        return self.body_names

    def motion(self, name, ys):
        return body_motion(self.layout, self.body_names.index(name), ys)

    def quantities(self):
        out = body_quantities(self.layout, self.body_names) | state_quantities(self._state_fields)
        d = self.layout.space.dimension
        for name in self.joint_names():
            for field, shape in (("force", (d,)), ("moment", () if d == 2 else (3,))):
                value = lambda ts, ys, solved, name=name, field=field: getattr(
                    self.reaction(name, ts, ys, solved.multipliers), field
                )
                out[f"{name}.{field}"] = Quantity(shape, value, of_forces=True)
        out |= scalar_quantities(self.layout) | joint_quantities(self, self.joint_coordinates())
        return out | frame_quantities(self, self.frames, self.layout)

    def joint_coordinates(self):
        return joint_coordinates(self._measured, self.layout, batch=self.length.ndim)

    @property
    def _measured(self):
        """The groups of parts that have coordinates."""
        return (*self.constraints, *self.tendons, *self.free_joints)

    def joint_coordinate(self, coordinate, t, q):
        values = self._measured[coordinate.group].coordinates(t, self.prepared_poses(q))
        return values[coordinate.field][coordinate.member]

    def holding(self, values, rates, t):
        held = held_groups(self._measured, self.joint_coordinates(), values, rates, t)
        rows = sum(g.rows for g in held)
        ranks = dataclasses.astuple(self.ranks)
        more = Ranks(*(rank + rows for rank in ranks))
        return dataclasses.replace(self, constraints=(*self.constraints, *held), ranks=more, elimination=None)

    def position_quantities(self):
        return tuple(f"{name}.position" for name in self.body_names)

    def joint_names(self):
        return self.constraint_names()

    @eqx.filter_jit
    def reaction(self, name, ts, ys, multipliers):
        def single(t, y, own):
            poses, velocities = self.prepared_poses(y.q), self.all_velocities(y.u)
            return reaction(self.joints, name, t, poses, velocities, own)

        return jax.vmap(single)(ts, ys, multipliers)

    def force_names(self):
        return tuple(dict.fromkeys(name for g in (*self.forces, *self.nonideal) for name in g.group.names))

    @eqx.filter_jit
    def applied_wrenches(self, name, ts, ys, multipliers):
        forces = [k for k, g in enumerate(self.forces) if name in g.group.names]
        laws = [g for g in self.nonideal if name in g.group.names]

        def single(t, y, own):
            poses, velocities = self.prepared_poses(y.q), self.all_velocities(y.u)
            if laws:
                wrenches = nonideal_wrenches(self.joints, laws, t, poses, velocities, own)
                return applied_wrenches(laws, name, wrenches)
            groups = [self.at(y).forces[k] for k in forces]
            return applied_wrenches(groups, name, [g.wrenches(t, poses, velocities) for g in groups])

        return jax.vmap(single)(ts, ys, multipliers)

    def picture(self, ts, ys):
        return picture(self, [g.group for g in (*self.joints, *self.forces)], ts, ys)

    def not_finite(self, t, q, u):
        t = jnp.asarray(t, q.dtype)
        values = self._of_parts(t, q, u)
        kinds = zip(
            ("residual", "residual", "force"), (self.constraints, self.joints, self.forces), values, strict=True
        )
        found = [
            f"the {kind} of {name!r}"
            for kind, of_kind, of_parts in kinds
            for group, own in zip(of_kind, of_parts, strict=True)
            for name, value in zip(group.group.names, np.asarray(own), strict=True)
            if not np.all(np.isfinite(value))
        ]
        if self.nz:
            rates = np.asarray(self.state_rates(t, q, u))
            found += [
                f"the rate of {name!r}" for name, k in self.state_names().items() if not np.all(np.isfinite(rates[k]))
            ]
        return tuple(dict.fromkeys(found))

    @eqx.filter_jit
    def _of_parts(self, t, q, u):
        """Residuals of positions, those of accelerations, and wrenches, group by group."""
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        return (
            [g.residual(t, poses) for g in self.constraints],
            [g.acceleration(t, poses, velocities, jnp.zeros_like(velocities)) for g in self.joints],
            [g.wrenches(t, poses, velocities) for g in self.forces],
        )


def _is_inertial(group):
    return isinstance(group.group.part, AbstractInertialConstraint)


@eqx.filter_jit
def _with_scalars(system, guess):
    t, q, u = jnp.zeros((), guess.q.dtype), system.normalize(guess.q), guess.u
    layout = system.layout
    for g in system._inertial:
        scalars = g.group.body_index[:, -1]
        unmet = g.residual(t, system.prepared_poses(q))[:, 0]
        q = q.at[layout.pose_index[scalars, 0]].add(-unmet)
        unmet = g.velocity(t, system.prepared_poses(q), system.all_velocities(u))[:, 0]
        u = u.at[layout.velocity_index[scalars, 0]].add(-unmet)
    return dataclasses.replace(guess, q=q, u=u)
