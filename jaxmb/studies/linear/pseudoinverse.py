"""Least-squares solutions of rows that may be dependent, differentiable at constant rank."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Singular values below this fraction of the largest count as zero.
_NEGLIGIBLE = 1e-7


@jax.custom_jvp
def pseudoinverse(E: Float[Array, "m n"]) -> Float[Array, "n m"]:
    """`E⁺`, with small singular values taken as zeros; its derivatives of every order are at constant rank.

    Source: G. H. Golub and V. Pereyra, SIAM J. Numer. Anal. 10(2), 1973.
    """
    negligible = max(_NEGLIGIBLE, float(jnp.finfo(E.dtype).eps) ** 0.5)
    left, values, right = jnp.linalg.svd(E, full_matrices=False)
    kept = values > negligible * jnp.max(values, initial=0.0)
    return (right.T * jnp.where(kept, 1 / jnp.where(kept, values, 1.0), 0.0)[None, :]) @ left.T


@pseudoinverse.defjvp
def _pseudoinverse_jvp(primals, tangents):
    (E,), (dE,) = primals, tangents
    P = pseudoinverse(E)
    beside = jnp.eye(E.shape[0], dtype=E.dtype) - E @ P
    free = jnp.eye(E.shape[1], dtype=E.dtype) - P @ E
    return P, -P @ dE @ P + P @ P.T @ dE.T @ beside + free @ dE.T @ P.T @ P
