"""The Jacobian A of the constraints by its structure: one full matrix, or blocks of joints on bodies.

Both have the same interface, so that formulations, projections and assembly are written once. A `MassProjector` solves
with `A M⁻¹ Aᵀ` by an elimination that follows the structure.
"""

import abc
import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .arrays import unchecked_take
from .block_tridiagonal import BlockTridiagonal
from .blocks import matrix_products
from .elimination import Factor
from .inertia import AbstractInertia
from .positive_definite import AbstractPositiveDefinite, AbstractPositiveFactor, DensePositiveDefinite
from .rotations import norm


class AbstractJacobian(eqx.Module):
    """The Jacobian A (m × n) of all constraint rows. Some rows may be implied by the others; `gather_rows` keeps the
    independent ones.
    """

    @abc.abstractmethod
    def product(self, v: Float[Array, "n"]) -> Float[Array, "m"]:
        """`A v`."""

    @abc.abstractmethod
    def transpose_product(self, multipliers: Float[Array, "m"]) -> Float[Array, "n"]:
        """`Aᵀ λ`."""

    @abc.abstractmethod
    def row_norms(self, scale: Float[Array, "n"]) -> Float[Array, "m"]:
        """The norm of each row, its columns multiplied by a scale."""

    @abc.abstractmethod
    def gather_rows(self, values: Float[Array, "m"]) -> Float[Array, "*r"]:
        """The values of the independent rows, in the shape that `gram` takes."""

    @abc.abstractmethod
    def scatter_rows(self, values: Float[Array, "*r"]) -> Float[Array, "m"]:
        """The values of all rows from those of the independent ones: zero for implied rows."""

    @abc.abstractmethod
    def gram(self, inertia: AbstractInertia) -> AbstractPositiveDefinite:
        """`A M⁻¹ Aᵀ` of the independent rows."""

    @abc.abstractmethod
    def dense(self) -> "DenseJacobian":
        """The same as one full matrix."""

    def projector(self, metric: AbstractInertia, factor: AbstractPositiveFactor | None = None) -> "MassProjector":
        """The projector in a metric M. `factor`: an existing factor of a Gram matrix of the same value."""
        gram = self.gram(metric)
        return MassProjector(self, metric, gram.eliminate() if factor is None else factor.for_matrix(gram))


class MassProjector(eqx.Module):
    """Displacements along `M⁻¹ Aᵀ`, the shortest ones in the metric M that change the constraint rows.

    **Fields:** the `jacobian` A; the `metric` M; the `factor` of `A M⁻¹ Aᵀ`.
    """

    jacobian: AbstractJacobian
    metric: AbstractInertia
    factor: AbstractPositiveFactor

    def multipliers(self, values: Float[Array, "m"]) -> Float[Array, "m"]:
        """`(A M⁻¹ Aᵀ)⁻¹ x`; zero for implied rows."""
        return self.jacobian.scatter_rows(self.factor.solve(self.jacobian.gather_rows(values)))

    def direction(self, multipliers: Float[Array, "m"]) -> Float[Array, "n"]:
        """`M⁻¹ Aᵀ λ`."""
        return self.metric.solve(self.jacobian.transpose_product(multipliers))

    def cancel(self, residual: Float[Array, "m"]) -> Float[Array, "n"]:
        """The smallest displacement that changes the rows by `−residual`."""
        return -self.direction(self.multipliers(residual))


class DenseJacobian(AbstractJacobian):
    """A full matrix.

    **Fields:** `matrix` (m × n); its `factor` in a chart, which selects the independent rows, or None where all rows
    are independent and no pivots were searched for.
    """

    matrix: Float[Array, "m n"]
    factor: Factor | None = None

    @property
    def independent(self) -> Float[Array, "r n"]:
        """The independent rows."""
        return self.matrix if self.factor is None else self.matrix[self.factor.rows]

    @property
    def pivoted(self) -> Factor:
        """The factor, for formulations that split velocities into dependent and independent ones."""
        assert self.factor is not None, "a partitioning formulation needs the factor of a chart"
        return self.factor

    def product(self, v):
        return self.matrix @ v

    def transpose_product(self, multipliers):
        return self.matrix.T @ multipliers

    def row_norms(self, scale):
        return norm(self.matrix * scale[None, :])

    def gather_rows(self, values):
        return values if self.factor is None else values[self.factor.rows]

    def scatter_rows(self, values):
        return values if self.factor is None else self.factor.scatter_rows(values)

    def gram(self, inertia):
        A = self.independent
        return DensePositiveDefinite(A @ inertia.solve(A.T))

    def dense(self):
        return self


