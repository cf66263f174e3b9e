"""Rigid bodies joined by constraints and forces: the compiled form of a scene."""

import dataclasses
import functools
import itertools
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar, State, Velocities
from ..linalg.arrays import add_up, is_traced
from ..linalg.block_jacobian import BlockJacobian, JointOrder, block_jacobian
from ..linalg.inertia import AbstractInertia, BlockInertia, DiagonalInertia
from ..linalg.jacobian import DenseJacobian
from ..linalg.jitted import on_host
from ..linalg.rotations import cross, normalize, rotate
from ..linalg.sums import placed_sums, unchecked_take
from ..parts.base import AbstractInertialConstraint
from ..parts.forces import Gravity
from ..parts.unilateral import AbstractUnilateralConstraint
from ..solvers.manifold_term import GapsSeen
from ..system.catalogue import AbstractSystem
from ..system.contact_set import ContactNumbers, ContactSet
from ..system.design_variables import DesignVariables, variables_in_range
from ..system.equation import Ranks
from ..system.quantities import Measure, view_of_motion
from ..system.structures import of_structure
from .constraint_set import ConstraintSet
from .contact_rows import contact_set
from .describe import describe_scene
from .elementary import ElementaryRows, elementary_rows, half_turned, is_elementary
from .field_jacobian import motion_jacobian
from .groups import (
    AbstractConstraintGroup,
    BodyGroup,
    BodyPoses,
    BodyVelocities,
    ConstraintGroup,
    CoordinateGroup,
    ForceGroup,
    FrameGroup,
    NonIdealGroup,
    VelocityConstraintGroup,
)
from .host import host_scene
from .internal_states import (
    StateField,
    initial_states,
    state_fields,
    state_measures,
    state_names,
    state_rates,
    state_scale,
    with_states,
)
from .joint_coordinates import held_groups, joint_coordinates, joint_measures
from .joint_graph import joint_order_with_more
from .layout import Layout
from .motion import body_measures, body_motion, coordinate_names, frame_measures, rate_names, scalar_measures
from .parameters import (
    are_in_range,
    check_parts,
    module_structures,
    parameter_paths,
    positive_parameters,
    signals_of,
    with_signals,
)
from .picture import picture
from .reactions import places, reaction, with_slip

# From this number of velocities on, implicit methods eliminate in blocks. (A step of eight cars with draft gears, 24
# velocities, takes 0.5 ms so and 6.4 ms with dense matrices; small machines with joints have cheap dense ones.)
_LEAST_VELOCITIES = 40


class Implied(NamedTuple):
    """A row that other joints imply: `row` of part `name` follows from the joints `by`."""

    name: str
    row: int
    by: tuple[str, ...]


# Of more parts than this with functions of time only a combination is looked at.
_MOST_OF_TIME = 32


