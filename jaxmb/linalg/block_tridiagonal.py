"""Symmetric positive definite block-tridiagonal matrices: solved in a time proportional to the number of blocks.

Source: block LU factorisation without pivoting (the block form of Thomas' algorithm), G. H. Golub and C. F. Van Loan,
"Matrix Computations", §4.5; stable for positive definite matrices.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .blocks import matrix_product, matrix_products, vector_product, vector_products
from .positive_definite import AbstractPositiveDefinite, AbstractPositiveFactor

Blocks = Float[Array, "k r r"]


class BlockTridiagonal(AbstractPositiveDefinite):
    """A symmetric matrix of k × k blocks of size r; its vectors have shape (k, r).

    **Fields:** `diagonal` (k, r, r); `coupling` (k, r, r): block i in row i and column i + 1, the last one zero.
    """

    diagonal: Blocks
    coupling: Blocks

    def product(self, x):
        ahead = jnp.concatenate([x[1:], jnp.zeros_like(x[:1])])
        behind = vector_products(self.coupling.swapaxes(1, 2), x)
        behind = jnp.concatenate([jnp.zeros_like(x[:1]), behind[:-1]])
        return vector_products(self.diagonal, x) + vector_products(self.coupling, ahead) + behind

    def eliminate(self):
        diagonal, coupling = lax.stop_gradient((self.diagonal, self.coupling))

        def eliminate(carry, row):
            before, ahead = carry
            diagonal, coupling = row
            inverse = _inverse(diagonal - matrix_product(before.T, ahead))
            ahead = matrix_product(inverse, coupling)
            return (coupling, ahead), (inverse, ahead)

        start = jnp.zeros_like(diagonal[0]), jnp.zeros_like(diagonal[0])
        _, (inverse, ahead) = lax.scan(eliminate, start, (diagonal, coupling))
        return BlockTridiagonalFactor(self, inverse, ahead)


class BlockTridiagonalFactor(AbstractPositiveFactor):
    """A factored block-tridiagonal matrix: `inverse` (k, r, r) of the pivots S, and `ahead` (k, r, r), `S⁻¹` times the
    coupling.
    """

    matrix: BlockTridiagonal
    inverse: Blocks
    ahead: Blocks

    def substitute(self, b):
        behind = self.matrix.coupling.swapaxes(1, 2)
        behind = jnp.concatenate([jnp.zeros_like(behind[:1]), behind[:-1]])
        # y = S⁻¹ (b − Uᵀ y₋): terms that do not depend on the previous block are computed for all blocks at once.
        factors = -matrix_products(self.inverse, behind)
        forward = lambda y, row: (row[1] + vector_product(row[0], y),) * 2
        backward = lambda x, row: (row[1] - vector_product(row[0], x),) * 2
        _, y = lax.scan(forward, jnp.zeros_like(b[0]), (factors, vector_products(self.inverse, b)))
        return lax.scan(backward, jnp.zeros_like(b[0]), (self.ahead, y), reverse=True)[1]

    def smallest_pivot(self):
        of = jax.vmap(jnp.diag)
        return jnp.min(1 / (of(self.inverse) * of(self.matrix.diagonal)), initial=1.0)


def _inverse(a):
    """The inverse of a small positive definite block, by Gauss–Jordan elimination on the diagonal."""
    r = a.shape[0]
    if r == 1:
        return 1 / a
    if r == 2:
        adjugate = jnp.stack([jnp.stack([a[1, 1], -a[0, 1]]), jnp.stack([-a[1, 0], a[0, 0]])])
        return adjugate / (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0])
    for k in range(r):
        pivot = a[k, k]
        row = a[k].at[k].set(1.0) / pivot
        column = a[:, k].at[k].set(0.0)
        a = a.at[:, k].set(0.0).at[k].set(0.0) - column[:, None] * row[None, :]
        a = a.at[k].set(row)
    return a
