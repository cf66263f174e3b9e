"""Pytrees of arrays as rows of tables."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from .linear_map import filled


class Layout:
    """Rows as vectors, one for each type of numbers."""

    def __init__(self, example: PyTree):
        arrays, self.static = eqx.partition(example, lambda x: isinstance(x, jax.ShapeDtypeStruct | jax.Array))
        leaves, self.structure = jax.tree.flatten(arrays)
        self.leaves = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
        self.types = sorted({x.dtype for x in self.leaves}, key=str)

    def blank(self, length: int) -> list[Array]:
        """Buffers of this many rows of zeros."""
        size = lambda dtype: sum(x.size for x in self.leaves if x.dtype == dtype)
        return [jnp.zeros((length, size(dtype)), dtype) for dtype in self.types]

    def packed(self, row: PyTree[Array]) -> list[Array]:
        """A row as vectors."""
        leaves = jax.tree.leaves(eqx.filter(row, eqx.is_array))
        return [self._joined(leaves, dtype) for dtype in self.types]

    def packed_tangent(self, row: PyTree[Array], tangent: PyTree[Array]) -> list[Array]:
        """The tangent of a row, or of parts of it, as tangents of its floating-point vectors."""
        arrays = eqx.filter(row, eqx.is_array)
        leaves = jax.tree.leaves(filled(arrays, tangent))
        return [self._joined(leaves, dtype) for dtype in self.types if jnp.issubdtype(dtype, jnp.floating)]

    def _joined(self, leaves, dtype):
        chosen = [x for x, of in zip(leaves, self.leaves, strict=True) if of.dtype == dtype]
        # To ravel a vector is a function call for the tracer.
        return jnp.concatenate([x if jnp.ndim(x) == 1 else jnp.reshape(x, -1) for x in chosen])

    def unpacked(self, vectors: list[Array]) -> PyTree[Array]:
        """The inverse of `packed`."""
        given, starts, leaves = dict(zip(self.types, vectors, strict=True)), dict.fromkeys(self.types, 0), []
        for of in self.leaves:
            start = starts[of.dtype]
            leaves.append(given[of.dtype][start : start + of.size].reshape(of.shape))
            starts[of.dtype] = start + of.size
        return eqx.combine(jax.tree.unflatten(self.structure, leaves), self.static)


def switch(index: Array, branches: Sequence[Callable[..., PyTree]], *operands: PyTree) -> PyTree:
    """`lax.switch` with a result in few vectors: XLA copies each array that a branch returns unchanged."""
    layout = Layout(eqx.filter_eval_shape(branches[0], *operands))
    packed = [lambda *given, branch=branch: layout.packed(branch(*given)) for branch in branches]
    return layout.unpacked(lax.switch(index, packed, *operands))
