"""The derivative of the equations of motion along the constraints, with the structure of a scene's graph.

A part acts on its bodies only, so derivatives of its wrenches are a small matrix of blocks. Parts of one type are
differentiated together.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from .._types import Scalar, State
from ..linalg.block_elimination import BlockFactor, eliminate_blocks
from ..linalg.block_jacobian import BlockJacobian
from ..linalg.blocks import transpose_vector_products, vector_products
from ..linalg.inertia import AbstractInertia
from ..linalg.jacobian import MassProjector
from ..linalg.sums import unchecked_take
from ..solvers.manifold_term import AbstractFieldJacobian, AbstractResolvent
from .groups import Kinematics
from .layout import Layout
from .motion_graph import MotionOrder, motion_order


def contributions(
    system: Any, now: Kinematics, multipliers: Float[Array, "m"]
) -> tuple[Float[Array, "e v v"], Float[Array, "e v v"]]:
    """K and D: derivatives of the wrenches of forces and constraints, at fixed multipliers.

    K is the derivative by displacements along velocities, D by velocities. Each part contributes a block for each
    ordered pair of its bodies, with the loaded body first. Blocks of gyroscopic moments follow.
    """
    size = system.layout.space.velocity_size
    stiffness, damping = [], []
    for g in system.forces.groups:
        both = g.derivatives(now)
        for parts, blocks in zip((stiffness, damping), both, strict=True):
            parts.append(_by_pairs(blocks))
    for g, of_group in system.constraints.of_groups(multipliers):
        stiffness.append(_by_pairs(g.wrench_derivatives(now, of_group)))
        damping.append(jnp.zeros_like(stiffness[-1]))
    gyroscopic = system.bodies.gyroscopic_damping(now)
    stiffness.append(jnp.zeros_like(gyroscopic))
    damping.append(gyroscopic)
    join = lambda blocks: jnp.concatenate([block.reshape(-1, size, size) for block in blocks])
    return join(stiffness), join(damping)


def _by_pairs(blocks: Float[Array, "parts k v k v"]) -> Float[Array, "parts k k v v"]:
    return jnp.moveaxis(blocks, 3, 2)


class MotionJacobian(AbstractFieldJacobian):
    """J of `q̇ = N u, M u̇ = F + Aᵀ λ` at a state, without the changes of A and N along the motion.

    **Fields:** `stiffness` K and `damping` D (pairs, v, v): derivatives of forces and of constraint forces at fixed
    multipliers, for pairs of bodies; `mass` M (bodies, v, v); `moves` N (bodies, v, p), a row for each velocity;
    `projector` on the constraints, and `rows`: the blocks of A, both None without constraints; the number of
    `position_rows`; the `order` of elimination; the `layout` of the bodies.
    """

    stiffness: Float[Array, "pairs v v"]
    damping: Float[Array, "pairs v v"]
    mass: Float[Array, "b v v"]
    moves: Float[Array, "b v p"]
    projector: MassProjector | None
    rows: BlockJacobian | None
    position_rows: int = eqx.field(static=True)
    order: MotionOrder = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)

    def project(self, x):
        move, velocity = self.of_bodies(x)
        if self.projector is None:
            return self.raveled(move, velocity)
        place, index = self.layout.velocity_place, self.layout.velocity_index[:-1]
        both = unchecked_take(jnp.stack([move.ravel(), velocity.ravel()], axis=1), place).T
        product = self.projector.jacobian.product
        residual = jnp.stack([product(both[0]), product(both[1])])
        binds_positions = np.arange(residual.shape[1]) < self.position_rows
        residual = residual.at[0].set(jnp.where(binds_positions, residual[0], 0.0))
        # A loop, to compile the projection once for displacement and velocity.
        both = both + lax.map(self.projector.cancel, residual)
        move, velocity = (unchecked_take(jnp.append(values, 0.0), index) for values in both)
        return self.raveled(move, velocity)

    def of_bodies(self, x: Array) -> tuple[Array, Array]:
        """Displacements along velocities, and changes of velocities, (bodies, v) each, from a change of the state."""
        nq = self.layout.nq
        zero = jnp.zeros(self.layout.space.pose_size, x.dtype)
        poses = unchecked_take(jnp.concatenate([x[:nq], zero]), self.layout.pose_index[:-1])
        # The rows of N are orthogonal.
        inverse = self.moves / jnp.sum(self.moves**2, axis=2, keepdims=True)
        velocities = unchecked_take(jnp.append(x[nq:], zero[0]), self.layout.velocity_index[:-1])
        return vector_products(inverse.astype(x.dtype), poses), velocities

    def raveled(self, move: Array, velocity: Array) -> Array:
        """The inverse of `of_bodies`."""
        poses = transpose_vector_products(self.moves.astype(move.dtype), move)
        layout = self.layout
        return jnp.concatenate(
            [
                unchecked_take(poses.ravel(), layout.coordinate_place),
                unchecked_take(velocity.ravel(), layout.velocity_place),
            ]
        )

    def resolvent(self, r):
        order, dtype = self.order, jnp.result_type(r)
        bodies, size, _ = self.mass.shape
        widest = self.widest
        pairs = _padded(r * self.damping.astype(dtype) + r**2 * self.stiffness.astype(dtype), widest)
        # The identity stands for the rotations of point masses.
        missing = np.ones((bodies, widest))
        missing[:, :size] = self.layout.velocity_index[:-1] == self.layout.nu
        diagonal = _padded(self.mass, widest) + missing[:, :, None] * np.eye(widest)
        blocks = [diagonal.astype(dtype) - pairs[:bodies], -pairs[bodies:]]
        if self.rows is not None:
            kept = self.rows.order.kept
            of_joints = jnp.where(kept[:, None, :, None], self.rows.blocks, 0.0).astype(dtype)
            of_joints = _padded(of_joints.reshape(-1, *of_joints.shape[2:]), widest)
            implied = np.ones((len(kept), widest))
            implied[:, : kept.shape[1]] = ~kept
            identities = jnp.asarray(implied[:, :, None] * np.eye(widest), dtype)
            blocks += [of_joints, of_joints.swapaxes(1, 2), identities]
        blocks = jnp.concatenate([*blocks, jnp.zeros((1, widest, widest), dtype)])
        lower, upper = unchecked_take(blocks, order.lower), unchecked_take(blocks, order.upper)
        return MotionResolvent(self, r, eliminate_blocks(lower, order.nodes, upper))

    @property
    def widest(self) -> int:
        """The size of a block of the elimination."""
        rows = 0 if self.rows is None else self.rows.order.kept.shape[1]
        return max(self.mass.shape[1], rows)


def _padded(blocks, size):
    return jnp.pad(blocks, ((0, 0), (0, size - blocks.shape[1]), (0, size - blocks.shape[2])))


class MotionResolvent(AbstractResolvent):
    """`1 - r J`, factored.

    With `z_q = x_q + r N z_u` the accelerations follow from

        (M − r D − r² K) z_u + Aᵀ l = M x_u + r K x_q,   A z_u = 0.
    """

    jacobian: MotionJacobian
    r: Complex[Array, ""]
    factor: BlockFactor

    def solve(self, x):
        jacobian = self.jacobian
        move, velocity = jacobian.of_bodies(x)
        load = vector_products(jacobian.mass.astype(x.dtype), velocity) + self.r * self._stiff(move)
        solved = self._substitute(self.factor, load)
        return jacobian.raveled(move + self.r * solved, solved)

    def transpose_solve(self, x):
        jacobian = self.jacobian
        # Transposes of the maps between a state and its bodies.
        pull = jax.linear_transpose(lambda both: jacobian.raveled(*both), jacobian.of_bodies(x))
        push = jax.linear_transpose(jacobian.of_bodies, x)
        move, velocity = pull(x)[0]
        solved = self._substitute(self.factor.transpose(), velocity + self.r * move)
        load = vector_products(jacobian.mass.astype(x.dtype), solved)
        return push((move + self.r * self._stiff(solved, transpose=True), load))[0]

    def _substitute(self, factor, load):
        bodies, size = load.shape
        nodes, widest = self.jacobian.order.nodes.nodes, self.jacobian.widest
        return factor.solve(jnp.pad(load, ((0, nodes - bodies), (0, widest - size))))[:bodies, :size]

    def _stiff(self, move, transpose=False):
        """K, or its transpose, times displacements of the bodies."""
        order, K = self.jacobian.order, self.jacobian.stiffness.astype(move.dtype)
        if transpose:
            return order.by_column(transpose_vector_products(K, unchecked_take(move, order.row)))
        return order.by_row(vector_products(K, unchecked_take(move, order.column)))

    def weights(self):
        jacobian, layout = self.jacobian, self.jacobian.layout
        root = jnp.sqrt(jnp.diagonal(jacobian.mass, axis1=1, axis2=2))
        # Positions count as velocities at the frequency 1 / |r|.
        scaled = root / (jnp.sqrt(jnp.sum(jacobian.moves**2, axis=2)) * jnp.abs(self.r))
        d, attitude_size = layout.space.dimension, layout.space.pose_size - layout.space.dimension
        turns = jnp.repeat(jnp.max(scaled[:, d:], axis=1, keepdims=True), attitude_size, axis=1)
        poses = jnp.concatenate([scaled[:, :d], turns], axis=1).ravel()
        places = layout.coordinate_place, layout.velocity_place
        return jnp.concatenate(
            [unchecked_take(w, place) for w, place in zip((poses, root.ravel()), places, strict=True)]
        )


def motion_jacobian(system: Any, t: Scalar, y: State) -> MotionJacobian:
    """J at a state on the constraints."""
    order, layout = motion_order(system), system.layout
    q, u = y.q, y.u
    inertia = system.inertia(t, q, u)
    projector = rows = None
    multipliers = jnp.zeros(0, u.dtype)
    if order.joints is not None:
        rows = system.block_jacobian(t, q, u, order.joints)
        projector = rows.projector(inertia)
        free = inertia.solve(system.force(t, q, u))
        multipliers = -projector.multipliers(system.acceleration_residual(t, q, u, free))
    now = system.kinematics(t, q, u)
    stiffness, damping = contributions(system, now, multipliers)
    moves = jax.vmap(layout.space.moves)(now.poses[:-1])[:, :, : layout.space.pose_size]
    return MotionJacobian(
        order.sums(stiffness),
        order.sums(damping),
        _mass_blocks(inertia, layout, u.dtype),
        moves,
        projector,
        rows,
        system.position_rows,
        order,
        layout,
    )


def _mass_blocks(inertia: AbstractInertia, layout: Layout, dtype) -> Float[Array, "b v v"]:
    size = layout.space.velocity_size
    unit = np.zeros((layout.nu + 1, size))
    unit[layout.velocity_index, np.arange(size)] = 1.0
    columns = inertia.product(jnp.asarray(unit[:-1], dtype))
    return unchecked_take(jnp.pad(columns, ((0, 1), (0, 0))), layout.velocity_index[:-1])
