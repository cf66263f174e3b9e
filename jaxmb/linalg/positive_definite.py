"""Symmetric positive definite matrices by their structure: factored once, for any number of solutions."""

import abc
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from .elimination import gauss_jordan

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractPositiveDefinite(eqx.Module):
    """A symmetric positive definite matrix T. Its vectors may have any shape, such as one row per block."""

    @abc.abstractmethod
    def product(self, x: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """`T x`."""

    @abc.abstractmethod
    def eliminate(self, share: Float[ArrayLike, ""] | None = None) -> "AbstractPositiveFactor":
        """Eliminate once, for any number of right-hand sides.

        **Arguments:** `share`: this share of its largest entry is added to the diagonal, for pivots of implied rows.
        """


class AbstractPositiveFactor(eqx.Module):
    """A factored matrix. The `matrix` carries derivatives; the numbers of its elimination do not.

    **Fields:** `matrix`; `shift`: the number added to its diagonal before elimination, None for nothing.
    """

    matrix: AbstractVar[Any]
    shift: AbstractVar[Any]

    @abc.abstractmethod
    def substitute(self, b: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """`T⁻¹ b` by the numbers of the elimination."""

    @abc.abstractmethod
    def smallest_pivot(self) -> Float[Array, ""]:
        """The smallest pivot of a Gram matrix relative to its diagonal: 0 if a row is implied by the rows before it, 1
        if all rows are orthogonal.
        """

    def refined(self, b: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """`(T + shift)⁻¹ b`, substituted and refined once: pivots of implied rows are small, and amplify roundings."""
        x = self.substitute(b)
        residual = b - self.matrix.product(x)
        return x + self.substitute(residual if self.shift is None else residual - self.shift * x)

    def solve(self, b: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """`T⁻¹ b`, differentiated implicitly, by the equation `T x = b`."""
        return lax.custom_linear_solve(self.matrix.product, b, lambda _, b: self.substitute(b), symmetric=True)

    def for_matrix(self, matrix: AbstractPositiveDefinite) -> Any:
        """The same factor for a matrix of the same value with other derivatives."""
        return eqx.tree_at(lambda factor: factor.matrix, self, matrix)


class DensePositiveDefinite(AbstractPositiveDefinite):
    """A full matrix, shape (n, n)."""

    matrix: Float[Array, "n n"]

    def product(self, x):
        return self.matrix @ x

    def eliminate(self, share=None):
        matrix = lax.stop_gradient(self.matrix)
        shift = None
        if share is not None:
            shift = share * jnp.max(jnp.diag(matrix)) + jnp.finfo(matrix.dtype).tiny
            matrix = matrix + shift * jnp.eye(matrix.shape[0], dtype=matrix.dtype)
        inverse = 1 / matrix if matrix.shape[0] == 1 else gauss_jordan(matrix, matrix.shape[0])
        return DensePositiveFactor(self, shift, inverse)


class DensePositiveFactor(AbstractPositiveFactor):
    """The inverse of a full matrix, shape (n, n)."""

    matrix: DensePositiveDefinite
    shift: Any
    inverse: Float[Array, "n n"]

    def substitute(self, b):
        return self.inverse @ b

    def smallest_pivot(self):
        return jnp.min(1 / (jnp.diag(self.inverse) * jnp.diag(self.matrix.matrix)), initial=1.0)
