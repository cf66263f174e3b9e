"""Least-squares solutions of rows that may be dependent, differentiable at constant rank."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_NEGLIGIBLE = 1e-7


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def pseudoinverse(E: Float[Array, "m n"], negligible: float | None = None) -> Float[Array, "n m"]:
    """`E⁺`, with small singular values taken as zeros; its derivatives of every order are at constant rank.

    **Arguments:** `negligible`: the fraction of the largest singular value below which others count as zero; default
    1e-7, or the root of eps if that is larger.

    Source: G. H. Golub and V. Pereyra, SIAM J. Numer. Anal. 10(2), 1973.
    """
    if negligible is None:
        negligible = max(_NEGLIGIBLE, float(jnp.finfo(E.dtype).eps) ** 0.5)
    left, values, right = jnp.linalg.svd(E, full_matrices=False)
    kept = values > negligible * jnp.max(values, initial=0.0)
    return (right.T * jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)[None, :]) @ left.T


@pseudoinverse.defjvp
def _pseudoinverse_jvp(negligible, primals, tangents):
    (E,), (dE,) = primals, tangents
    P = pseudoinverse(E, negligible)
    beside = jnp.eye(E.shape[0], dtype=E.dtype) - E @ P
    free = jnp.eye(E.shape[1], dtype=E.dtype) - P @ E
    return P, -P @ dE @ P + P @ P.T @ dE.T @ beside + free @ dE.T @ P.T @ P