class RigidBodySystem(AbstractSystem):
    """A scene, compiled. Made by `Scene.compile`; a pytree whose leaves are the parameters.

    ```python
    system = jaxmb.Scene([bar], joints=[pin], forces=[jaxmb.Gravity((0.0, -9.81))]).compile()
    print(system)  # Bodies, coordinates, constraint rows and their ranks, degrees of freedom.
    system.body_names, system.coordinate_names(), system.joint_coordinates()
    ```

    **Fields:** the groups of `bodies` and of other parts, `free_joints` those of joints without rows; `gravity`
    [m/s²] or None; `guess`, the state given with the bodies; `length` [m], the scene's size; `body_names`; `ranks`;
    `implied` rows; `elimination`, the order in which the joints are eliminated, or None; `design`; of a system that is
    `prepared` for a motion, the rows of joints by their `elements`; the `contacts` and dry friction among the rows.
    """

    bodies: tuple[BodyGroup, ...]
    gravity: Float[Array, "d"] | None
    constraints: tuple[ConstraintGroup, ...]
    velocity_constraints: tuple[VelocityConstraintGroup, ...]
    servos: tuple[ConstraintGroup, ...]
    nonideal: tuple[NonIdealGroup, ...]
    forces: tuple[ForceGroup, ...]
    guess: State
    length: Float[Array, ""]
    layout: Layout = eqx.field(static=True)
    body_names: tuple[str, ...] = eqx.field(static=True)
    gravity_name: str = eqx.field(static=True)
    ranks: Ranks = eqx.field()  # pyright: ignore[reportIncompatibleVariableOverride]
    implied: tuple[Implied, ...] = eqx.field(static=True)
    elimination: JointOrder | None = eqx.field(static=True)
    design: tuple[DesignVariables, ...] = ()
    frames: tuple[FrameGroup, ...] = ()
    tendons: tuple[CoordinateGroup, ...] = ()
    free_joints: tuple[CoordinateGroup, ...] = ()
    elements: ElementaryRows | None = None
    contacts: ContactSet = eqx.field(static=True, init=False)  # pyright: ignore[reportIncompatibleVariableOverride]

    def __post_init__(self):
        self.contacts = contact_set(self.constraints, self.velocity_constraints)

    # Sizes and names

    @property
    def nq(self) -> int:
        return self.layout.nq

    @property
    def nu(self) -> int:
        return self.layout.nu

    @property
    def spatial(self) -> bool:
        return self.layout.space.dimension == 3

    @property
    def rates_are_velocities(self) -> bool:
        return not self.spatial

    def coordinate_names(self):
        return coordinate_names(self.layout, self.body_names)

    def rate_names(self):
        return rate_names(self.layout, self.body_names)

    # Bodies

    @property
    def mass(self) -> Float[Array, "b"]:
        """Masses [kg] of the bodies."""
        return self._in_order([g.mass for g in self.bodies])

    @property
    def moments_of_inertia(self) -> Float[Array, "b *matrix"]:
        """Moments of inertia [kg m²] about the mass centres: a number in the plane, a matrix in body axes in space."""
        return self._in_order([g.inertia for g in self.bodies])

    def _in_order(self, of_groups):
        """Per-body values of all groups, in the order of the bodies."""
        if len(of_groups) == 1:
            return of_groups[0]
        order = np.argsort(np.concatenate([g.group.body_index[:, 0] for g in self.bodies]))
        return unchecked_take(jnp.concatenate(of_groups), order)

    # Kinematics

    def prepared_poses(self, q: Coordinates) -> BodyPoses:
        """Prepared poses of the bodies, of scalar coordinates and of the ground, the arguments of kernels."""
        prepare = self.layout.space.prepare
        ground = prepare(jnp.asarray(self.layout.space.ground, q.dtype))
        # Computed once: what is cheap XLA would compute anew in each kernel that uses it.
        return lax.optimization_barrier(jnp.concatenate([jax.vmap(prepare)(self._poses(q)), ground[None]]))

    def all_velocities(self, u: Velocities) -> BodyVelocities:
        """Velocities of the bodies, of scalar coordinates and of the ground."""
        return jnp.pad(self._velocities(u), ((0, 1), (0, 0)))

    def poses(self, q: Coordinates) -> Float[Array, "b p"]:
        """Poses of the bodies."""
        return self._poses(q)[: self.layout.bodies]

    def velocities(self, u: Velocities) -> Float[Array, "b v"]:
        """Velocities of the bodies."""
        return self._velocities(u)[: self.layout.bodies]

    def _poses(self, q):
        """Poses of the bodies and of scalar coordinates."""
        if self.layout.uniform:
            return q.reshape(self.layout.bodies, -1)
        ground = jnp.asarray(self.layout.space.ground, q.dtype)
        return unchecked_take(jnp.concatenate([q, ground]), self.layout.pose_index[:-1])

    def _velocities(self, u):
        """Velocities of the bodies and of scalar coordinates."""
        if self.layout.uniform:
            return u.reshape(self.layout.bodies, -1)
        return unchecked_take(jnp.concatenate([u, jnp.zeros(1, u.dtype)]), self.layout.velocity_index[:-1])

    def rates(self, t, q, u):
        if self.rates_are_velocities:
            return u
        rates = self._pack(jax.vmap(self.layout.space.rates)(self._poses(q), self._velocities(u)))
        for g in self.turn_counts:
            own = g.velocity(jnp.asarray(t, q.dtype), self.prepared_poses(q), self.all_velocities(u))
            rates = rates.at[self._counts(g)].set(-own)
        return rates

    def normalize(self, q):
        if self.rates_are_velocities:
            return q
        q = self._pack(jax.vmap(self.layout.space.normalize)(self._poses(q)))
        for g in self.turn_counts:
            # A count of turns does not depend on the time.
            own = g.residual(jnp.zeros((), q.dtype), self.prepared_poses(q))
            q = q.at[self._counts(g)].add(-own)
        return q

    def _counts(self, group):
        """Where the counts of turns of stacked tendons stand in q, shape (parts, rows)."""
        return self.layout.pose_index[group.group.body_index[:, -group.rows :], 0]

    def normalize_fixed(self, q, fixed):
        rotating = np.flatnonzero(np.array(self.layout.rotates) & self.spatial)
        turns = self.layout.pose_index[:-1][rotating, 3:]
        whole = turns[np.all(fixed[turns], axis=1)]
        for index in whole:
            q = q.at[index].set(normalize(q[index]))
        return q, len(whole)

    def held_velocities(self, held):
        if self.rates_are_velocities:
            return held
        d = self.layout.space.dimension
        of_pose = np.append(held, np.ones(self.layout.space.pose_size, bool))[self.layout.pose_index[:-1]]
        turns = of_pose[:, d:]
        if np.any(np.any(turns, axis=1) & ~np.all(turns, axis=1)):
            return None
        of_bodies = np.concatenate([of_pose[:, :d], np.repeat(turns[:, :1], d, axis=1)], axis=1)
        return of_bodies.reshape(-1)[self.layout.velocity_place]

    def _pack(self, poses):
        raveled = poses.reshape(-1)
        return raveled if self.layout.uniform else unchecked_take(raveled, self.layout.coordinate_place)

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
    def ideal(self) -> bool:
        return not self.laws

    @property
    def ideal_without_friction(self) -> bool:
        return not self.nonideal and not self.servos

    @property
    def frictions(self) -> tuple[VelocityConstraintGroup, ...]:
        """The groups of dry friction."""
        return tuple(g for g in self.velocity_constraints if g.joints)

    @property
    def laws(self) -> tuple[NonIdealGroup, ...]:
        """The groups of non-ideal laws, with those of dry friction that slips."""
        return (*self.nonideal, *(g.law for g in self.frictions))

    @property
    def friction_parts(self) -> frozenset[str]:
        return frozenset(name for g in self.laws for name in g.joints)

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

    @property
    def contact_numbers(self):
        contacts = [g.group.part for g in self.constraints if isinstance(g.group.part, AbstractUnilateralConstraint)]
        frictions = [(g.group.part, g.rows) for g in self.frictions]
        joined = lambda values: jnp.concatenate([*values, jnp.zeros(0, self.length.dtype)])
        return ContactNumbers(
            restitution=joined(part.restitution for part in contacts),
            peaks=joined(part.peak for part in contacts),
            coefficient=joined(_of_rows(part.coefficient, rows) for part, rows in frictions),
            limit=joined(_of_rows(part.limit, rows) for part, rows in frictions),
        )

    @property
    def _closing(self):
        """The groups of forces that act where a gap is closed only."""
        return tuple(g for g in self.forces if g.group.part.has_gaps)

    @property
    def has_gaps(self):
        return bool(self._closing)

    @eqx.filter_jit
    def gaps_seen(self, t, q, u):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        seen = [g.gaps(t, poses, velocities) for g in self._closing]
        gaps, rates, widths, paces = (jnp.concatenate([x.ravel() for x in own]) for own in zip(*seen, strict=True))
        return GapsSeen(gaps, rates, widths, jnp.max(paces))

    @eqx.filter_jit
    def friction_reactions(self, t, q, u, multipliers):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        groups = self.frictions
        reactions = self._set(self.joints).reactions([g.law for g in groups], t, poses, velocities, multipliers)
        d, both = self.layout.space.dimension, zip(groups, reactions, strict=True)
        return jnp.concatenate([_of_rows(own[:, g.group.part.last, :d], g.rows) for g, own in both])

    # Scalar coordinates

    @property
    def inertial(self) -> tuple[ConstraintGroup, ...]:
        """The groups of parts that have scalar coordinates."""
        return tuple(g for g in self.constraints if isinstance(g.group.part, AbstractInertialConstraint))

    @property
    def turn_counts(self) -> tuple[ConstraintGroup, ...]:
        """The groups of tendons that have scalar coordinates; their residuals vanish as coordinates are normalised."""
        return tuple(ConstraintGroup(g.group) for g in self.tendons if g.group.part.rows)

    def with_initial_scalars(self) -> Self:
        """The system with the scalar coordinates and their rates in its guess that satisfy their constraints there."""
        if not self.layout.scalars:
            return self
        q, u = jax.device_put(_with_scalars(self, self.guess))
        return dataclasses.replace(self, guess=dataclasses.replace(self.guess, q=q, u=u))

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

    @of_structure
    def parameter_paths(self):
        return parameter_paths(None if self.gravity is None else self.gravity_name, self._groups, self.servos)

    def module_structures(self):
        return module_structures(self._groups)

    def with_frames_of(self, before):
        pairs = zip(self.bodies, before.bodies, strict=True)
        moved = [(group, group.group.part.mass_centre, old.group.part.mass_centre) for group, old in pairs]
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
        parts = (*gravity, *(group.part() for group in itertools.chain(*self._groups.values())))
        return are_in_range(parts) & variables_in_range(self.design)

    @property
    def _gravity(self):
        return Gravity(self.gravity, name=self.gravity_name)

    @property
    def _groups(self):
        kinds = ("bodies", "constraints", "velocity_constraints", "servos", "forces", "nonideal", "frames", "tendons")
        fields = vars(self)
        return {kind: fields[kind] for kind in (*kinds, "free_joints")}

    @property
    def signals(self):
        return signals_of(self._groups)

    def with_signals(self, signals):
        return dataclasses.replace(self, **with_signals(self._groups, signals))

    @property
    def of_time(self):
        return any(group.group.part.of_time for group in self._acting)

    def given_in_time(self, t, q, u):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        own = [g.given_in_time(t, poses, velocities) for g in self._acting if g.group.part.of_time]
        return jnp.concatenate([_combined(given).ravel() for given in own])

    @property
    def _acting(self):
        return (*self.constraints, *self.velocity_constraints, *self.forces)

    def describe(self):
        return describe_scene(self)

    def left_out_by_elimination(self) -> list[str]:
        """The dense matrices that an elimination in blocks makes unnecessary."""
        order, out = self.elimination, []
        if order is not None:
            out.append(f"the dense Jacobian and charts, with Adams: {order}")
        if self.implicit_in_blocks:
            joined = f"{self.layout.bodies} bodies" + " with the joints" * (order is not None)
            out.append(f"the dense Newton matrix, with Hermite: sparse elimination of {joined}")
        return out

    # Views of a motion

    def motion_names(self):
        return self.body_names

    def motion(self, name, ys):
        return body_motion(self.layout, self.body_names.index(name), ys)

    @of_structure
    def measures(self):
        out = body_measures(self.layout, self.body_names) | state_measures(self._state_fields)
        d = self.layout.space.dimension
        for name in self.joint_names():
            own = self._joint_places(name)
            for field, shape in (("force", (d,)), ("moment", () if d == 2 else (3,))):
                out[f"{name}.{field}"] = Measure(shape, _of_reaction, (field, own), of_forces=True)
        out |= scalar_measures(self.layout) | joint_measures(self.joint_coordinates())
        return out | frame_measures(self.frames, self.layout)

    @of_structure
    def joint_coordinates(self):
        return joint_coordinates(self._measured, self.layout)

    @property
    def _measured(self):
        """The groups of parts that have coordinates."""
        return (*self.constraints, *self.tendons, *self.free_joints)

    def joint_coordinate(self, coordinate, t, q):
        alone = self._measured[coordinate.group].only(coordinate.member)
        return alone.coordinates(t, self.prepared_poses(q))[coordinate.field][0]

    def holding(self, values, rates, t):
        held = held_groups(self._measured, self.joint_coordinates(), values, rates, t)
        rows = sum(g.rows for g in held)
        ranks = dataclasses.astuple(self.ranks)
        more = Ranks(*(rank + rows for rank in ranks))
        out = dataclasses.replace(self, constraints=(*self.constraints, *held), ranks=more, elimination=None)
        if self.elimination is None:
            return out
        return dataclasses.replace(out, elimination=joint_order_with_more(out, self, self.elimination))

    def position_quantities(self):
        return tuple(f"{name}.position" for name in self.body_names)

    def joint_names(self):
        return self.constraint_names()

    def _joint_places(self, name):
        """Where a joint stands among the constraints, and among dry friction."""
        return places(self.joints, name), places(self.frictions, name)

    def reaction(self, name, ts, ys, multipliers):
        return _reactions(self, self._joint_places(name), ts, ys, multipliers)

    def force_names(self):
        return tuple(dict.fromkeys(name for g in (*self.forces, *self.nonideal) for name in g.group.names))

    def applied_wrenches(self, name, ts, ys, multipliers):
        own = places(self.forces, name), places(self.nonideal, name)
        return _applied_wrenches(self, own, ts, ys, multipliers)

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

    # Constraints. Each kernel is a compiled function, so that it is traced once for all its uses in a program.

    @eqx.filter_jit
    def position_residual(self, t, q):
        poses = self.prepared_poses(q)
        return _join(self._set(self.constraints).residual(t, poses), q.dtype)

    def coordinate_residual(self, t, q):
        residual = self.position_residual(t, q)
        if not self.spatial:
            return residual
        p = self.poses(q)[_rotating(self.layout), 3:]
        poses = self.prepared_poses(q)
        counts = [g.residual(t, poses).reshape(-1) for g in self.turn_counts]
        return jnp.concatenate([residual, *counts, 0.5 * (jnp.sum(p * p, axis=1) - 1.0)])

    @eqx.filter_jit
    def coordinate_jacobian(self, t, q):
        if self.rates_are_velocities:
            return self._jacobian(t, q, jnp.zeros(self.nu, q.dtype), self.constraints)
        poses = self.prepared_poses(q)
        size = self.layout.space.pose_size
        along = lambda x: jax.vmap(lambda dx: jax.jvp(self.layout.space.prepare, (x,), (dx,))[1])(
            jnp.eye(size, dtype=q.dtype)
        )
        moves = functools.cache(lambda: jax.vmap(along)(poses[:, :size]))
        groups = (*self.constraints, *self.turn_counts)
        blocks = self._set(groups).jacobian_of_poses(t, poses, moves)
        jacobian = self._assemble(blocks, groups, q.dtype, of_poses=True)
        rotating = _rotating(self.layout)
        index = self.layout.pose_index[rotating, 3:]
        own = (index[:, :, None] == np.arange(self.nq)).any(1)
        return jnp.concatenate([jacobian, jnp.where(own, q[None], 0.0)])

    @eqx.filter_jit
    def velocity_residual(self, t, q, u):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        groups = (*self.constraints, *self.velocity_constraints)
        return _join(self._set(groups).velocity(t, poses, velocities), q.dtype)

    def prepared(self):
        return dataclasses.replace(self, elements=elementary_rows(self.constraints, self.layout.ground))

    def closing(self):
        # In the plane a residual tells whole turns, which no product does.
        return self.prepared() if self.layout.space.dimension == 3 else self

    def half_turned(self, q):
        groups = self.constraints
        if self.elements is None:
            return False
        known = np.concatenate([np.full(len(g.group.names) * g.rows, is_elementary(g)) for g in groups])
        found = half_turned(groups, self.prepared_poses(q))
        return found if known.all() else jnp.zeros(known.size, bool).at[np.flatnonzero(known)].set(found)

    def on_host(self, t):
        return None if is_traced((self, t)) else host_scene(self, t)

    def _set(self, groups: tuple[AbstractConstraintGroup, ...]) -> ConstraintSet:
        return ConstraintSet(groups, self.elements)

    @eqx.filter_jit
    def jacobian(self, t, q, u):
        return self._jacobian(t, q, u, self.joints)

    def structured_jacobian(self, t, q, u):
        if self.elimination is None:
            return DenseJacobian(self.jacobian(t, q, u))
        return self.block_jacobian(t, q, u, self.elimination)

    def block_jacobian(self, t: Scalar, q: Coordinates, u: Velocities, order: JointOrder) -> BlockJacobian:
        """`A` in blocks of joints on bodies."""
        blocks = [*self._blocks(t, q, u, self.joints), jnp.zeros(1, q.dtype)]
        return block_jacobian(_join(blocks, q.dtype), order)

    def _blocks(self, t, q, u, groups):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        return self._set(groups).jacobian(t, poses, velocities)

    def _jacobian(self, t, q, u, groups):
        blocks = self._blocks(t, q, u, groups)
        return self._assemble(blocks, groups, q.dtype, of_poses=False)

    @eqx.filter_jit
    def constraint_force(self, t, q, u, multipliers):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        return self._add_up(*self._set(self.joints).wrenches(t, poses, velocities, multipliers), u.dtype)

    @eqx.filter_jit
    def nonideal_force(self, t, q, u, multipliers):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        laws = self.laws
        wrenches = self._set(self.joints).nonideal_wrenches(laws, t, poses, velocities, multipliers)
        return self._add_up(wrenches, [g.group.body_index for g in laws], u.dtype)

    @eqx.filter_jit
    def acceleration_residual(self, t, q, u, udot):
        t = jnp.asarray(t, q.dtype)
        poses, velocities, accelerations = self.prepared_poses(q), self.all_velocities(u), self.all_velocities(udot)
        return _join(self._set(self.joints).acceleration(t, poses, velocities, accelerations), q.dtype)

    def _assemble(self, blocks, groups, dtype, *, of_poses):
        source = self.layout.jacobian_source([(g.group.body_index, g.rows) for g in groups], of_poses=of_poses)
        return unchecked_take(_join([*blocks, jnp.zeros(1, dtype)], dtype), source)

    # Dynamics

    def inertia(self, t, q, u) -> AbstractInertia:
        if self.spatial and self.layout.uniform:
            return BlockInertia(self.mass, self.moments_of_inertia)
        mass = self._masses_of_coordinates
        if self.spatial:
            points = np.array([not rotates for rotates in self.layout.rotates])[:, None, None]
            # A point mass gets a unit moment of inertia, which has no effect, to make the matrix regular; a scalar
            # coordinate as well.
            moments = self.moments_of_inertia
            unit = jnp.eye(3, dtype=moments.dtype)
            of_scalars = jnp.tile(unit, (len(self.layout.scalars), 1, 1))
            moments = jnp.concatenate([jnp.where(points, unit, moments), of_scalars])
            return _MixedInertia(BlockInertia(mass, moments), self.layout)
        moments = jnp.pad(self.moments_of_inertia, (0, len(self.layout.scalars)))
        columns = [jnp.repeat(mass[:, None], 2, axis=1), moments[:, None]]
        bodies = jnp.concatenate(columns, axis=1)
        if self.layout.uniform:
            return DiagonalInertia(bodies.reshape(-1))
        return DiagonalInertia(bodies.reshape(-1)[self.layout.velocity_place])

    @property
    def _masses_of_coordinates(self):
        """What counts as the mass of each body and scalar coordinate in the mass matrix, [kg] or [kg m²]; one, which
        has no effect, of those that do not move.
        """
        if not self.layout.scalars:
            return self.mass
        found = [(g.group.body_index[:, -1], g.group.part.inertia) for g in self.inertial]
        # The mode of friction has a velocity that no force changes.
        found += [
            (g.group.body_index[:, k], jnp.ones_like(g.group.part.coefficient))
            for g in self.frictions
            for k in range(-g.rows, 0)
        ]
        still = [k for k, own in enumerate(self.layout.scalars, self.layout.bodies) if not own.moves]
        order = np.argsort(np.concatenate([*(numbers for numbers, _ in found), still]).astype(int))
        ones = jnp.ones(len(still), self.mass.dtype)
        inertias = unchecked_take(jnp.concatenate([*(inertia for _, inertia in found), ones]), order)
        return jnp.concatenate([self.mass, inertias])

    @eqx.filter_jit
    def force(self, t, q, u):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        wrenches = [g.wrenches(t, poses, velocities) for g in self.forces]
        bodies = [g.group.body_index for g in self.forces]
        own = self._own_wrenches(u)
        if own is not None:
            wrenches.append(own)
            bodies.append(np.arange(self.layout.bodies)[:, None])
        return self._add_up(wrenches, bodies, u.dtype)

    def _add_up(self, wrenches, bodies, dtype):
        """The generalized force of wrenches (parts, k, velocity size) on these bodies (parts, k), group by group."""
        if not wrenches:
            return jnp.zeros(self.nu, dtype)
        size = self.layout.space.velocity_size
        entries = jnp.concatenate([own.reshape(-1, size) for own in wrenches])
        of_bodies = placed_sums(np.concatenate([own.ravel() for own in bodies]), self.layout.ground)(entries).reshape(
            -1
        )
        return of_bodies if self.layout.uniform else unchecked_take(of_bodies, self.layout.velocity_place)

    def _own_wrenches(self, u):
        """Gravity and the gyroscopic moment `−ω × J ω`, shape (bodies, velocity size); None where there is neither."""
        size, dimension = self.layout.space.velocity_size, self.layout.space.dimension
        parts = []
        if self.gravity is not None:
            parts.append(jnp.pad(self.mass[:, None] * self.gravity[None, :], ((0, 0), (0, size - dimension))))
        if self.spatial and any(self.layout.rotates):
            omega = self.velocities(u)[:, 3:]
            moment = -jax.vmap(lambda J, w: cross(w, J @ w))(self.moments_of_inertia, omega)
            parts.append(jnp.pad(moment, ((0, 0), (3, 0))))
        return sum(parts[1:], start=parts[0]) if parts else None

    def gyroscopic_damping(self, u: Velocities) -> Float[Array, "ground v v"]:
        """The derivative of each body's gyroscopic moment with respect to its own velocity; zeros for scalar
        coordinates.
        """
        size = self.layout.space.velocity_size
        if not self.spatial:
            return jnp.zeros((self.layout.ground, size, size), u.dtype)
        moment = lambda J, w: -cross(w, J @ w)
        own = jax.vmap(jax.jacfwd(moment, argnums=1))(self.moments_of_inertia, self.velocities(u)[:, 3:])
        return jnp.pad(own, ((0, len(self.layout.scalars)), (3, 0), (3, 0)))

    # Implicit methods

    @property
    def has_field_jacobian(self) -> bool:
        return self.nz == 0

    @property
    def implicit_in_blocks(self) -> bool:
        in_blocks = self.elimination is not None or self.acceleration_rows == 0
        plain = self.ideal_on_velocities and self.has_field_jacobian
        return plain and in_blocks and self.nu >= _LEAST_VELOCITIES

    def field_jacobian(self, t, y):
        return motion_jacobian(self, t, y)

    # Energy and momentum

    @eqx.filter_jit
    def kinetic_energy(self, t, q, u):
        return 0.5 * jnp.dot(u, self.inertia(t, q, u).product(u))

    @eqx.filter_jit
    def potential_energy(self, t, q):
        poses = self.prepared_poses(q)
        energy = sum((g.energy(t, poses) for g in self.forces), start=jnp.zeros((), q.dtype))
        if self.gravity is not None:
            position = self.poses(q)[:, : self.layout.space.dimension]
            energy = energy - jnp.sum(self.mass * (position @ self.gravity))
        return energy

    def linear_momentum(self, q, u):
        del q
        return self.mass @ self.velocities(u)[:, : self.layout.space.dimension]

    def angular_momentum(self, q, u):
        poses, velocities = self.poses(q), self.velocities(u)
        if not self.spatial:
            x, v = poses[:, :2], velocities[:, :2]
            orbital = self.mass * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0])
            return jnp.sum(orbital + self.moments_of_inertia * velocities[:, 2])
        spin = jax.vmap(lambda p, J, w: rotate(p, J @ w))(poses[:, 3:], self.moments_of_inertia, velocities[:, 3:])
        orbital = jax.vmap(cross)(poses[:, :3], self.mass[:, None] * velocities[:, :3])
        return jnp.sum(spin + orbital, axis=0)

    # Scales

    def coordinate_scale(self):
        return self._scale(self.layout.pose_index, self.nq)

    def velocity_scale(self):
        return self._scale(self.layout.velocity_index, self.nu)

    def known_scales(self) -> tuple[Float[np.ndarray, "nq"], Float[np.ndarray, "nu"]]:
        """The scales of coordinates and velocities of a system that is not traced: NumPy, also within a trace."""
        index, length = self.layout, np.asarray(self.length)
        sizes = (index.pose_index, self.nq), (index.velocity_index, self.nu)
        of_coordinates, of_velocities = (np.where(self._lengths(*own), length, 1.0) for own in sizes)
        return of_coordinates, of_velocities

    def _scale(self, index, size):
        return jnp.where(self._lengths(index, size), lax.stop_gradient(self.length), 1.0)

    def _lengths(self, index, size):
        """Which of the coordinates, or velocities, are lengths."""
        translation = [False] * size
        for body in index[: self.layout.bodies]:
            for k in body[: self.layout.space.dimension]:
                translation[k] = True
        for own, row in zip(self.layout.scalars, index[self.layout.bodies : -1], strict=True):
            if row[0] < size:
                translation[row[0]] = own.is_length
        return np.array(translation, bool)


