"""Mass matrices by their structure: full, diagonal, or one block per body."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .blocks import matrix_products
from .elimination import cholesky, solve_positive
from .rotations import cross


class AbstractInertia(eqx.Module):
    """A symmetric positive definite mass matrix M (n × n), or a root of one."""

    @abc.abstractmethod
    def product(self, v: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """`M v`."""

    @abc.abstractmethod
    def solve(self, f: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """`M⁻¹ f`."""

    @abc.abstractmethod
    def root(self) -> "AbstractInertia":
        """L with `M = L Lᵀ`: in the quasi-velocities `Lᵀ u` the mass matrix is the identity."""

    @abc.abstractmethod
    def transpose(self) -> "AbstractInertia":
        """The transpose; it differs from the matrix only for a root."""


class DiagonalInertia(AbstractInertia):
    """Planar bodies about their mass centres. `diagonal`: shape (n,) [kg, kg m²]."""

    diagonal: Float[Array, "n"]

    def product(self, v):
        return (self.diagonal if v.ndim == 1 else self.diagonal[:, None]) * v

    def solve(self, f):
        return f / (self.diagonal if f.ndim == 1 else self.diagonal[:, None])

    def root(self):
        return DiagonalInertia(jnp.sqrt(self.diagonal))

    def transpose(self):
        return self


class BlockInertia(AbstractInertia):
    """Spatial bodies about their mass centres: mass on translations, a 3 × 3 matrix on the body-frame angular velocity.

    **Fields:** `mass`: shape (bodies,) [kg]; `inertia`: shape (bodies, 3, 3) [kg m²].
    """

    mass: Float[Array, "b"]
    inertia: Float[Array, "b 3 3"]

    def _apply(self, rotate, scale, v):
        blocks = v.reshape(self.mass.shape[0], 6, -1)
        translations = scale[:, None, None] * blocks[:, :3]
        return jnp.concatenate([translations, rotate(blocks[:, 3:])], axis=1).reshape(v.shape)

    def product(self, v):
        return self._apply(lambda w: matrix_products(self.inertia, w), self.mass, v)

    def solve(self, f):
        return self._apply(lambda n: matrix_products(_inverse_3x3(self.inertia), n), 1 / self.mass, f)

    def root(self):
        return BlockInertia(jnp.sqrt(self.mass), jax.vmap(cholesky)(self.inertia))

    def transpose(self):
        return BlockInertia(self.mass, self.inertia.swapaxes(1, 2))


class DenseInertia(AbstractInertia):
    """A full matrix, shape (n, n)."""

    matrix: Float[Array, "n n"]

    def product(self, v):
        return self.matrix @ v

    def solve(self, f):
        return solve_positive(self.matrix, f)

    def root(self):
        return DenseInertia(cholesky(self.matrix))

    def transpose(self):
        return DenseInertia(self.matrix.T)


def _inverse_3x3(J):
    # Row k of the cofactors is the vector product of the two rows after row k.
    cofactors = jax.vmap(jax.vmap(cross))(J[:, np.array([1, 2, 0])], J[:, np.array([2, 0, 1])])
    return cofactors.swapaxes(1, 2) / jnp.sum(J[:, 0] * cofactors[:, 0], axis=-1)[:, None, None]
