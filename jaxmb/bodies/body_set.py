"""The bodies of a scene and the scalar coordinates of its parts: kinematics, inertia and momentum."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar, State, Velocities
from ..linalg.arrays import is_traced, namespace, replaced
from ..linalg.inertia import AbstractInertia, BlockInertia, CoupledInertia, DiagonalInertia
from ..linalg.rotations import cross, normalize, rotate
from ..linalg.sums import placed_sums, unchecked_take
from ..parts.fields import internal_states
from .groups import Acting, BodyGroup, BodyPoses, BodyVelocities, ConstraintGroup, CoordinateGroup, Kinematics
from .layout import Layout

# The error of a squared length by rounding, in units of eps.
_UNIT = 16


class BodySet(eqx.Module):
    """Groups of bodies.

    **Fields:** `groups` of bodies; groups of `tendons`, some with scalar coordinates that count turns; `names` of the
    bodies; the `layout` of bodies and scalar coordinates.
    """

    groups: tuple[BodyGroup, ...]
    tendons: tuple[CoordinateGroup, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)

    @property
    def mass(self) -> Float[Array, "b"]:
        """Masses [kg] of the bodies."""
        return self._in_order([g.mass for g in self.groups])

    @property
    def moments_of_inertia(self) -> Float[Array, "b *matrix"]:
        """Moments of inertia [kg m²] about the mass centres: a number in the plane, a matrix in body axes in space."""
        return self._in_order([g.inertia for g in self.groups])

    def _in_order(self, of_groups):
        """Per-body values of all groups, in the order of the bodies."""
        if len(of_groups) == 1:
            return of_groups[0]
        order = np.argsort(np.concatenate([g.group.body_index[:, 0] for g in self.groups]))
        return unchecked_take(jnp.concatenate(of_groups), order)

    # Kinematics

    def kinematics(self, t: Scalar, q: Coordinates, u: Velocities) -> Kinematics:
        """Prepared poses and velocities, the arguments of kernels."""
        return Kinematics(jnp.asarray(t, q.dtype), self.prepared_poses(q), self.all_velocities(u))

    def plain_poses(self, q: Coordinates) -> BodyPoses:
        """Poses that are not prepared, in the order of `prepared_poses`: for few parts the fewer instructions."""
        return jnp.concatenate([self._poses(q), jnp.asarray(self.layout.space.ground, q.dtype)[None]])

    def prepared_poses(self, q: Coordinates) -> BodyPoses:
        """Prepared poses of the bodies, of scalar coordinates and of the ground."""
        prepare = self.layout.space.prepare
        constant: Any = np.array(self.layout.space.ground)
        ground = jnp.asarray(prepare(constant), q.dtype)
        # A barrier: XLA would compute cheap values anew in each kernel that uses them.
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

    def _pack(self, poses):
        raveled = poses.reshape(-1)
        return raveled if self.layout.uniform else unchecked_take(raveled, self.layout.coordinate_place)

    def rates(self, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "nq"]:
        """Rates of the coordinates."""
        rates = self._pack(jax.vmap(self.layout.space.rates)(self._poses(q), self._velocities(u)))
        for g in self.turn_counts:
            rates = rates.at[self._places(g)].set(-g.velocity(self.kinematics(t, q, u)))
        return rates

    def normalize(self, t: Scalar, q: Coordinates) -> Float[Array, "nq"]:
        """Coordinates with Euler parameters of length one, and with exact counts of turns."""
        q = self._pack(jax.vmap(self.layout.space.normalize)(self._poses(q)))
        for g in self.turn_counts:
            unmet = g.residual(jnp.asarray(t, q.dtype), self.prepared_poses(q))
            q = q.at[self._places(g)].add(-unmet)
        return q

    def with_unit_attitudes(self, q: Coordinates) -> Float[Array, "nq"]:
        """Coordinates with Euler parameters of length one; the same array if they have this length."""
        index = self.layout.pose_index[self.layout.turning, 3:]
        if not is_traced(q):
            squares = np.sum(np.asarray(q)[index] ** 2, axis=1)
            if np.all(np.abs(squares - 1.0) <= _UNIT * np.finfo(q.dtype).eps):
                return q
        return replaced(q, index.reshape(-1), normalize(namespace(q).asarray(q)[index]).reshape(-1))

    @property
    def turn_counts(self) -> tuple[ConstraintGroup, ...]:
        """The groups of tendons with scalar coordinates. Normalised coordinates make their residuals vanish."""
        return tuple(ConstraintGroup(g.group) for g in self.tendons if g.group.part.rows)

    def _places(self, group):
        """Indices in q of the counts of turns of stacked tendons, shape (parts, rows)."""
        # They are the last of a tendon's bodies.
        return self.layout.pose_index[group.group.body_index[:, -group.rows :], 0]

    # Invariants of the coordinates: counts of turns, and Euler parameters of length one

    @property
    def invariant_rows(self) -> int:
        """The number of invariants."""
        return sum(g.row_count for g in self.turn_counts) + len(self.layout.turning)

    def invariants(self, t: Scalar, q: Coordinates) -> list[Float[Array, "_"]]:
        """Residuals of the invariants, as consecutive pieces."""
        p = self.poses(q)[np.array(self.layout.turning, int), 3:]
        lengths = 0.5 * (jnp.sum(p * p, axis=1) - 1.0)
        if not self.turn_counts:
            return [lengths]
        poses = self.prepared_poses(q)
        return [*(g.residual(t, poses).reshape(-1) for g in self.turn_counts), lengths]

    def attitude_gradients(self, q: Coordinates) -> Float[Array, "turning nq"]:
        """Derivatives of the residuals of Euler parameters with respect to q."""
        index = self.layout.pose_index[self.layout.turning, 3:]
        return jnp.where((index[:, :, None] == np.arange(self.layout.nq)).any(1), q[None], 0.0)

    def normalize_fixed(self, q: Coordinates, fixed: np.ndarray) -> tuple[Float[Array, "nq"], int]:
        """Coordinates with fixed Euler parameters of length one, and the number of bodies with such parameters."""
        turns = self.layout.pose_index[self.layout.turning, 3:]
        whole = turns[np.all(fixed[turns], axis=1)]
        for index in whole:
            q = q.at[index].set(normalize(q[index]))
        return q, len(whole)

    def held_velocities(self, held: np.ndarray) -> np.ndarray | None:
        """The velocities that leave held coordinates unchanged; None where a rotation is held in part."""
        d = self.layout.space.dimension
        of_pose = np.append(held, np.ones(self.layout.space.pose_size, bool))[self.layout.pose_index[:-1]]
        turns = of_pose[:, d:]
        if np.any(np.any(turns, axis=1) & ~np.all(turns, axis=1)):
            return None
        of_bodies = np.concatenate(
            [of_pose[:, :d], np.repeat(turns[:, :1], self.layout.space.velocity_size - d, axis=1)], axis=1
        )
        return of_bodies.reshape(-1)[self.layout.velocity_place]

    def shifted(self, guess: State, moved: Sequence[tuple[BodyGroup, Float[Array, "parts d"]]]) -> State:
        """The state after the mass centres of some groups moved within their bodies."""
        space, q, u = self.layout.space, guess.q, guess.u
        poses, velocities = self.poses(q), self.velocities(u)
        for group, shift in moved:
            bodies, d = group.group.body_index[:, 0], space.dimension
            velocity = jax.vmap(space.point_velocity)(poses[bodies], velocities[bodies], shift)
            q = q.at[self.layout.pose_index[bodies, :d]].add(jax.vmap(space.direction)(poses[bodies], shift))
            u = u.at[self.layout.velocity_index[bodies, :d]].set(velocity)
        return dataclasses.replace(guess, q=q, u=u)

    # Inertia and forces

    def prepared(self) -> Self:
        """The set for the steps of a motion, with values that depend on parameters alone computed once."""
        return dataclasses.replace(self, groups=tuple(g.prepared() for g in self.groups)) if self.flexible else self

    @property
    def constant_inertia(self) -> bool:
        """Whether the inertia is the same at all times."""
        return not self.layout.flexible and not any(internal_states(g.group.part) for g in self.groups)

    @property
    def flexible(self) -> tuple[Any, ...]:
        """The groups of flexible bodies."""
        return tuple(g for g in self.groups if g.is_flexible)

    def inertia(self, q: Coordinates, of_scalars: Sequence[tuple[np.ndarray, Array]]) -> AbstractInertia:
        """M, from the bodies and pairs `of_scalars`: indices of scalar coordinates, and their inertias."""
        rigid = self._rigid_inertia(of_scalars)
        if not self.layout.flexible:
            return rigid
        poses, index = self.prepared_poses(q), self.layout.mass_index
        velocities = lambda bodies: tuple(tuple(row[row < self.layout.nu].tolist()) for row in index[bodies])
        return CoupledInertia(
            rigid,
            tuple(g.mass_matrices(poses) for g in self.flexible),
            tuple(velocities(g.group.body_index[:, 0]) for g in self.flexible),
        )

    def _rigid_inertia(self, of_scalars):
        """M of rigid bodies and scalar coordinates; entries of flexible bodies have no meaning."""
        if self.layout.spatial and self.layout.uniform:
            return BlockInertia(self.mass, self.moments_of_inertia)
        mass = self._masses_of_coordinates(of_scalars)
        if self.layout.spatial:
            points = np.array([not rotates for rotates in self.layout.rotates])[:, None, None]
            # A unit moment of inertia makes the matrix regular for point masses and scalar coordinates, without effect.
            moments = self.moments_of_inertia
            unit = jnp.eye(3, dtype=moments.dtype)
            units = jnp.tile(unit, (len(self.layout.scalars), 1, 1))
            moments = jnp.concatenate([jnp.where(points, unit, moments), units])
            return _MixedInertia(BlockInertia(mass, moments), self.layout)
        moments = jnp.pad(self.moments_of_inertia, (0, len(self.layout.scalars)))
        columns = [jnp.repeat(mass[:, None], 2, axis=1), moments[:, None]]
        bodies = jnp.concatenate(columns, axis=1)
        if self.layout.uniform:
            return DiagonalInertia(bodies.reshape(-1))
        return DiagonalInertia(bodies.reshape(-1)[self.layout.velocity_place])

    def _masses_of_coordinates(self, of_scalars):
        """The entry of each body and scalar coordinate in the mass matrix, [kg] or [kg m²].

        Coordinates that do not move, and modal coordinates, have the entry 1, which has no effect.
        """
        if not self.layout.scalars:
            return self.mass
        modal = [k for _, *modes in self.layout.flexible for k in modes]
        fixed = [
            k for k, scalar in enumerate(self.layout.scalars, self.layout.bodies) if not scalar.moves or k in modal
        ]
        order = np.argsort(np.concatenate([*(numbers for numbers, _ in of_scalars), fixed]).astype(int))
        ones = jnp.ones(len(fixed), self.mass.dtype)
        inertias = unchecked_take(jnp.concatenate([*(inertia for _, inertia in of_scalars), ones]), order)
        return jnp.concatenate([self.mass, inertias])

    def wrenches(self, now: Kinematics, gravity: Float[Array, "d"] | None) -> list[Acting]:
        """Gravity, and inertia forces without accelerations, such as the gyroscopic moment `−ω × J ω`."""
        size, dimension = self.layout.space.velocity_size, self.layout.space.dimension
        parts, coupled = [], [(g.wrenches(now, gravity), g.group.body_index) for g in self.flexible]
        if gravity is not None:
            mass = self._of_rigid(self.mass)
            parts.append(jnp.pad(mass[:, None] * gravity[None, :], ((0, 0), (0, size - dimension))))
        if self.layout.turning:
            omega = now.velocities[: self.layout.bodies, 3:]
            moments = self._of_rigid(self.moments_of_inertia)
            moment = -jax.vmap(lambda J, w: cross(w, J @ w))(moments, omega)
            parts.append(jnp.pad(moment, ((0, 0), (3, 0))))
        if not parts:
            return coupled
        return [(sum(parts[1:], start=parts[0]), np.arange(self.layout.bodies)[:, None]), *coupled]

    def _of_rigid(self, of_bodies):
        """Values of the bodies, with zeros for flexible bodies."""
        flexible = [body for body, *_ in self.layout.flexible]
        return of_bodies.at[np.array(flexible)].set(0.0) if flexible else of_bodies

    def generalized_force(self, acting: Sequence[Acting], u: Velocities) -> Float[Array, "nu"]:
        """The generalized force of wrenches on bodies."""
        if not acting:
            return jnp.zeros_like(u)
        size = self.layout.space.velocity_size
        entries = jnp.concatenate([wrenches.reshape(-1, size) for wrenches, _ in acting])
        bodies = np.concatenate([bodies.ravel() for _, bodies in acting])
        of_bodies = placed_sums(bodies, self.layout.ground)(entries).reshape(-1)
        return of_bodies if self.layout.uniform else unchecked_take(of_bodies, self.layout.velocity_place)

    def gyroscopic_damping(self, now: Kinematics) -> Float[Array, "ground v v"]:
        """Derivatives of each body's gyroscopic moment by its velocity; zeros for scalar coordinates."""
        size = self.layout.space.velocity_size
        if not self.layout.spatial:
            return jnp.zeros((self.layout.ground, size, size), now.poses.dtype)
        moment = lambda J, w: -cross(w, J @ w)
        omega = now.velocities[: self.layout.bodies, 3:]
        blocks = jax.vmap(jax.jacfwd(moment, argnums=1))(self.moments_of_inertia, omega)
        return jnp.pad(blocks, ((0, len(self.layout.scalars)), (3, 0), (3, 0)))

    def potential_energy(self, q: Coordinates, gravity: Float[Array, "d"] | None) -> list[Float[Array, ""]]:
        """Potential energies [J] in a field of gravity, and of the elasticity of flexible bodies."""
        out = [g.energy(self.prepared_poses(q), gravity) for g in self.flexible]
        if gravity is None:
            return out
        heights = self.poses(q)[:, : self.layout.space.dimension] @ gravity
        return [-jnp.sum(self._of_rigid(self.mass) * heights), *out]

    def linear_momentum(self, p: Velocities) -> Float[Array, "d"]:
        """Linear momentum [kg m/s], from the momenta `M u`."""
        return jnp.sum(self.velocities(p)[:, : self.layout.space.dimension], axis=0)

    def angular_momentum(self, q: Coordinates, p: Velocities) -> Float[Array, "*d"]:
        """Angular momentum [kg m²/s] about the world origin, from the momenta `M u`."""
        poses, momenta = self.poses(q), self.velocities(p)
        if not self.layout.spatial:
            x, of_translation = poses[:, :2], momenta[:, :2]
            return jnp.sum(x[:, 0] * of_translation[:, 1] - x[:, 1] * of_translation[:, 0] + momenta[:, 2])
        spin = jax.vmap(rotate)(poses[:, 3:], momenta[:, 3:])
        return jnp.sum(spin + jax.vmap(cross)(poses[:, :3], momenta[:, :3]), axis=0)


class _MixedInertia(AbstractInertia):
    """Inertia of spatial bodies, point masses and scalar coordinates.

    **Fields:** `blocks`, with unit blocks for the rotations of bodies that do not rotate; the `layout`.
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
