"""Mass matrices by their structure: full, diagonal, or one block per body."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .blocks import matrix_products
from .elimination import cholesky, solve_positive
from .sums import unchecked_take

# Up to this number of velocities a full matrix has fewer instructions than its blocks, and is as fast.
_SMALL = 18


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

    def with_inverse(self, like: Float[Array, "n"]) -> "AbstractInertia":
        """The same matrix for vectors of this kind, which keeps its inverse if solutions are cheaper so."""
        if like.size > _SMALL:
            return self
        unit = jnp.eye(like.size, dtype=like.dtype)
        return InvertedInertia(DenseInertia(self.product(unit)), DenseInertia(self.solve(unit)))


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


class InvertedInertia(AbstractInertia):
    """A `matrix` with its `inverse`."""

    matrix: AbstractInertia
    inverse: AbstractInertia

    def product(self, v):
        return self.matrix.product(v)

    def solve(self, f):
        return self.inverse.product(f)

    def root(self):
        return self.matrix.root()

    def transpose(self):
        return InvertedInertia(self.matrix.transpose(), self.inverse.transpose())


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
        return self._apply(lambda n: matrix_products(inverses_3x3(self.inertia), n), 1 / self.mass, f)

    def root(self):
        return BlockInertia(jnp.sqrt(self.mass), jax.vmap(cholesky)(self.inertia))

    def transpose(self):
        return BlockInertia(self.mass, self.inertia.swapaxes(1, 2))


class CoupledInertia(AbstractInertia):
    """A mass matrix of which groups of blocks, each on velocities of its own, are full matrices.

    **Fields:** `rest`: the matrix of the other velocities, of size n; `blocks` (b, w, w) of each group; `index`, for
    each group the indices of the blocks' velocities (b, w).
    """

    rest: AbstractInertia
    blocks: tuple[Float[Array, "b w w"], ...]
    index: tuple[tuple[tuple[int, ...], ...], ...] = eqx.field(static=True)

    def _apply(self, out, of_block, v):
        columns = v.reshape(len(v), -1)
        values, order, count = [out.reshape(columns.shape)], np.arange(len(v)), len(v)
        for blocks, index in zip(self.blocks, self.index, strict=True):
            place = np.array(index)
            of_blocks = of_block(blocks, unchecked_take(columns, place))
            values.append(of_blocks.reshape(place.size, -1))
            order[place] = count + np.arange(place.size).reshape(place.shape)
            count += place.size
        return unchecked_take(jnp.concatenate(values), order).reshape(v.shape)

    def product(self, v):
        return self._apply(self.rest.product(v), matrix_products, v)

    def solve(self, f):
        return self._apply(self.rest.solve(f), jax.vmap(solve_positive), f)

    def root(self):
        return CoupledInertia(self.rest.root(), tuple(jax.vmap(cholesky)(M) for M in self.blocks), self.index)

    def transpose(self):
        return CoupledInertia(self.rest.transpose(), tuple(M.swapaxes(1, 2) for M in self.blocks), self.index)


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


def inverses_3x3(J: Float[Array, "b 3 3"]) -> Float[Array, "b 3 3"]:
    """Inverses of 3 × 3 matrices, as the transpose of cofactors over the determinant."""
    entries = J.reshape(-1, 9).T
    (first, second), (third, fourth) = _COFACTORS
    product = lambda a, b: unchecked_take(entries, a) * unchecked_take(entries, b)
    cofactors = product(first, second) - product(third, fourth)
    determinant = jnp.sum(entries[:3] * cofactors[:3], axis=0)
    return (unchecked_take(cofactors, _TRANSPOSED) / determinant[None]).T.reshape(J.shape)


def _places_of_cofactors():
    """The entries, as places in the raveled matrix, whose products differ by the cofactors."""
    row, column = np.divmod(np.arange(9), 3)
    place = lambda by, along: 3 * ((row + by) % 3) + (column + along) % 3
    return (place(1, 1), place(2, 2)), (place(1, 2), place(2, 1))


_COFACTORS, _TRANSPOSED = _places_of_cofactors(), np.arange(9).reshape(3, 3).T.reshape(-1)
