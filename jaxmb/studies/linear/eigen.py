"""Eigenvalues and eigenvectors of a real matrix without symmetry, with derivatives of simple ones."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float


@jax.custom_jvp
def eigen(
    A: Float[Array, "n n"], kept: Bool[Array, "n"]
) -> tuple[Complex[Array, "n"], Complex[Array, "n n"], Bool[Array, "n"]]:
    """Eigenvalues and right eigenvectors of a block of a matrix.

    Derivatives of a simple eigenvalue and of its eigenvector follow from the equation `A v = λ v` with one component of
    v held; the derivative of λ is `wᵀ dA v / wᵀ v`, with the left eigenvector w. For a repeated eigenvalue the
    derivatives do not exist; the results are not finite.

    **Arguments:** `A`; `kept`: the rows and columns of the block. The others have eigenvalues zero.

    **Returns:** the eigenvalues in order of their sizes, in a pair the positive imaginary part first; the eigenvectors
    as columns, with largest component one; and the mask of eigenvalues of the block.
    """
    block = jnp.where(kept[:, None] & kept[None, :], A, jnp.zeros_like(A))
    values, vectors = jnp.linalg.eig(block)
    order = jnp.lexsort((-values.imag, jnp.abs(values)))
    values, vectors = values[order], vectors[:, order]
    largest = jnp.argmax(jnp.abs(vectors), axis=0)
    vectors = vectors / jnp.take_along_axis(vectors, largest[None, :], axis=0)
    # A row and a column of zeros have a unit vector as eigenvector.
    of_block = jnp.sum(jnp.where(kept[:, None], 0.0, jnp.abs(vectors)), axis=0) < 0.5
    return values, vectors, of_block


@eigen.defjvp
def _eigen_jvp(primals, tangents) -> Any:
    (A, kept), (dA, _) = primals, tangents
    values, vectors, inside = eigen(A, kept)
    both = kept[:, None] & kept[None, :]
    A, dA = (jnp.where(both, x, 0.0).astype(vectors.dtype) for x in (A, dA))
    largest = jnp.argmax(jnp.abs(lax.stop_gradient(vectors)), axis=0)
    n = A.shape[0]
    unit = jnp.eye(n + 1, dtype=A.dtype)

    def of_one(value, vector, k, of_block):
        bordered = jnp.zeros_like(unit).at[:n, :n].set(A - value * unit[:n, :n])
        bordered = bordered.at[:n, n].set(-vector).at[n, :n].set(unit[k, :n])
        # Rows outside the block are held; their modes do not change.
        bordered = jnp.where(jnp.append(kept, True)[:, None], bordered, unit)
        bordered = jnp.where(of_block, bordered, unit)
        change = jnp.linalg.solve(bordered, jnp.append(-(dA @ vector), jnp.zeros((), A.dtype)))
        change = jnp.where(of_block, change, jnp.zeros_like(change))
        return change[n], change[:n]

    dvalues, dvectors = jax.vmap(of_one, in_axes=(0, 1, 0, 0), out_axes=(0, 1))(values, vectors, largest, inside)
    return (values, vectors, inside), (dvalues, dvectors, np.zeros(inside.shape, jax.dtypes.float0))
