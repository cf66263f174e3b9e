"""Orthonormal bases of the range of a matrix and of its complement, by Householder reflections inside `lax`.

A basis is unique only up to a rotation within its span, and so is its derivative; the derivatives here contain no such
rotation (parallel transport). Results that do not depend on the choice, such as projections, pseudo-inverses and
solutions, have true derivatives of every order; single columns have none.

Source: G. H. Golub and V. Pereyra, "The Differentiation of Pseudo-Inverses and Nonlinear Least Squares Problems Whose
Variables Separate", SIAM J. Numer. Anal. 10(2), 1973.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .elimination import gauss_jordan


class AdaptedBasis(eqx.Module):
    """An orthonormal basis adapted to a matrix C (n × r) of full column rank.

    **Fields:** `range` (n × r): orthonormal basis of the range of C; `complement` (n × (n − r)): of its orthogonal
    complement, the null space of Cᵀ; `inverse` (r × r): of the components `rangeᵀ C`.
    """

    range: Float[Array, "n r"]
    complement: Float[Array, "n f"]
    inverse: Float[Array, "r r"]

    @property
    def pseudoinverse(self) -> Float[Array, "r n"]:
        """C⁺: least-squares solutions of `C x = y`; transposed, the shortest solutions of `Cᵀ x = y`."""
        return self.inverse @ self.range.T


@jax.custom_jvp
def orthogonal_basis(C: Float[Array, "n r"]) -> AdaptedBasis:
    """The basis adapted to a matrix of full column rank, by orthogonal factorisation; differentiable to every order."""
    n, r = C.shape
    if r == 0:
        return AdaptedBasis(C, jnp.eye(n, dtype=C.dtype), jnp.zeros((0, 0), C.dtype))
    rows = jnp.arange(n)

    def reflect(k, work):
        column = jnp.where(rows < k, 0.0, work[:, k])
        size = jnp.sqrt(jnp.sum(column * column))
        # The sign opposite to the pivot's avoids cancellation.
        normal = column + jnp.where(rows == k, jnp.where(column < 0, -size, size), 0.0)
        return work - normal[:, None] * ((normal @ work) / (size * (size + jnp.abs(work[k, k]))))[None, :]

    work = lax.fori_loop(0, r, reflect, jnp.concatenate([C, jnp.eye(n, dtype=C.dtype)], axis=1))
    bases = work[:, r:].T
    return AdaptedBasis(bases[:, :r], bases[:, r:], gauss_jordan(jnp.triu(work[:r, :r]), r))


@orthogonal_basis.defjvp
def _orthogonal_basis_jvp(primals, tangents):
    (C,), (dC,) = primals, tangents
    out = orthogonal_basis(C)
    change = dC @ out.inverse
    turn = out.complement.T @ change
    along = out.range.T @ change
    return out, AdaptedBasis(out.complement @ turn, -out.range @ turn.T, -out.inverse @ along)
