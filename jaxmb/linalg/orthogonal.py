"""Orthonormal bases of what a matrix spans and of the rest, by Householder's reflections inside `lax`.

Bases are a choice: turned within the space that they span they serve as well. So are their derivatives, and the ones
here turn as little as they can (parallel transport). Results that do not depend on the choice, such as projections,
pseudo-inverses and solutions, have their true derivatives of every order; single columns have none.

Source: G. H. Golub and V. Pereyra, "The Differentiation of Pseudo-Inverses and Nonlinear Least Squares Problems Whose
Variables Separate", SIAM J. Numer. Anal. 10(2), 1973.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .elimination import gauss_jordan


class Frame(eqx.Module):
    """An orthonormal frame adapted to a matrix C (n × r) of full column rank.

    **Fields:** `along` (n × r): orthonormal basis of the range of C; `across` (n × (n − r)): of its orthogonal
    complement, the null space of Cᵀ; `inverse` (r × r): of the components `alongᵀ C`.
    """

    along: Float[Array, "n r"]
    across: Float[Array, "n f"]
    inverse: Float[Array, "r r"]

    @property
    def pseudoinverse(self) -> Float[Array, "r n"]:
        """C⁺: least-squares solutions of `C x = y`; transposed, the shortest solutions of `Cᵀ x = y`."""
        return self.inverse @ self.along.T


@jax.custom_jvp
def frame(C: Float[Array, "n r"]) -> Frame:
    """The frame adapted to a matrix of full column rank, by orthogonal factorisation; differentiable to every order."""
    n, r = C.shape
    if r == 0:
        return Frame(C, jnp.eye(n, dtype=C.dtype), jnp.zeros((0, 0), C.dtype))
    rows = jnp.arange(n)

    def reflect(k, work):
        column = jnp.where(rows < k, 0.0, work[:, k])
        size = jnp.sqrt(jnp.sum(column * column))
        # Away from the pivot's own sign nothing cancels.
        normal = column + jnp.where(rows == k, jnp.where(column < 0, -size, size), 0.0)
        return work - normal[:, None] * ((normal @ work) / (size * (size + jnp.abs(work[k, k]))))[None, :]

    work = lax.fori_loop(0, r, reflect, jnp.concatenate([C, jnp.eye(n, dtype=C.dtype)], axis=1))
    bases = work[:, r:].T
    return Frame(bases[:, :r], bases[:, r:], gauss_jordan(jnp.triu(work[:r, :r]), r))


@frame.defjvp
def _frame_jvp(primals, tangents):
    (C,), (dC,) = primals, tangents
    out = frame(C)
    change = dC @ out.inverse
    turn = out.across.T @ change
    return out, Frame(out.across @ turn, -out.along @ turn.T, -out.inverse @ (out.along.T @ change))
