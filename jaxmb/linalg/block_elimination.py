"""Elimination of block-sparse matrices in a given order of their nodes.

Blocks are of one size, and the pattern is symmetric: (i, j) has a block if (j, i) has one. The factors are `S = L D Lᵀ`
of a symmetric matrix, and `S = L D U` of any other matrix, real or complex, without a search for pivots. Positive
definite matrices need no search, nor do symmetric quasi-definite ones (positive definite in some nodes, negative
definite in the others). For other matrices every pivot must be regular in the given order. One loop executes the steps
of a stage of the order; each step eliminates some nodes at once.

Sources: J. W. H. Liu, "The multifrontal method for sparse matrix solution", SIAM Review 34(1), 1992; R. J. Vanderbei,
"Symmetric quasidefinite matrices", SIAM J. Optim. 5(1), 1995.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Inexact

from .arrays import add_up
from .elimination import gauss_jordan
from .elimination_order import NodeOrder
from .sums import unchecked_take


class BlockFactor(eqx.Module):
    """A factored matrix; numbers without derivatives.

    **Fields:**

    - `inverses`: of the pivots of each stage, (steps, b, b, w).
    - `below`: the columns of the pivots of each stage in L, (steps, b, b, d, w).
    - `right`: the same in Uᵀ, None for a symmetric matrix.
    - `rest`: the inverse of the dense matrix of the remaining nodes.
    - `order`: the order of elimination.
    """

    inverses: tuple[Inexact[Array, "s b b w"], ...]
    below: tuple[Inexact[Array, "s b b d w"], ...]
    right: tuple[Inexact[Array, "s b b d w"], ...] | None
    rest: Inexact[Array, "k k"]
    order: NodeOrder = eqx.field(static=True)

    def solve(self, x: Inexact[Array, "n b"]) -> Inexact[Array, "n b"]:
        """`S⁻¹ x`."""
        order = self.order
        right, backward = (self.below, _backward) if self.right is None else (self.right, _wide_backward)
        x = jnp.pad(x, ((0, 1), (0, 0)))
        for stage, below in zip(order.stages, self.below, strict=True):
            x = lax.scan(_forward, x, (stage.nodes, stage.later, below))[0]
        if order.rest.size:
            rest = self.rest @ unchecked_take(x, order.rest).reshape(-1)
            x = x.at[order.rest].set(rest.reshape(-1, x.shape[1]), mode="promise_in_bounds", unique_indices=True)
        for stage, inverses, above in reversed(list(zip(order.stages, self.inverses, right, strict=True))):
            pivot = jnp.moveaxis(unchecked_take(x, stage.nodes), 2, 1)
            pivot = add_up([inverses[:, :, j] * pivot[:, j, None] for j in range(pivot.shape[1])])
            x = lax.scan(backward, x, (stage.nodes, stage.later, pivot, above), reverse=True)[0]
        return x[:-1]

    def transpose(self) -> "BlockFactor":
        """The factor of Sᵀ."""
        if self.right is None:
            return self
        inverses = tuple(inverse.swapaxes(1, 2) for inverse in self.inverses)
        return BlockFactor(inverses, self.right, self.below, self.rest.T, self.order)

    def pivots(self) -> Float[Array, "n b"]:
        """For each row the reciprocal of the diagonal entry of its pivot's inverse."""
        order = self.order
        size = self.inverses[0].shape[1] if self.inverses else self.rest.shape[0] // order.rest.size
        out = jnp.ones((order.nodes + 1, size), self.rest.dtype)
        for stage, inverses in zip(order.stages, self.inverses, strict=True):
            out = out.at[stage.nodes].set(1 / jnp.diagonal(inverses, axis1=1, axis2=2), mode="promise_in_bounds")
        return out.at[order.rest].set(1 / jnp.diag(self.rest).reshape(-1, size))[:-1]


def eliminate_blocks(
    lower: Inexact[Array, "blocks b b"], order: NodeOrder, upper: Inexact[Array, "blocks b b"] | None = None
) -> BlockFactor:
    """The factor of a matrix from its stored blocks, with zeros for fill; see `NodeOrder`.

    **Arguments:** `lower`: the blocks on the diagonal, and the blocks whose row is the later node; `upper`: the other
    blocks of a matrix that is not symmetric, each at the place of its mirror image; on the diagonal anything.
    """
    sides = [lower] if upper is None else [lower, upper.swapaxes(1, 2)]
    size, dtype = lower.shape[1], lower.dtype
    padding = jnp.stack([jnp.zeros((size, size), dtype), jnp.eye(size, dtype=dtype)])
    blocks = _joined([jnp.concatenate([lax.stop_gradient(side), padding]) for side in sides], axis=1)
    factors = []
    for stage in order.stages:
        blocks, factor = lax.scan(_eliminate, blocks, (stage.diagonal, stage.columns, stage.targets))
        factors.append(factor)
    below = tuple(columns[0] for _, columns in factors)
    right = None if upper is None else tuple(columns[1] for _, columns in factors)
    return BlockFactor(tuple(inverse for inverse, _ in factors), below, right, _dense_inverse(blocks, order), order)


