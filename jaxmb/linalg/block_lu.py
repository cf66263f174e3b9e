"""Elimination of block-sparse matrices that are not symmetric, real or complex, in a given order of their nodes.

The pattern is symmetric: there is a block for (i, j) if there is one for (j, i). `S = L D U` without a search for
pivots, so the order must be one in which every pivot is regular. One loop executes the steps of a stage of the order;
each eliminates some nodes at once.

Source: J. W. H. Liu, "The multifrontal method for sparse matrix solution", SIAM Review 34(1), 1992.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Inexact

from .arrays import add_up, unchecked_take
from .elimination_order import NodeOrder


class BlockLU(eqx.Module):
    """A factored matrix; numbers without derivatives.

    **Fields:** for each stage, step and lane the `inverses` (steps, b, b, w) of the pivots; the `below` and the
    transposed `right` ones (steps, b, b, d, w): L and Uᵀ in the columns of the pivots; `rest`: the inverse of the dense
    matrix of the nodes that are left; the `order`.
    """

    inverses: tuple[Inexact[Array, "s b b w"], ...]
    below: tuple[Inexact[Array, "s b b d w"], ...]
    right: tuple[Inexact[Array, "s b b d w"], ...]
    rest: Inexact[Array, "k k"]
    order: NodeOrder = eqx.field(static=True)

    def solve(self, x: Inexact[Array, "n b"]) -> Inexact[Array, "n b"]:
        """`S⁻¹ x`."""
        order = self.order
        x = jnp.pad(x, ((0, 1), (0, 0)))
        for stage, below in zip(order.stages, self.below, strict=True):
            x = lax.scan(_forward, x, (stage.nodes, stage.later, below))[0]
        if order.rest.size:
            rest = self.rest @ unchecked_take(x, order.rest).reshape(-1)
            x = x.at[order.rest].set(rest.reshape(-1, x.shape[1]), mode="promise_in_bounds", unique_indices=True)
        for stage, inverses, right in reversed(list(zip(order.stages, self.inverses, self.right, strict=True))):
            own = jnp.moveaxis(unchecked_take(x, stage.nodes), 2, 1)
            own = add_up([inverses[:, :, j] * own[:, j, None] for j in range(own.shape[1])])
            x = lax.scan(_backward, x, (stage.nodes, stage.later, own, right), reverse=True)[0]
        return x[:-1]

    def transpose(self) -> "BlockLU":
        """The factor of Sᵀ."""
        inverses = tuple(inverse.swapaxes(1, 2) for inverse in self.inverses)
        return BlockLU(inverses, self.right, self.below, self.rest.T, self.order)


def eliminate_unsymmetric(
    lower: Inexact[Array, "blocks b b"], upper: Inexact[Array, "blocks b b"], order: NodeOrder
) -> BlockLU:
    """The factor of a matrix from its stored blocks, those of fill zero; see `NodeOrder`.

    **Arguments:** `lower`: the blocks whose row is the later node, and those on the diagonal; `upper`: the others, each
    at the place of the block that mirrors it; on the diagonal anything.
    """
    size, dtype = lower.shape[1], lower.dtype
    padding = jnp.stack([jnp.zeros((size, size), dtype), jnp.eye(size, dtype=dtype)])
    blocks = jnp.stack([jnp.concatenate([lower, padding]), jnp.concatenate([upper.swapaxes(1, 2), padding])], axis=1)
    inverses, below, right = [], [], []
    for stage in order.stages:
        blocks, found = lax.scan(_eliminate, blocks, (stage.diagonal, stage.columns, stage.targets))
        for parts, part in zip((inverses, below, right), found, strict=True):
            parts.append(part)
    return BlockLU(tuple(inverses), tuple(below), tuple(right), _dense_inverse(blocks, order), order)


# In a step the lanes are the last axis, so that each operation is one on long vectors. The barriers keep XLA from
# computing an operand of a product anew for each of its entries. The blocks to the right of the diagonal are held as
# their transposes, beside those below it.


def _eliminate(blocks, step):
    diagonal, columns, targets = step
    inverse = lax.optimization_barrier(_inverse(jnp.moveaxis(unchecked_take(blocks, diagonal)[:, 0], 0, 2)))
    # (2, b, b, d, w)
    column = jnp.transpose(unchecked_take(blocks, columns), (2, 3, 4, 1, 0))
    below, right = column
    size, d = inverse.shape[0], columns.shape[1]
    multiple = add_up([below[:, j, None] * inverse[None, j, :, None] for j in range(size)])
    transposed = add_up([right[:, j, None] * inverse[None, :, j, None] for j in range(size)])
    multiple, below, right, transposed = lax.optimization_barrier((multiple, below, right, transposed))
    first, second = np.tril_indices(d)
    # The change of the block (a, b) is L_a (b's part of U), that of (b, a), transposed, is its mirror image.
    left = lax.optimization_barrier(jnp.stack([multiple[:, :, first], transposed[:, :, first]]))
    other = lax.optimization_barrier(jnp.stack([right[:, :, second], below[:, :, second]]))
    change = lax.optimization_barrier(add_up([left[:, :, j, None] * other[:, None, :, j] for j in range(size)]))
    blocks = blocks.at[targets].add(-jnp.transpose(change, (4, 3, 0, 1, 2)), mode="promise_in_bounds")
    return blocks, (inverse, multiple, transposed)


def _forward(x, step):
    nodes, later, below = step
    own = unchecked_take(x, nodes).T
    change = add_up([below[:, j] * own[None, j, None] for j in range(own.shape[0])])
    return x.at[later].add(-jnp.transpose(change, (2, 1, 0)), mode="promise_in_bounds"), None


def _backward(x, step):
    nodes, later, own, right = step
    ahead = unchecked_take(x, later).T
    # The pivot's row is its inverse times the transposed blocks.
    change = add_up([right[i] * ahead[i, None] for i in range(ahead.shape[0])])
    own = own - jnp.sum(change, axis=1)
    return x.at[nodes].set(own.T, mode="promise_in_bounds"), None


def _dense_inverse(blocks, order):
    k, size = order.rest.size, blocks.shape[2]
    both = unchecked_take(blocks, order.rest_blocks)
    above = np.triu(np.ones((k, k), bool), 1)[:, :, None, None]
    full = jnp.where(above, both[:, :, 1].swapaxes(2, 3), both[:, :, 0])
    matrix = full.swapaxes(1, 2).reshape(k * size, k * size)
    return _inverse(matrix[:, :, None])[:, :, 0] if k else matrix


def _inverse(a):
    """Inverses of blocks (b, b, w), by Gauss–Jordan elimination on the diagonal."""
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