@view_of_motion
def _reactions(system, place, ts, ys, multipliers):
    of_joint, of_friction = place

    def single(t, y, own):
        poses, velocities = system.prepared_poses(y.q), system.all_velocities(y.u)
        out = reaction(system.joints, of_joint, t, poses, velocities, own)
        slips = [system.frictions[at.group].law for at in of_friction]
        if not slips:
            return out
        wrenches = ConstraintSet(system.joints, None).nonideal_wrenches(slips, t, poses, velocities, own)
        return with_slip(out, slips, of_friction, poses, wrenches)

    return jax.vmap(single)(ts, ys, multipliers)


@view_of_motion
def _of_reaction(system, place, ts, ys, solved):
    field, joint = place
    return getattr(_reactions(system, joint, ts, ys, solved.multipliers), field)


@view_of_motion
def _applied_wrenches(system, place, ts, ys, multipliers):
    of_forces, of_laws = place

    def single(t, y, own):
        poses, velocities = system.prepared_poses(y.q), system.all_velocities(y.u)
        if of_laws:
            laws = [system.nonideal[at.group] for at in of_laws]
            wrenches = ConstraintSet(system.joints, None).nonideal_wrenches(laws, t, poses, velocities, own)
            found = [values[at.member] for values, at in zip(wrenches, of_laws, strict=True)]
        else:
            alone = [system.at(y).forces[at.group].only(at.member) for at in of_forces]
            found = [group.wrenches(t, poses, velocities)[0] for group in alone]
        # A force element may have several components.
        return add_up(values[np.array(at.on_bodies)] for values, at in zip(found, of_laws or of_forces, strict=True))

    return jax.vmap(single)(ts, ys, multipliers)


