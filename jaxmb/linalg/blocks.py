"""Products of stacks of small blocks, written term by term.

XLA fuses a sum of few terms with the surrounding operations. A batched dot of small blocks is a library call, and a
reduction over an axis of a few entries takes three to five times as long.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .arrays import add_up, namespace
from .bilinear import bilinear_primitive


def matrix_products(a: Float[Array, "*k i j"], b: Float[Array, "*k j l"]) -> Float[Array, "*k i l"]:
    """`a[k] @ b[k]` for every k. NumPy in, NumPy out."""
    if namespace(a, b) is np:
        return np.matmul(a, b)
    if a.shape[:-2] != b.shape[:-2]:
        stack = jnp.broadcast_shapes(a.shape[:-2], b.shape[:-2])
        a, b = (jnp.broadcast_to(x, (*stack, *x.shape[-2:])) for x in (a, b))
    return _products(a, b)


def vector_products(a: Float[Array, "*k i j"], x: Float[Array, "*k j"]) -> Float[Array, "*k i"]:
    """`a[k] @ x[k]` for every k."""
    return matrix_products(a, x[..., None])[..., 0]


def transpose_vector_products(a: Float[Array, "*k i j"], x: Float[Array, "*k i"]) -> Float[Array, "*k j"]:
    """`a[k].T @ x[k]` for every k."""
    return matrix_products(x[..., None, :], a)[..., 0, :]


def _evaluate(a, b):
    if a.shape[-1] == 0:
        return jnp.zeros((*a.shape[:-1], b.shape[-1]), a.dtype)
    return add_up([a[..., :, j, None] * b[..., None, j, :] for j in range(a.shape[-1])])


_products = bilinear_primitive(
    "block_products",
    _evaluate,
    lambda a, b: (*a.shape[:-1], b.shape[-1]),
    lambda c, b: _products(c, b.swapaxes(-1, -2)),
    lambda c, a: _products(a.swapaxes(-1, -2), c),
)
