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

from .arrays import unchecked_take
from .elimination import gauss_jordan
from .elimination_order import NodeOrder


class BlockFactor(eqx.Module):
    """A factored matrix; numbers without derivatives.

    **Fields:** for each stage, step and lane the `inverses` (steps, w, b, b) of the pivots, and the `multiples`
    (steps, w, d, b, b) of the pivots' rows that are subtracted from later ones; `rest`: the inverse of the dense matrix
    of the nodes that are left; the `order`.
    """

    inverses: tuple[Float[Array, "s w b b"], ...]
    multiples: tuple[Float[Array, "s w d b b"], ...]
    rest: Float[Array, "k k"]
    order: NodeOrder = eqx.field(static=True)

    def solve(self, x: Float[Array, "n b"]) -> Float[Array, "n b"]:
        """`S⁻¹ x`."""
        order = self.order
        x = jnp.pad(x, ((0, 1), (0, 0)))
        for stage, multiples in zip(order.stages, self.multiples, strict=True):
            x = lax.scan(_forward, x, (stage.nodes, stage.later, multiples))[0]
        if order.rest.size:
            size = x.shape[1]
            rest = self.rest @ unchecked_take(x, order.rest).reshape(-1)
            x = x.at[order.rest].set(rest.reshape(-1, size), mode="promise_in_bounds", unique_indices=True)
        for stage, inverses, multiples in reversed(list(zip(order.stages, self.inverses, self.multiples, strict=True))):
            own = _apply(inverses, unchecked_take(x, stage.nodes))
            x = lax.scan(_backward, x, (stage.nodes, stage.later, own, multiples), reverse=True)[0]
        return x[:-1]

    def pivots(self) -> Float[Array, "n b"]:
        """For each row the reciprocal of the diagonal entry of its pivot's inverse."""
        size = (
            self.rest.shape[0] // max(self.order.rest.size, 1) if self.order.rest.size else self.inverses[0].shape[-1]
        )
        out = jnp.ones((self.order.nodes + 1, size), self.rest.dtype)
        for stage, inverses in zip(self.order.stages, self.inverses, strict=True):
            out = out.at[stage.nodes].set(1 / jnp.diagonal(inverses, axis1=2, axis2=3), mode="promise_in_bounds")
        return out.at[self.order.rest].set(1 / jnp.diag(self.rest).reshape(-1, size))[:-1]


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


def _eliminate(blocks, step):
    diagonal, columns, targets = step
    inverse = _inverse(unchecked_take(blocks, diagonal))
    column = unchecked_take(blocks, columns)
    multiple = jnp.sum(column[..., :, :, None] * inverse[:, None, None, :, :], axis=-2)
    d = columns.shape[1]
    first, second = np.tril_indices(d)
    change = jnp.sum(multiple[:, first, :, None, :] * column[:, second, None, :, :], axis=-1)
    blocks = blocks.at[targets].add(-change, mode="promise_in_bounds")
    return blocks, (inverse, multiple)


def _forward(x, step):
    nodes, later, multiples = step
    own = unchecked_take(x, nodes)
    change = jnp.sum(multiples * own[:, None, None, :], axis=-1)
    return x.at[later].add(-change, mode="promise_in_bounds"), None


def _backward(x, step):
    nodes, later, own, multiples = step
    ahead = jnp.sum(multiples * unchecked_take(x, later)[..., :, None], axis=(1, 2))
    return x.at[nodes].set(own - ahead, mode="promise_in_bounds"), None


def _apply(a, x):
    return jnp.sum(a * x[..., None, :], axis=-1)


def _dense_inverse(blocks, order):
    k, size = order.rest.size, blocks.shape[1]
    lower = unchecked_take(blocks, order.rest_blocks)
    # Blocks above the diagonal are stored as their transposes.
    above = np.triu(np.ones((k, k), bool), 1)[:, :, None, None]
    full = jnp.where(above, lower.swapaxes(2, 3), lower)
    return gauss_jordan(full.swapaxes(1, 2).reshape(k * size, k * size), k * size)


def _inverse(a):
    """Inverses of small symmetric blocks, by Gauss–Jordan elimination on the diagonal."""
    r = a.shape[-1]
    if r == 1:
        return 1 / a
    if r == 2:
        p, q, s = a[..., 0, 0], a[..., 1, 0], a[..., 1, 1]
        rows = [jnp.stack([s, -q], axis=-1), jnp.stack([-q, p], axis=-1)]
        return jnp.stack(rows, axis=-2) / (p * s - q * q)[..., None, None]
    for k in range(r):
        pivot = 1 / a[..., k, k]
        here = np.arange(r) == k
        row = jnp.where(here, 1.0, a[..., k, :]) * pivot[..., None]
        column = jnp.where(here, 0.0, a[..., :, k])
        kept = jnp.where(here, 0.0, a)
        a = jnp.where(here[:, None], row[..., None, :], kept - column[..., :, None] * row[..., None, :])
    return a
