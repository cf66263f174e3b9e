"""Products of stacks of small blocks, written as sums.

XLA fuses a sum of products with the surrounding operations; a batched dot of small blocks is a library call.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def matrix_products(a: Float[Array, "k i j"], b: Float[Array, "k j l"]) -> Float[Array, "k i l"]:
    """`a[k] @ b[k]` for every k."""
    return jnp.sum(a[:, :, :, None] * b[:, None, :, :], axis=2)


def vector_products(a: Float[Array, "k i j"], x: Float[Array, "k j"]) -> Float[Array, "k i"]:
    """`a[k] @ x[k]` for every k."""
    return jnp.sum(a * x[:, None, :], axis=2)


def matrix_product(a: Float[Array, "i j"], b: Float[Array, "j l"]) -> Float[Array, "i l"]:
    """`a @ b` of one pair of small blocks."""
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def vector_product(a: Float[Array, "i j"], x: Float[Array, "j"]) -> Float[Array, "i"]:
    """`a @ x` of one small block."""
    return jnp.sum(a * x[None, :], axis=1)
