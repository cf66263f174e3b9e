"""Elimination of symmetric block-sparse matrices in a given order of their nodes.

`S = L D Lᵀ` with blocks of one size and no search for pivots, which positive definite matrices do not need, nor
symmetric quasi-definite ones (positive definite in some nodes, negative definite in the others). One loop executes the
steps of a stage of the order; each eliminates some nodes at once.

Sources: J. W. H. Liu, "The multifrontal method for sparse matrix solution", SIAM Review 34(1), 1992; R. J. Vanderbei,
"Symmetric quasidefinite matrices", SIAM J. Optim. 5(1), 1995.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .arrays import add_up, unchecked_take
from .elimination import gauss_jordan
from .elimination_order import NodeOrder


class BlockFactor(eqx.Module):
    """A factored matrix; numbers without derivatives.

    **Fields:** for each stage, step and lane the `inverses` (steps, b, b, w) of the pivots, and the `multiples`
    (steps, b, b, d, w) of the pivots' rows that are subtracted from later ones; `rest`: the inverse of the dense matrix
    of the nodes that are left; the `order`.
    """

    inverses: tuple[Float[Array, "s b b w"], ...]
    multiples: tuple[Float[Array, "s b b d w"], ...]
    rest: Float[Array, "k k"]
    order: NodeOrder = eqx.field(static=True)

    def solve(self, x: Float[Array, "n b"]) -> Float[Array, "n b"]:
        """`S⁻¹ x`."""
        order = self.order
        x = jnp.pad(x, ((0, 1), (0, 0)))
        for stage, multiples in zip(order.stages, self.multiples, strict=True):
            x = lax.scan(_forward, x, (stage.nodes, stage.later, multiples))[0]
        if order.rest.size:
            rest = self.rest @ unchecked_take(x, order.rest).reshape(-1)
            x = x.at[order.rest].set(rest.reshape(-1, x.shape[1]), mode="promise_in_bounds", unique_indices=True)
        for stage, inverses, multiples in reversed(list(zip(order.stages, self.inverses, self.multiples, strict=True))):
            own = jnp.moveaxis(unchecked_take(x, stage.nodes), 2, 1)
            own = add_up([inverses[:, :, j] * own[:, j, None] for j in range(own.shape[1])])
            x = lax.scan(_backward, x, (stage.nodes, stage.later, own, multiples), reverse=True)[0]
        return x[:-1]

    def pivots(self) -> Float[Array, "n b"]:
        """For each row the reciprocal of the diagonal entry of its pivot's inverse."""
        order = self.order
        size = self.inverses[0].shape[1] if self.inverses else self.rest.shape[0] // order.rest.size
        out = jnp.ones((order.nodes + 1, size), self.rest.dtype)
        for stage, inverses in zip(order.stages, self.inverses, strict=True):
            out = out.at[stage.nodes].set(1 / jnp.diagonal(inverses, axis1=1, axis2=2), mode="promise_in_bounds")
        return out.at[order.rest].set(1 / jnp.diag(self.rest).reshape(-1, size))[:-1]


def eliminate_blocks(blocks: Float[Array, "blocks b b"], order: NodeOrder) -> BlockFactor:
    """The factor of a matrix from its stored blocks, those of fill zero; see `NodeOrder`."""
    size = blocks.shape[1]
    padding = jnp.stack([jnp.zeros((size, size), blocks.dtype), jnp.eye(size, dtype=blocks.dtype)])
    blocks = jnp.concatenate([lax.stop_gradient(blocks), padding])
    inverses, multiples = [], []
    for stage in order.stages:
        blocks, (inverse, multiple) = lax.scan(_eliminate, blocks, (stage.diagonal, stage.columns, stage.targets))
        inverses.append(inverse)
        multiples.append(multiple)
    return BlockFactor(tuple(inverses), tuple(multiples), _dense_inverse(blocks, order), order)


# In a step the lanes are the last axis, so that each operation is one on long vectors. The barriers keep XLA from
# computing an operand of a product anew for each of its entries.


def _eliminate(blocks, step):
    diagonal, columns, targets = step
    inverse = lax.optimization_barrier(_inverse(jnp.moveaxis(unchecked_take(blocks, diagonal), 0, 2)))
    column = jnp.transpose(unchecked_take(blocks, columns), (2, 3, 1, 0))
    size = inverse.shape[0]
    multiple = add_up([column[:, j, None] * inverse[None, j, :, None] for j in range(size)])
    first, second = np.tril_indices(columns.shape[1])
    multiple, column = lax.optimization_barrier((multiple, column))
    left, right = lax.optimization_barrier((multiple[:, :, first], column[:, :, second]))
    change = lax.optimization_barrier(add_up([left[:, j, None] * right[None, :, j] for j in range(size)]))
    blocks = blocks.at[targets].add(-jnp.transpose(change, (3, 2, 0, 1)), mode="promise_in_bounds")
    return blocks, (inverse, multiple)


def _forward(x, step):
    nodes, later, multiples = step
    own = unchecked_take(x, nodes).T
    change = add_up([multiples[:, j] * own[None, j, None] for j in range(own.shape[0])])
    return x.at[later].add(-change.T, mode="promise_in_bounds"), None


def _backward(x, step):
    nodes, later, own, multiples = step
    ahead = unchecked_take(x, later).T
    size, d = ahead.shape[:2]
    ahead = add_up([own, *(-multiples[i, :, k] * ahead[None, i, k] for i in range(size) for k in range(d))])
    return x.at[nodes].set(ahead.T, mode="promise_in_bounds"), None


def _dense_inverse(blocks, order):
    k, size = order.rest.size, blocks.shape[1]
    lower = unchecked_take(blocks, order.rest_blocks)
    # Blocks above the diagonal are stored as their transposes.
    above = np.triu(np.ones((k, k), bool), 1)[:, :, None, None]
    full = jnp.where(above, lower.swapaxes(2, 3), lower)
    return gauss_jordan(full.swapaxes(1, 2).reshape(k * size, k * size), k * size)


def _inverse(a):
    """Inverses of small symmetric blocks (b, b, w), by Gauss–Jordan elimination on the diagonal."""
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