@dataclasses.dataclass(frozen=True)
class EliminationOrder:
    """Joints in their order of elimination: static index arithmetic, compared by its `key`.

    Joint i shares bodies with the joints i − 1 and i + 1 only, so `A M⁻¹ Aᵀ` is block-tridiagonal. A joint has up to r
    rows and a body up to v velocities.

    **Fields:**

    - `rows` (joints, r): index of the rows of each joint among all m; padding has the index m.
    - `place` (m,): index of each row among those of the joints in order, raveled.
    - `before`, `after` (joints,): the body shared with the joint before and after; the number of bodies for none.
    - `joint_before`, `joint_after` (bodies,): the joint that has the body `before` it, and `after` it; the number of
      joints for none.
    - `blocks_before`, `blocks_after` (joints, r, v): index of their entries among the blocks of all joints as
      `block_jacobian` takes them; padding has the index of the zero at their end.
    - `velocity_index` (bodies + 1, v): index of each body's velocities among all n; padding, and the last row, for no
      body, have the index n.
    - `velocity_place` (n,): index of each velocity among those of the bodies, raveled.
    """

    key: Any
    rows: np.ndarray = dataclasses.field(compare=False)
    place: np.ndarray = dataclasses.field(compare=False)
    before: np.ndarray = dataclasses.field(compare=False)
    after: np.ndarray = dataclasses.field(compare=False)
    joint_before: np.ndarray = dataclasses.field(compare=False)
    joint_after: np.ndarray = dataclasses.field(compare=False)
    blocks_before: np.ndarray = dataclasses.field(compare=False)
    blocks_after: np.ndarray = dataclasses.field(compare=False)
    velocity_index: np.ndarray = dataclasses.field(compare=False)
    velocity_place: np.ndarray = dataclasses.field(compare=False)


class BlockJacobian(AbstractJacobian):
    """Blocks of joints on bodies, all rows independent; products and elimination take a time proportional to the number
    of joints.

    **Fields:** `before`, `after` (joints, r, v): the blocks of each joint on the bodies that it shares with the joint
    before and after; the `order` of elimination.
    """

    before: Float[Array, "k r v"]
    after: Float[Array, "k r v"]
    order: EliminationOrder = eqx.field(static=True)

    def product(self, v):
        of_bodies = self._of_bodies(v[:, None])[:, :, 0]
        along = jnp.sum(self.before * of_bodies[self.order.before][:, None], axis=2)
        along = along + jnp.sum(self.after * of_bodies[self.order.after][:, None], axis=2)
        return self.scatter_rows(along)

    def transpose_product(self, multipliers):
        own = self.gather_rows(multipliers)[:, :, None]
        order = self.order
        forces = [
            jnp.pad(jnp.sum(side * own, axis=1), ((0, 1), (0, 0)))[joint]
            for side, joint in ((self.before, order.joint_before), (self.after, order.joint_after))
        ]
        return self._of_velocities((forces[0] + forces[1])[:, :, None])[:, 0]

    def row_norms(self, scale):
        return jnp.sqrt(BlockJacobian(self.before**2, self.after**2, self.order).product(scale**2))

    def gather_rows(self, values):
        return unchecked_take(jnp.append(values, jnp.zeros((), values.dtype)), self.order.rows)

    def scatter_rows(self, values):
        return unchecked_take(values.reshape(-1), self.order.place)

    def gram(self, inertia):
        # M couples no bodies.
        order = self.order
        r = self.before.shape[1]
        padded = [jnp.pad(side, ((0, 1), (0, 0), (0, 0))) for side in (self.before, self.after)]
        columns = [padded[0][order.joint_before], padded[1][order.joint_after]]
        columns = jnp.concatenate(columns, axis=1).swapaxes(1, 2)
        moved = self._of_bodies(inertia.solve(self._of_velocities(columns)))
        of_before, of_after = moved[:, :, :r], moved[:, :, r:]
        diagonal = matrix_products(self.before, of_before[order.before])
        diagonal = diagonal + matrix_products(self.after, of_after[order.after])
        padding = order.rows == order.place.size
        if padding.any():
            # Padding rows have a one on the diagonal.
            diagonal = diagonal + jnp.asarray(np.eye(r) * padding[:, :, None], diagonal.dtype)
        return BlockTridiagonal(diagonal, matrix_products(self.after, of_before[order.after]))

    def dense(self):
        unit = jnp.eye(self.order.velocity_place.size, dtype=self.before.dtype)
        return DenseJacobian(jax.vmap(self.product, out_axes=1)(unit))

    def _of_bodies(self, columns):
        """Columns (n, c) body by body, followed by zeros, (bodies + 1, v, c)."""
        return unchecked_take(jnp.pad(columns, ((0, 1), (0, 0))), self.order.velocity_index)

    def _of_velocities(self, of_bodies):
        """Columns (n, c) from those of bodies (bodies, v, c)."""
        return unchecked_take(of_bodies.reshape(-1, of_bodies.shape[2]), self.order.velocity_place)


def block_jacobian(blocks: Float[Array, "entries"], order: EliminationOrder) -> BlockJacobian:
    """A from the blocks of all joints, (rows, bodies, v) each, raveled one after the other and followed by a zero."""
    return BlockJacobian(unchecked_take(blocks, order.blocks_before), unchecked_take(blocks, order.blocks_after), order)
