"""The Jacobian A of the constraints by its structure: one full matrix, or blocks of joints on bodies.

Both have the same interface, so formulations, projections and assembly are written once. A `MassProjector` solves with
`A M⁻¹ Aᵀ` by an elimination that follows the structure.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .elimination import Factor, PivotOrder, eliminate, full_pivot
from .inertia import AbstractInertia
from .positive_definite import AbstractPositiveDefinite, AbstractPositiveFactor, DensePositiveDefinite
from .rotations import norm
from .sums import unchecked_take

# A solution is refined until it satisfies the rows to `_ROUNDING` rounding errors of their summands, or `_REFINEMENTS`
# times.
_ROUNDING = 512
_REFINEMENTS = 4
# Conjugate gradients: reduction of the residual, and largest number of iterations.
_REDUCTION = 1e-13
_GRADIENTS = 300


class AbstractJacobian(eqx.Module):
    """The Jacobian A (m × n) of all constraint rows, of which some may be implied by others."""

    @abc.abstractmethod
    def product(self, v: Float[Array, "n"]) -> Float[Array, "m"]:
        """`A v`."""

    @abc.abstractmethod
    def transpose_product(self, multipliers: Float[Array, "m"]) -> Float[Array, "n"]:
        """`Aᵀ λ`."""

    @abc.abstractmethod
    def sizes(self, v: Float[Array, "n"]) -> Float[Array, "m"]:
        """The sum of the sizes of the terms in each row of `A v`."""

    @abc.abstractmethod
    def row_norms(self, scale: Float[Array, "n"]) -> Float[Array, "m"]:
        """The norm of each row, with the columns multiplied by a scale."""

    @abc.abstractmethod
    def gather_rows(self, values: Float[Array, "m"]) -> Float[Array, "*r"]:
        """The values of the independent rows, in the shape for `gram`."""

    @abc.abstractmethod
    def scatter_rows(self, values: Float[Array, "*r"]) -> Float[Array, "m"]:
        """The values of all rows from the values of the independent ones: zero for implied rows."""

    @abc.abstractmethod
    def responses(self, inertia: AbstractInertia) -> Float[Array, "n r"] | None:
        """`M⁻¹ Aᵀ` for the independent rows; None where the products are cheaper without this matrix."""

    @abc.abstractmethod
    def gram(self, inertia: AbstractInertia, responses: Float[Array, "n r"] | None) -> AbstractPositiveDefinite:
        """`A M⁻¹ Aᵀ` for the independent rows."""

    @abc.abstractmethod
    def dense(self) -> "DenseJacobian":
        """The same as one full matrix."""

    @abc.abstractmethod
    def of_rows(self, numbers: tuple[int, ...]) -> "AbstractJacobian":
        """The same matrix whose independent rows are among these, in ascending order: `gather_rows` keeps no others."""

    @abc.abstractmethod
    def selected(self, rank: int, scale: Float[Array, "n"], level: Int[Array, "m"] | None = None) -> "AbstractJacobian":
        """The same matrix with as many independent rows selected as the `rank`, unless they are known already.

        **Arguments:** `scale` of the columns; `level` of the rows, as in `full_pivot`.
        """

    @property
    @abc.abstractmethod
    def active(self) -> Float[Array, "m"]:
        """One for independent rows, zero for implied ones."""

    def projector(self, metric: AbstractInertia, factor: AbstractPositiveFactor | None = None) -> "MassProjector":
        """The projector in a metric M. `factor`: an existing factor of a Gram matrix of the same value."""
        responses = self.responses(metric)
        gram = self.gram(metric, responses)
        known = gram.eliminate() if factor is None else factor.for_matrix(gram)
        return MassProjector(self, metric, known, responses)


class MassProjector(eqx.Module):
    """Displacements along `M⁻¹ Aᵀ`, the shortest ones in the metric M that change the constraint rows.

    **Fields:** the `jacobian` A; the `metric` M; the `factor` of `A M⁻¹ Aᵀ`; the `responses` `M⁻¹ Aᵀ`, if kept.
    """

    jacobian: AbstractJacobian
    metric: AbstractInertia
    factor: AbstractPositiveFactor
    responses: Float[Array, "n r"] | None

    @eqx.filter_jit
    def solve(self, force: Float[Array, "n"], rows: Float[Array, "m"]) -> tuple[Float[Array, "n"], Float[Array, "m"]]:
        """x and λ of `M x = f + Aᵀ λ`, `A x = b`, for a metric without infinite entries; λ is zero for implied rows.

        With light bodies between heavy ones, the contribution of the heavy bodies to `A M⁻¹ Aᵀ` is lost in the rounding
        errors of the light ones. So x is refined with the residuals of the rows until these are rounding errors. One
        refinement restores all digits for ratios of masses up to 1e8. The solution is differentiated implicitly, by its
        equations.

        Source: N. J. Higham, "Accuracy and Stability of Numerical Algorithms", 2nd ed., SIAM, 2002, chapter 12
        (iterative refinement in fixed precision, tested by the componentwise backward error of Oettli and Prager).
        """
        jacobian, n = self.jacobian, force.size
        target = jacobian.gather_rows(rows)
        if target.size == 0:
            return self.metric.solve(force), jnp.zeros_like(rows)
        fixed = lax.stop_gradient(self)

        # One vector for both: the transpose of a solution needs a derivative of every part of the right-hand side.
        join = lambda x, multipliers: jnp.concatenate([x, multipliers.ravel()])
        split = lambda both: (both[:n], both[n:].reshape(target.shape))

        def equations(both):
            x, multipliers = split(both)
            wrench = jacobian.transpose_product(jacobian.scatter_rows(multipliers))
            return join(self.metric.product(x) - wrench, -jacobian.gather_rows(jacobian.product(x)))

        def solution(_, both):
            force, target = split(both)
            return join(*fixed._refined(force, -target))

        x, multipliers = split(lax.custom_linear_solve(equations, join(force, -target), solution, symmetric=True))
        return x, jacobian.scatter_rows(multipliers)

    def displacement(self, rows: Float[Array, "m"]) -> Float[Array, "n"]:
        """The smallest x in the metric with `A x = b`, to all digits."""
        none = jax.eval_shape(self.jacobian.transpose_product, rows)
        return self.solve(jnp.zeros(none.shape, none.dtype), rows)[0]

    def _refined(self, force, target):
        jacobian = self.jacobian

        def refined(x, multipliers, residual, k):
            change = self.factor.substitute(residual)
            x = x + self._along(change)
            return x, multipliers + change, target - jacobian.gather_rows(jacobian.product(x)), k + 1

        def inexact(carry):
            x, _, residual, k = carry
            sizes = jacobian.gather_rows(jacobian.sizes(x)) + jnp.abs(target)
            tol = _ROUNDING * jnp.finfo(x.dtype).eps
            return jnp.any(jnp.abs(residual) > tol * sizes) & (k <= _REFINEMENTS)

        free = self.metric.solve(force)
        residual = target - jacobian.gather_rows(jacobian.product(free))
        start = refined(free, jnp.zeros_like(target), residual, jnp.array(0))
        x, multipliers, _, _ = lax.while_loop(inexact, lambda carry: refined(*carry), start)
        return x, multipliers

    def multipliers(self, values: Float[Array, "m"]) -> Float[Array, "m"]:
        """`(A M⁻¹ Aᵀ)⁻¹ x`; zero for implied rows."""
        return self.jacobian.scatter_rows(self.factor.solve(self.jacobian.gather_rows(values)))

    def _along(self, multipliers):
        """`M⁻¹ Aᵀ λ` by multipliers of the independent rows."""
        if self.responses is None:
            return self.direction(self.jacobian.scatter_rows(multipliers))
        return self.responses @ multipliers

    def direction(self, multipliers: Float[Array, "m"]) -> Float[Array, "n"]:
        """`M⁻¹ Aᵀ λ`."""
        return self.metric.solve(self.jacobian.transpose_product(multipliers))

    def cancel(self, residual: Float[Array, "m"]) -> Float[Array, "n"]:
        """The smallest displacement that changes the rows by `−residual`, to the digits of the factor.

        For iterations, which evaluate the residual again. Infinite entries of the metric hold their velocities fixed.
        """
        return -self.direction(self.multipliers(residual))

    def balancing(self, force: Float[Array, "n"]) -> Float[Array, "m"]:
        """The multipliers λ for which `M⁻¹ (f − Aᵀ λ)` is in the null space of A."""
        return self.multipliers(self.jacobian.product(self.metric.solve(force)))

    def null_space_solution(
        self, curved: Callable[[Float[Array, "n"]], Float[Array, "n"]], force: Float[Array, "n"]
    ) -> Float[Array, "n"]:
        """`v` in the null space of A with `H v + Aᵀ δμ = force`, by projected conjugate gradients; `curved` is `v -> H
        v`. At a direction of negative curvature the iteration ends; at the start, with that direction.

        Source: N. I. M. Gould, M. E. Hribar and J. Nocedal, "On the solution of equality constrained quadratic
        programming problems arising in optimization", SIAM J. Sci. Comput. 23(4), 2001.
        """

        def project(force):
            # Only the part of a residual along the null space is kept: constraint forces would grow beside it.
            force = force - self.jacobian.transpose_product(self.balancing(force))
            towards = self.metric.solve(force)
            return force, towards - self.direction(self.multipliers(self.jacobian.product(towards)))

        force, towards = project(force)
        size = jnp.vdot(force, towards)

        def correct(carry):
            x, remaining, along, size, k, _ = carry
            curve = curved(along)
            curvature = jnp.vdot(along, curve)
            convex = curvature > 0
            length = jnp.where(convex, size / jnp.where(convex, curvature, 1.0), jnp.where(k == 0, 1.0, 0.0))
            x = x + length * along
            remaining, towards = project(remaining - length * curve)
            new = jnp.vdot(remaining, towards)
            along = towards + jnp.where(size > 0, new / jnp.where(size > 0, size, 1.0), 0.0) * along
            return x, remaining, along, new, k + 1, convex

        def proceed(carry):
            return (carry[3] > _REDUCTION**2 * size) & (carry[4] < _GRADIENTS) & carry[5]

        start = jnp.zeros_like(force), force, towards, size, jnp.array(0), jnp.array(True)
        return lax.while_loop(proceed, correct, start)[0]


class DenseJacobian(AbstractJacobian):
    """A full matrix.

    **Fields:** `matrix` (m × n); its `factor` in a chart, or None without one; `rows`: the independent rows, None if no
    pivots were searched; `numbers`: the indices of the independent rows then, None for all rows.
    """

    matrix: Float[Array, "m n"]
    factor: Factor | None = None
    rows: Int[Array, "r"] | None = None
    numbers: tuple[int, ...] | None = eqx.field(static=True, default=None)

    @property
    def independent(self) -> Float[Array, "r n"]:
        """The independent rows."""
        return self.gather_rows(self.matrix)

    @property
    def pivoted(self) -> Factor:
        """The factor, for formulations that split velocities into dependent and independent ones."""
        assert self.factor is not None, "a partitioning formulation needs the factor of a chart"
        return self.factor

    def product(self, v):
        return self.matrix @ v

    def transpose_product(self, multipliers):
        return self.matrix.T @ multipliers

    def sizes(self, v):
        return jnp.abs(self.matrix) @ jnp.abs(v)

    def row_norms(self, scale):
        return norm(self.matrix * scale[None, :])

    def gather_rows(self, values):
        if self.rows is None:
            return values if self.numbers is None else unchecked_take(values, np.array(self.numbers, int))
        return values[self.rows]

    def scatter_rows(self, values):
        m = self.matrix.shape[0]
        if self.rows is None:
            if self.numbers is None:
                return values
            # The other rows take the zero at the end.
            place = np.full(m, len(self.numbers))
            place[list(self.numbers)] = np.arange(len(self.numbers))
            return unchecked_take(jnp.append(values, jnp.zeros((), values.dtype)), place)
        return jnp.zeros(m, values.dtype).at[self.rows].set(values)

    def responses(self, inertia):
        return inertia.solve(self.independent.T)

    def gram(self, inertia, responses):
        assert responses is not None, "a full matrix keeps its responses"
        return DensePositiveDefinite(self.independent @ responses)

    def dense(self):
        return self

    def of_rows(self, numbers):
        assert self.rows is None, "rows are selected already"
        return DenseJacobian(self.matrix, numbers=numbers)

    def selected(self, rank, scale, level=None):
        if self.rows is not None or self.independent.shape[0] == rank:
            return self
        rows = full_pivot(self.independent, scale=scale, level=level).order.rows[:rank]
        return DenseJacobian(self.matrix, rows=rows if self.numbers is None else jnp.array(self.numbers)[rows])

    def eliminated(self, order: PivotOrder, rank: int) -> "DenseJacobian":
        """The same matrix with its factor in an order of elimination, which selects the independent rows."""
        factor = eliminate(self.matrix, order, rank)
        return DenseJacobian(self.matrix, factor, factor.rows)

    @property
    def active(self):
        return self.scatter_rows(self.gather_rows(jnp.ones(self.matrix.shape[0], self.matrix.dtype)))