class _MixedInertia(AbstractInertia):
    """Spatial bodies, point masses and scalar coordinates together. `blocks` has unit blocks for the rotations of
    those that do not rotate.
    """

    blocks: BlockInertia
    layout: Layout = eqx.field(static=True)

    def product(self, v):
        return self._through(self.blocks.product, v)

    def solve(self, f):
        return self._through(self.blocks.solve, f)

    def root(self):
        return _MixedInertia(self.blocks.root(), self.layout)

    def transpose(self):
        return _MixedInertia(self.blocks.transpose(), self.layout)

    def _through(self, apply, v):
        index = self.layout.velocity_index[:-1].ravel()
        columns = v.reshape(v.shape[0], -1)
        full = jnp.pad(columns, ((0, 1), (0, 0)))[index]
        return apply(full)[self.layout.velocity_place].reshape(v.shape)


def _join(blocks, dtype):
    return jnp.concatenate([b.reshape(-1) for b in blocks]) if blocks else jnp.zeros(0, dtype)


def _rotating(layout: Layout):
    return [k for k, rotates in enumerate(layout.rotates) if rotates]


@on_host
def _with_scalars(system, guess):
    t, q, u = jnp.zeros((), guess.q.dtype), system.normalize(guess.q), guess.u
    layout = system.layout
    for g in system.inertial:
        scalars = g.group.body_index[:, -1]
        unmet = g.residual(t, system.prepared_poses(q))[:, 0]
        q = q.at[layout.pose_index[scalars, 0]].add(-unmet)
        unmet = g.velocity(t, system.prepared_poses(q), system.all_velocities(u))[:, 0]
        u = u.at[layout.velocity_index[scalars, 0]].add(-unmet)
    return q, u


def _of_rows(values: Array, count: int) -> Array:
    """The numbers of parts, once for each of their rows."""
    return values if count == 1 else jnp.repeat(values, count, axis=0)


def _combined(of_parts):
    """What some parts give, or one combination of many, with weights that let no two of them cancel."""
    parts = of_parts.shape[0]
    weights = np.random.default_rng(0).uniform(1.0, 2.0, parts).astype(of_parts.dtype)
    return of_parts if parts <= _MOST_OF_TIME else weights @ of_parts.reshape(parts, -1)
