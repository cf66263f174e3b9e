"""Rigid bodies joined by constraints and forces: the compiled form of a scene."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.arrays import unchecked_take
from ..linalg.block_jacobian import BlockJacobian, JointOrder, block_jacobian
from ..linalg.inertia import AbstractInertia, BlockInertia, DiagonalInertia
from ..linalg.jacobian import DenseJacobian
from ..linalg.rotations import cross, rotate
from ..linalg.sums import placed_sums
from .bodies import AbstractBodySystem
from .layout import Layout
from .reactions import nonideal_wrenches, reaction_wrenches


class RigidBodySystem(AbstractBodySystem):
    """A scene, compiled. Made by `Scene.compile`; a pytree whose leaves are the parameters.

    **Fields:** the groups of `bodies` and of other parts; `gravity` [m/s²] or None; `guess`, the state given with the
    bodies; `length` [m], the scene's size; `body_names`; `elimination`, the order in which the joints are
    eliminated, or None.
    """

    # Constraints. Each kernel is a compiled function, so that it is traced once for all its uses in a program.

    @eqx.filter_jit
    def position_residual(self, t, q):
        poses = self.prepared_poses(q)
        return _join([g.residual(t, poses) for g in self.constraints], q.dtype)

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
        unit = jnp.eye(self.layout.space.pose_size, dtype=q.dtype)
        along = lambda x: jax.vmap(lambda dx: jax.jvp(self.layout.space.prepare, (x,), (dx,))[1])(unit)
        moves = jax.vmap(along)(poses[:, : self.layout.space.pose_size])
        groups = (*self.constraints, *self.turn_counts)
        blocks = [g.along(t, poses, moves) for g in groups]
        jacobian = self._assemble(blocks, groups, q.dtype, of_poses=True)
        rotating = _rotating(self.layout)
        index = self.layout.pose_index[rotating, 3:]
        rows = jnp.zeros((len(rotating), self.nq), q.dtype).at[jnp.arange(len(rotating))[:, None], index].set(q[index])
        return jnp.concatenate([jacobian, rows])

    @eqx.filter_jit
    def velocity_residual(self, t, q, u):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        groups = (*self.constraints, *self.velocity_constraints)
        return _join([g.velocity(t, poses, velocities) for g in groups], q.dtype)

    @eqx.filter_jit
    def jacobian(self, t, q, u):
        return self._jacobian(t, q, u, self.joints)

    def structured_jacobian(self, t, q, u):
        if self.elimination is None:
            return DenseJacobian(self.jacobian(t, q, u))
        return self.block_jacobian(t, q, u, self.elimination)

    def block_jacobian(
        self, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"], order: JointOrder
    ) -> BlockJacobian:
        """`A` in blocks of joints on bodies."""
        blocks = [*self._blocks(t, q, u, self.joints), jnp.zeros(1, q.dtype)]
        return block_jacobian(_join(blocks, q.dtype), order)

    def _blocks(self, t, q, u, groups):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        return [g.jacobian(t, poses, velocities) for g in groups]

    def _jacobian(self, t, q, u, groups):
        blocks = self._blocks(t, q, u, groups)
        return self._assemble(blocks, groups, q.dtype, of_poses=False)

    @eqx.filter_jit
    def constraint_force(self, t, q, u, multipliers):
        wrenches = reaction_wrenches(self.joints, t, self.prepared_poses(q), self.all_velocities(u), multipliers)
        return self._add_up(wrenches, [g.group.body_index for g in self.joints], u.dtype)

    @eqx.filter_jit
    def nonideal_force(self, t, q, u, multipliers):
        poses, velocities = self.prepared_poses(q), self.all_velocities(u)
        wrenches = nonideal_wrenches(self.joints, self.nonideal, t, poses, velocities, multipliers)
        return self._add_up(wrenches, [g.group.body_index for g in self.nonideal], u.dtype)

    @eqx.filter_jit
    def acceleration_residual(self, t, q, u, udot):
        t = jnp.asarray(t, q.dtype)
        poses, velocities, accelerations = self.prepared_poses(q), self.all_velocities(u), self.all_velocities(udot)
        return _join([g.acceleration(t, poses, velocities, accelerations) for g in self.joints], q.dtype)

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
        found = [(g.group.body_index[:, -1], g.group.part.inertia) for g in self._inertial]
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
            bodies.append(_all_bodies(self.layout))
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

    def gyroscopic_damping(self, u: Float[Array, "nu"]) -> Float[Array, "ground v v"]:
        """The derivative of each body's gyroscopic moment with respect to its own velocity; zeros for scalar
        coordinates.
        """
        size = self.layout.space.velocity_size
        if not self.spatial:
            return jnp.zeros((self.layout.ground, size, size), u.dtype)
        moment = lambda J, w: -cross(w, J @ w)
        own = jax.vmap(jax.jacfwd(moment, argnums=1))(self.moments_of_inertia, self.velocities(u)[:, 3:])
        return jnp.pad(own, ((0, len(self.layout.scalars)), (3, 0), (3, 0)))

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

    def linear_momentum(self, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "d"]:
        """`Σ m v` [kg m/s], world axes."""
        del q
        return self.mass @ self.velocities(u)[:, : self.layout.space.dimension]

    def angular_momentum(self, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "*d"]:
        """Moment of momentum about the world origin [kg m²/s]; a scalar in the plane, shape (3,) in world axes in
        space.
        """
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

    def _scale(self, index, size):
        length = lax.stop_gradient(self.length)
        translation = [False] * size
        for body in index[: self.layout.bodies]:
            for k in body[: self.layout.space.dimension]:
                translation[k] = True
        for own, row in zip(self.layout.scalars, index[self.layout.bodies : -1], strict=True):
            if row[0] < size:
                translation[row[0]] = own.is_length
        return jnp.where(np.array(translation), length, 1.0)


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


def _all_bodies(layout: Layout):
    return np.arange(layout.bodies)[:, None]
