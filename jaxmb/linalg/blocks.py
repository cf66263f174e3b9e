"""Products of stacks of small blocks, written term by term.

XLA fuses a sum of few terms with the surrounding operations. A batched dot of small blocks is a library call, and a
reduction over an axis of a few entries takes three to five times as long.
"""

import functools

import jax.numpy as jnp
from jaxtyping import Array, Float


def matrix_products(a: Float[Array, "*k i j"], b: Float[Array, "*k j l"]) -> Float[Array, "*k i l"]:
    """`a[k] @ b[k]` for every k."""
    return _sum([a[..., :, j, None] * b[..., None, j, :] for j in range(a.shape[-1])])


def vector_products(a: Float[Array, "*k i j"], x: Float[Array, "*k j"]) -> Float[Array, "*k i"]:
    """`a[k] @ x[k]` for every k."""
    return _sum([a[..., :, j] * x[..., j, None] for j in range(a.shape[-1])])


def transpose_vector_products(a: Float[Array, "*k i j"], x: Float[Array, "*k i"]) -> Float[Array, "*k j"]:
    """`a[k].T @ x[k]` for every k."""
    return _sum([a[..., i, :] * x[..., i, None] for i in range(a.shape[-2])])


def _sum(terms):
    return functools.reduce(jnp.add, terms)