# In a step the lanes are the last axis, so that each operation acts on long vectors. The barriers keep XLA from
# computing an operand of a product again for each entry. Blocks are (n, b, b), below the diagonal. Of a matrix that is
# not symmetric they are (n, 2, b, b), with the transposes of the blocks above the diagonal.


def _joined(sides, axis=0):
    return sides[0] if len(sides) == 1 else jnp.stack(sides, axis)


def _eliminate(blocks, step):
    diagonal, columns, targets = step
    symmetric = blocks.ndim == 3
    pivot, column = unchecked_take(blocks, diagonal), unchecked_take(blocks, columns)
    pivot = jnp.moveaxis(pivot if symmetric else pivot[:, 0], 0, 2)
    inverse = lax.optimization_barrier((_inverse if symmetric else _wide_inverse)(pivot))
    # Each (b, b, d, w): L times the pivots, and the transposed rows of the pivots.
    column = jnp.transpose(column, (*range(2, column.ndim), 1, 0))
    sides, inverses = ([column], [inverse]) if symmetric else (list(column), [inverse, inverse.swapaxes(0, 1)])
    size = inverse.shape[0]
    multiples = [
        add_up([side[:, j, None] * row[None, j, :, None] for j in range(size)])
        for side, row in zip(sides, inverses, strict=True)
    ]
    multiples, sides = lax.optimization_barrier((multiples, sides))
    first, second = np.tril_indices(columns.shape[1])
    # The change of the block (a, b) is L_a times b's part of U; the change of (b, a), transposed, is its mirror image.
    left = _joined([multiple[:, :, first] for multiple in multiples])
    right = _joined([side[:, :, second] for side in reversed(sides)])
    left, right = lax.optimization_barrier((left, right))
    products = [left[..., j, None, :, :] * right[..., None, :, j, :, :] for j in range(size)]
    change = lax.optimization_barrier(add_up(products))
    change = jnp.transpose(change, (change.ndim - 1, change.ndim - 2, *range(change.ndim - 2)))
    return blocks.at[targets].add(-change, mode="promise_in_bounds"), (inverse, multiples)


def _forward(x, step):
    nodes, later, below = step
    pivot = unchecked_take(x, nodes).T
    change = add_up([below[:, j] * pivot[None, j, None] for j in range(pivot.shape[0])])
    return x.at[later].add(-change.T, mode="promise_in_bounds"), None


def _backward(x, step):
    nodes, later, pivot, right = step
    solved = unchecked_take(x, later).T
    size, d = solved.shape[:2]
    pivot = add_up([pivot, *(-right[i, :, k] * solved[None, i, k] for i in range(size) for k in range(d))])
    return x.at[nodes].set(pivot.T, mode="promise_in_bounds"), None


def _wide_backward(x, step):
    """As `_backward`, for blocks so wide that their products are not written out."""
    nodes, later, pivot, right = step
    solved = unchecked_take(x, later).T
    change = add_up([right[i] * solved[i, None] for i in range(solved.shape[0])])
    return x.at[nodes].set((pivot - jnp.sum(change, axis=1)).T, mode="promise_in_bounds"), None


def _dense_inverse(blocks, order):
    k, size = order.rest.size, blocks.shape[-1]
    stored = unchecked_take(blocks, order.rest_blocks)
    lower, upper = (stored, stored) if blocks.ndim == 3 else (stored[:, :, 0], stored[:, :, 1])
    # Blocks above the diagonal are stored as their transposes.
    above = np.triu(np.ones((k, k), bool), 1)[:, :, None, None]
    full = jnp.where(above, upper.swapaxes(2, 3), lower)
    matrix = full.swapaxes(1, 2).reshape(k * size, k * size)
    if blocks.ndim == 3:
        return gauss_jordan(matrix, k * size)
    return _wide_inverse(matrix[:, :, None])[:, :, 0] if k else matrix


def _inverse(a):
    """Inverses of small blocks (b, b, w), by Gauss–Jordan elimination on the diagonal."""
    r = a.shape[0]
    rows = [[a[i, j] for j in range(r)] for i in range(r)]
    for k in range(r):
        pivot = 1 / rows[k][k]
        row = [pivot if j == k else rows[k][j] * pivot for j in range(r)]
        swept = lambda i, k=k, row=row, rows=rows: [
            -rows[i][k] * row[j] if j == k else rows[i][j] - rows[i][k] * row[j] for j in range(r)
        ]
        rows = [row if i == k else swept(i) for i in range(r)]
    return jnp.stack([jnp.stack(row) for row in rows])


def _wide_inverse(a):
    """As `_inverse`, in a loop over the pivots."""
    size = a.shape[0]
    number = np.arange(size)

    def sweep(k, a):
        row, column = (lax.dynamic_slice_in_dim(a, k, 1, axis) for axis in (0, 1))
        pivot = 1 / lax.dynamic_slice_in_dim(row, k, 1, 1)
        in_row, in_column = (number == k)[:, None, None], (number == k)[None, :, None]
        zero = jnp.zeros((), a.dtype)
        row = jnp.where(in_column, pivot, row * pivot)
        swept = jnp.where(in_column, zero, a) - column * row
        return jnp.where(in_row, row, swept)

    return lax.fori_loop(0, size, sweep, a)
