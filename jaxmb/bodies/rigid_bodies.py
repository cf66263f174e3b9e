"""Rigid bodies joined by constraints and forces: the compiled form of a scene."""

import dataclasses
import itertools
from collections.abc import Callable
from operator import attrgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar, State, Velocities
from ..linalg.arrays import is_traced
from ..linalg.block_jacobian import BlockJacobian, JointOrder, block_jacobian
from ..linalg.inertia import AbstractInertia
from ..linalg.jacobian import DenseJacobian
from ..parts.base import AbstractLink
from ..solvers.manifold_term import GapsSeen
from ..system.contact_set import ContactLaws, ContactSet, LawTable
from ..system.design_variables import DesignVariables
from ..system.equation import Ranks
from ..system.system import AbstractSystem, GivenInTime
from .body_set import BodySet
from .catalogue import SceneCatalogue
from .constraint_set import ConstraintSet
from .contact_rows import contact_set
from .describe import describe_scene
from .field_jacobian import motion_jacobian
from .force_set import ForceSet
from .groups import AbstractGroup, ConstraintGroup, CoordinateGroup, FrameGroup, Kinematics, joined
from .host import host_scene
from .joint_coordinates import held_groups, wrapped_angles
from .joint_graph import extended_joint_order
from .layout import Layout
from .motion import coordinate_names, rate_names
from .parameters import SceneParameters
from .state_table import StateTable

# From this number of velocities on, implicit methods eliminate in blocks with the joints. (Dense matrices of small
# machines with joints are cheap.)
_LEAST_VELOCITIES = 40
# From this number of freedoms on, they do so with joints too few for block elimination, and with none. (A step of eight
# cars with draft gears, 24 freedoms: 0.5 ms in blocks, 6.4 ms by dense matrices; of a planar chain of beams on a pin,
# 39 freedoms: 0.35 and 1.0 ms, 145: 0.8 and 32 ms. A chain of rods, 14 freedoms: 0.7 and 0.4 ms.)
_LEAST_FREEDOMS = 24


class Implied(NamedTuple):
    """An implied row: `row` of part `name` follows from the joints `by`."""

    name: str
    row: int
    by: tuple[str, ...]


