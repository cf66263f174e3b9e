"""Symmetric positive definite block-tridiagonal matrices: solved in a time proportional to the number of blocks.

Source: block LU factorisation without pivoting (the block form of Thomas' algorithm), G. H. Golub and C. F. Van Loan,
"Matrix Computations", §4.5; stable for positive definite matrices.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Blocks = Float[Array, "k r r"]


class BlockTridiagonal(eqx.Module):
    """A symmetric matrix of k × k blocks of size r. `diagonal` (k, r, r); `coupling` (k, r, r): block i in row i and
    column i + 1, the last one zero.
    """

    diagonal: Blocks
    coupling: Blocks

    def product(self, x: Float[Array, "k r"]) -> Float[Array, "k r"]:
        """`T x`."""
        ahead = jnp.concatenate([x[1:], jnp.zeros_like(x[:1])])
        behind = _times(self.coupling.swapaxes(1, 2), x)
        behind = jnp.concatenate([jnp.zeros_like(x[:1]), behind[:-1]])
        return _times(self.diagonal, x) + _times(self.coupling, ahead) + behind

    def factor(self) -> "BlockFactor":
        """Eliminate block by block."""
        diagonal, coupling = lax.stop_gradient((self.diagonal, self.coupling))

        def eliminate(carry, row):
            before, ahead = carry
            diagonal, coupling = row
            inverse = _inverse(diagonal - _matmul(before.T, ahead))
            ahead = _matmul(inverse, coupling)
            return (coupling, ahead), (inverse, ahead)

        start = jnp.zeros_like(diagonal[0]), jnp.zeros_like(diagonal[0])
        _, (inverse, ahead) = lax.scan(eliminate, start, (diagonal, coupling))
        return BlockFactor(self, inverse, ahead)


class BlockFactor(eqx.Module):
    """A factorised block-tridiagonal matrix.

    **Fields:** the `matrix`; `inverse` (k, r, r) of the pivots S, and `ahead` (k, r, r), `S⁻¹` times the coupling;
    these two carry no derivatives, the matrix does.
    """

    matrix: BlockTridiagonal
    inverse: Blocks
    ahead: Blocks

    def of(self, matrix: BlockTridiagonal) -> "BlockFactor":
        """The same factor for a matrix of the same value, but with derivatives of its own."""
        return BlockFactor(matrix, self.inverse, self.ahead)

    def solve(self, b: Float[Array, "k r"]) -> Float[Array, "k r"]:
        """`T⁻¹ b`; differentiated by the equation that it solves, not by the way it does."""
        matrix, inverse, ahead = self.matrix, self.inverse, self.ahead

        def by_factor(_, b):
            behind = matrix.coupling.swapaxes(1, 2)
            behind = jnp.concatenate([jnp.zeros_like(behind[:1]), behind[:-1]])
            # y = S⁻¹ (b − Uᵀ y₋): what does not depend on the block before is worked out for all blocks at once.
            factors = -_products(inverse, behind)
            forward = lambda y, row: (row[1] + _times_one(row[0], y),) * 2
            backward = lambda x, row: (row[1] - _times_one(row[0], x),) * 2
            _, y = lax.scan(forward, jnp.zeros_like(b[0]), (factors, _times(inverse, b)))
            return lax.scan(backward, jnp.zeros_like(b[0]), (ahead, y), reverse=True)[1]

        return lax.custom_linear_solve(matrix.product, b, by_factor, symmetric=True)

    def smallest_pivot(self) -> Float[Array, ""]:
        """The smallest part of a row that the rows before it leave over, between 0 (implied) and 1 (orthogonal)."""
        of = jax.vmap(jnp.diag)
        return jnp.min(1 / (of(self.inverse) * of(self.matrix.diagonal)), initial=1.0)


# Sums of products fuse; dots of small blocks are calls of a library.


def _times_one(a, x):
    return jnp.sum(a * x[None, :], axis=1)


def _times(a, x):
    return jnp.sum(a * x[:, None, :], axis=2)


def _matmul(a, b):
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def _products(a, b):
    return jnp.sum(a[:, :, :, None] * b[:, None, :, :], axis=2)


def _inverse(a):
    """Of one small positive definite block, by Gauss–Jordan elimination on the diagonal."""
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