class RigidBodySystem(AbstractSystem):
    """A scene, compiled. Made by `Scene.compile`; a pytree whose leaves are the parameters.

    ```python
    system = jaxmb.Scene([bar], joints=[pin], forces=[jaxmb.Gravity((0.0, -9.81))]).compile()
    print(system)  # Bodies, coordinates, constraint rows and their ranks, degrees of freedom.
    system.body_names, system.coordinate_names(), system.joint_coordinates()
    ```

    **Fields:** the sets of `bodies`, `constraints` and `forces`; the groups of `frames`, and of `free_joints`, which
    have no rows; `guess`, the state given with the bodies; `length` [m], the scene's size; `ranks`; `implied` rows;
    `elimination`, the joints' order of elimination, or None; `design` variables; the `mass_matrix` of a prepared
    system; whether contacts imply each other, so that they have `shares` of forces; the `contacts` and dry friction.
    """

    bodies: BodySet
    constraints: ConstraintSet
    forces: ForceSet
    frames: tuple[FrameGroup, ...]
    free_joints: tuple[CoordinateGroup, ...]
    guess: State
    length: Float[Array, ""]
    ranks: Ranks = eqx.field()  # pyright: ignore[reportIncompatibleVariableOverride]
    implied: tuple[Implied, ...] = eqx.field(static=True)
    elimination: JointOrder | None = eqx.field(static=True)
    design: tuple[DesignVariables, ...] = ()
    mass_matrix: AbstractInertia | None = None
    shares: bool = eqx.field(static=True, default=False)
    contacts: ContactSet = eqx.field(static=True, init=False)  # pyright: ignore[reportIncompatibleVariableOverride]

    def __post_init__(self):
        self.contacts = contact_set(self.constraints.position, self.constraints.velocity, self.shares)

    # Sizes and names

    @property
    def layout(self) -> Layout:
        """Indices of the bodies' entries in coordinates and velocities."""
        return self.bodies.layout

    @property
    def nq(self) -> int:
        return self.layout.nq

    @property
    def nu(self) -> int:
        return self.layout.nu

    @property
    def spatial(self) -> bool:
        return self.layout.spatial

    @property
    def body_names(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.bodies.names

    def coordinate_names(self):
        return coordinate_names(self.layout, self.body_names)

    def rate_names(self):
        return rate_names(self.layout, self.body_names)

    @property
    def position_rows(self) -> int:
        return sum(g.row_count for g in self.constraints.position)

    @property
    def coordinate_rows(self) -> int:
        return self.position_rows + self.bodies.invariant_rows

    @property
    def velocity_rows(self) -> int:
        return self.position_rows + sum(g.row_count for g in self.constraints.velocity)

    @property
    def acceleration_rows(self) -> int:
        return sum(g.row_count for g in self.constraints.groups)

    @property
    def rows(self):
        # Parts with several components have one sequence of rows.
        names = [name for g in self.constraints.groups for name in g.group.names for _ in range(g.rows)]
        counts = {name: itertools.count() for name in names}
        return tuple((name, next(counts[name])) for name in names)

    # Bodies

    @property
    def mass(self) -> Float[Array, "b"]:
        """Masses [kg] of the bodies."""
        return self.bodies.mass

    @property
    def moments_of_inertia(self) -> Float[Array, "b *matrix"]:
        """Moments of inertia [kg m²] about the mass centres: a number in the plane, a matrix in body axes in space."""
        return self.bodies.moments_of_inertia

    def poses(self, q: Coordinates) -> Float[Array, "b p"]:
        """Poses of the bodies."""
        return self.bodies.poses(q)

    def velocities(self, u: Velocities) -> Float[Array, "b v"]:
        """Velocities of the bodies."""
        return self.bodies.velocities(u)

    def kinematics(self, t: Scalar, q: Coordinates, u: Velocities) -> Kinematics:
        """The arguments of kernels of stacked parts."""
        return self.moving(self.placed(t, q), u)

    def _moving(self, t, q, u, now):
        return self.kinematics(t, q, u) if now is None else now

    @eqx.filter_jit
    def placed(self, t, q):
        return self.constraints.placed(jnp.asarray(t, q.dtype), self.bodies.prepared_poses(q))

    @eqx.filter_jit
    def moving(self, placed, u):
        return self.constraints.moving(placed, self.bodies.all_velocities(u))

    @property
    def rates_are_velocities(self) -> bool:
        return not self.spatial and not self.bodies.turn_counts

    def rates(self, t, q, u):
        return u if self.rates_are_velocities else self.bodies.rates(t, q, u)

    def normalize(self, t, q):
        return q if self.rates_are_velocities else self.bodies.normalize(t, q)

    def with_unit_attitudes(self, q):
        return self.bodies.with_unit_attitudes(q) if self.layout.turning else q

    def normalize_fixed(self, q, fixed):
        return self.bodies.normalize_fixed(q, fixed)

    def held_velocities(self, held):
        return held if self.rates_are_velocities else self.bodies.held_velocities(held)

    def inertia(self, t, q, u):
        if self.mass_matrix is not None:
            return self.mass_matrix
        return self.bodies.inertia(q, self.constraints.scalar_inertias)

    @eqx.filter_jit
    def kinetic_energy(self, t, q, u):
        return 0.5 * jnp.dot(u, self.inertia(t, q, u).product(u))

    def linear_momentum(self, q, u):
        return self.bodies.linear_momentum(self.inertia(0.0, q, u).product(u))

    def angular_momentum(self, q, u):
        return self.bodies.angular_momentum(q, self.inertia(0.0, q, u).product(u))

    def coordinate_scale(self):
        return jnp.where(self.layout.coordinate_lengths, lax.stop_gradient(self.length), 1.0)

    def velocity_scale(self):
        return jnp.where(self.layout.velocity_lengths, lax.stop_gradient(self.length), 1.0)

    def known_scales(self) -> tuple[Float[np.ndarray, "nq"], Float[np.ndarray, "nu"]]:
        """Scales of coordinates and velocities in NumPy, also within a trace, of a system that is not traced."""
        lengths = self.layout.coordinate_lengths, self.layout.velocity_lengths
        of_coordinates, of_velocities = (np.where(is_length, np.asarray(self.length), 1.0) for is_length in lengths)
        return of_coordinates, of_velocities

    # Forces. Each kernel is jitted, so a program with many uses traces it once.

    @eqx.filter_jit
    def force(self, t, q, u, now=None):
        now = self._moving(t, q, u, now)
        wrenches = [*self.forces.wrenches(now), *self.bodies.wrenches(now, self.forces.gravity)]
        return self.bodies.generalized_force(wrenches, u)

    @eqx.filter_jit
    def potential_energy(self, t, q):
        return self._with_gravity(self.forces.energy(t, self.bodies.prepared_poses(q)), q)

    @eqx.filter_jit
    def energy_in_motion(self, t, q, u):
        return self._with_gravity(self.forces.energy_in_motion(self.kinematics(t, q, u)), q)

    def _with_gravity(self, energy, q):
        return sum(self.bodies.potential_energy(q, self.forces.gravity), start=energy)

    @property
    def state_ends(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return tuple(state.stop for state in self.state_table.fields)

    @property
    def state_table(self) -> StateTable:
        """The internal states of the parts."""
        return StateTable(self)

    def state_names(self):
        return self.state_table.names()

    def with_states(self, z):
        return self.state_table.held(z)

    def state_rates(self, t, q, u):
        return self.state_table.rates(self.kinematics(t, q, u))

    def state_scale(self):
        return lax.stop_gradient(self.state_table.scale(self.length.dtype))

    # Constraints

    @eqx.filter_jit
    def position_residual(self, t, q):
        return self.constraints.residual(t, self.bodies.prepared_poses(q))

    def coordinate_residual(self, t, q):
        residual = self.position_residual(t, q)
        return residual if self.rates_are_velocities else jnp.concatenate([residual, *self.bodies.invariants(t, q)])

    @eqx.filter_jit
    def coordinate_jacobian(self, t, q):
        if self.rates_are_velocities:
            rest = self.kinematics(t, q, jnp.zeros(self.nu, q.dtype))
            return self.constraints.jacobian(rest, self.constraints.position)
        poses = self.bodies.prepared_poses(q)
        rows = self.constraints.jacobian_of_poses(t, poses, self.bodies.turn_counts)
        return jnp.concatenate([rows, self.bodies.attitude_gradients(q)])

    @eqx.filter_jit
    def velocity_residual(self, t, q, u, now=None):
        return self.constraints.velocity_residual(self._moving(t, q, u, now))

    @eqx.filter_jit
    def acceleration_residual(self, t, q, u, udot, now=None):
        now = self._moving(t, q, u, now)
        return self.constraints.acceleration_residual(now, self.bodies.all_velocities(udot))

    @eqx.filter_jit
    def jacobian(self, t, q, u, now=None):
        now = self._moving(t, q, u, now)
        return self.constraints.jacobian(now, self.constraints.groups)

    def structured_jacobian(self, t, q, u, now=None):
        if self.elimination is None:
            return DenseJacobian(self.jacobian(t, q, u, now))
        return self.block_jacobian(t, q, u, self.elimination, now)

    def block_jacobian(self, t: Scalar, q: Coordinates, u: Velocities, order: JointOrder, now=None) -> BlockJacobian:
        """`A` in blocks of joints on bodies."""
        now = self._moving(t, q, u, now)
        return block_jacobian(self.constraints.blocks(now, self.constraints.groups), order)

    @eqx.filter_jit
    def constraint_force(self, t, q, u, multipliers, now=None):
        now = self._moving(t, q, u, now)
        return self.bodies.generalized_force(self.constraints.wrenches(now, multipliers), u)

    @property
    def linear(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return all(g.group.part.linear for g in self.constraints.velocity)

    @property
    def drift_free(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        groups = self.constraints
        return not any(g.rheonomic for g in groups.position) and all(g.homogeneous for g in groups.velocity)

    @property
    def ideal(self) -> bool:
        return not self.constraints.laws

    @property
    def ideal_without_friction(self) -> bool:
        return not self.constraints.nonideal and not self.constraints.servos

    @property
    def friction_rows(self):
        parts = {name for g in self.constraints.laws if g.needs != "nothing" for name in g.joints}
        return np.array([k for k, (name, _) in enumerate(self.rows) if name in parts], int)

    @eqx.filter_jit
    def nonideal_force(self, t, q, u, multipliers, now=None):
        now = self._moving(t, q, u, now)
        wrenches = self.constraints.nonideal_wrenches(self.constraints.laws, now, multipliers)
        return self.bodies.generalized_force(wrenches, u)

    # Contacts and dry friction

    def contact_laws(self, t):
        contacts, frictions, dtype = self.constraints.contacts, self.constraints.frictions, self.length.dtype
        normal, slip = (LawTable.of((g.laws(t) for g in groups), dtype) for groups in (contacts, frictions))
        return ContactLaws(normal, slip, joined([g.group.at(t).peak for g in contacts], dtype))

    @property
    def has_gaps(self):
        return bool(self.forces.with_gaps)

    @eqx.filter_jit
    def gaps_seen(self, t, q, u):
        now = self.kinematics(t, q, u)
        seen = [g.gaps(now) for g in self.forces.with_gaps]
        gaps, rates, widths, paces = (
            jnp.concatenate([x.ravel() for x in values]) for values in zip(*seen, strict=True)
        )
        return GapsSeen(gaps, rates, widths, jnp.max(paces))

    @property
    def with_headings(self) -> tuple[AbstractGroup, ...]:
        """The groups of parts with headings."""
        groups = (*self.constraints.groups, *self.forces.groups)
        return tuple(
            g for g in groups if isinstance(g.group.part, AbstractLink) and g.group.part.lost_heading is not None
        )

    @eqx.filter_jit
    def headings(self, t, q):
        poses = self.bodies.plain_poses(q)
        return jnp.concatenate([g.headings(t, poses) for g in self.with_headings])

    @eqx.filter_jit
    def friction_reactions(self, t, q, u, multipliers, now=None):
        laws = [g.law for g in self.constraints.frictions]
        now = self._moving(t, q, u, now)
        reactions = self.constraints.reactions(laws, now, multipliers)
        return jnp.concatenate([g.normal_forces(now, x) for g, x in zip(laws, reactions, strict=True)])

    # Motions and assembly

    def prepared(self):
        mass = self.mass_matrix
        if mass is None and self.bodies.constant_inertia:
            mass = self.bodies.inertia(self.guess.q, self.constraints.scalar_inertias)
            mass = mass.with_inverse(self.guess.u) if self.spatial and self.acceleration_rows else mass
        constraints, bodies = self.constraints.prepared(), self.bodies.prepared()
        return dataclasses.replace(self, constraints=constraints, bodies=bodies, mass_matrix=mass)

    def closing(self):
        # In the plane a residual distinguishes full turns; a product of vectors does not.
        return self.prepared() if self.spatial else self

    def half_turned(self, q):
        if self.constraints.elements is None:
            return False
        return self.constraints.half_turned(self.bodies.prepared_poses(q))

    def on_host(self, t):
        return None if is_traced((self, t)) else host_scene(self, t)

    def wrapped_angle_names(self):
        if not self.spatial:
            return ()
        return tuple(name for name, known in self.joint_coordinates().items() if known.place is not None)

    def wrapped_angles(self, t, q):
        return wrapped_angles(self.measured, t, self.bodies.prepared_poses(q))

    def holding(self, values, rates, t):
        held = held_groups(self.measured, self.joint_coordinates(), values, rates, t)
        rows = sum(g.rows for g in held)
        constraints = dataclasses.replace(self.constraints, position=(*self.constraints.position, *held))
        ranks = Ranks(*(rank + rows for rank in dataclasses.astuple(self.ranks)))
        out = dataclasses.replace(self, constraints=constraints, ranks=ranks, elimination=None)
        if self.elimination is None:
            return out
        return dataclasses.replace(out, elimination=extended_joint_order(out, self, self.elimination))

    # Implicit methods

    @property
    def has_field_jacobian(self) -> bool:
        return self.nz == 0

    @property
    def implicit_in_blocks(self) -> bool:
        plain = self.ideal_on_velocities and self.has_field_jacobian and not self.layout.flexible
        if self.elimination is not None:
            return plain and self.nu >= _LEAST_VELOCITIES
        independent = self.linear and self.acceleration_rank == self.acceleration_rows
        return plain and independent and self.nu - self.velocity_rank >= _LEAST_FREEDOMS

    def field_jacobian(self, t, y):
        return motion_jacobian(self, t, y)

    # Names

    @property
    def parameter_table(self):
        return SceneParameters(self)

    def parameter_paths(self):
        return self.parameter_table.paths()

    @property
    def catalogue(self):
        return SceneCatalogue(self)

    @property
    def measured(self) -> tuple[ConstraintGroup | CoordinateGroup, ...]:
        """The groups of parts that have coordinates."""
        return (*self.constraints.position, *self.bodies.tendons, *self.free_joints)

    def describe(self):
        return describe_scene(self)

    # Functions of time

    @property
    def of_time(self):
        return bool(self._in_time)

    def given_in_time(self, t, q, u):
        now = self.kinematics(t, q, u)
        groups = [where(self) for where in self._in_time]
        values = [g.in_time(now) for g in groups]
        turning = [g.turning(of_group) for g, of_group in zip(groups, values, strict=True) if g.ends_at_turns]
        return GivenInTime(joined(turning, q.dtype), joined(values, q.dtype))

    def with_strengths(self, change):
        parts = lambda system: [where(system).group.part for where in self._in_time]
        return eqx.tree_at(parts, self, change(parts(self)))

    @property
    def _in_time(self) -> list[Callable[[Any], AbstractGroup]]:
        """Accessors of the groups with functions of time."""
        sets = *(f"constraints.{kind}" for kind in ("position", "velocity", "servos", "nonideal")), "forces.groups"
        places = [(path, k) for path in sets for k, g in enumerate(attrgetter(path)(self)) if g.group.of_time]
        return [lambda system, path=path, k=k: attrgetter(path)(system)[k] for path, k in places]
