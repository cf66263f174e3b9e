"""Bilinear functions as JAX primitives, whose derivatives are bilinear functions of the same kind.

The products of rotation algebra and of small blocks are written term by term, and XLA fuses them with the surrounding
operations. Differentiated term by term, each slice becomes a padded sum, which XLA does not fuse. Reverse derivatives
of rotations took five times as long, and rotations were half of the operations of a spatial machine's program.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._compat import define_bilinear
from .arrays import add_up, namespace

# A longer result is assembled from columns: a concatenation of many components is a separate kernel.
_FEW = 4


def bilinear_primitive(
    name: str,
    evaluate: Callable[..., Array],
    shape: Callable[..., tuple[int, ...]],
    gradient_a: Callable[..., Array],
    gradient_b: Callable[..., Array],
    parameters: tuple[str, ...] = (),
) -> Callable[..., Array]:
    """A primitive for a bilinear function of two arrays of one type.

    **Arguments:** `evaluate(a, b, **static)`, with any leading axes that a and b share; `shape(a, b, **static)` of the
    result; `gradient_a(c, b, **static)` and `gradient_b(c, a, **static)`: the gradients of `Σ c · evaluate(a, b)`;
    names of the static `parameters`.
    """

    bind_strictly = define_bilinear(name, evaluate, shape, (gradient_a, gradient_b), parameters)

    def bind(a: Any, b: Any, **static: Any) -> Array:
        dtype = jnp.result_type(a, b)
        return bind_strictly(jnp.asarray(a, dtype), jnp.asarray(b, dtype), **static)

    return bind


@dataclasses.dataclass(frozen=True)
class BilinearMap:
    """`c_i = Σ table[i, j, k] a_j b_k` of short vectors. NumPy in, NumPy out.

    **Arguments:** `shape`: lengths of c, a and b; `terms`: the entries of the table that are not zero, each as
    (i, j, k, value).
    """

    shape: tuple[int, int, int]
    terms: tuple[tuple[int, int, int, float], ...]

    @staticmethod
    def of(table: Float[np.ndarray, "i j k"]) -> "BilinearMap":
        """The map with a table."""
        places = np.argwhere(table).tolist()
        return BilinearMap(table.shape, tuple((i, j, k, float(table[i, j, k])) for i, j, k in places))

    @functools.cached_property
    def table(self) -> Float[np.ndarray, "i j k"]:
        """All entries."""
        table = np.zeros(self.shape)
        for *place, value in self.terms:
            table[tuple(place)] = value
        return table

    def transpose(self, *axes: int) -> "BilinearMap":
        """The map with a transposed table: `transpose(1, 0, 2)` takes (c, b) to the gradient with respect to a."""
        return _transposed(self, axes)

    def __call__(self, a: Float[Array, "*n j"], b: Float[Array, "*n k"]) -> Float[Array, "*n i"]:
        if namespace(a, b) is np:
            return np.einsum("ijk,...j,...k->...i", self.table.astype(np.result_type(a, b, np.float32)), a, b)
        return _apply(a, b, of=self)


@functools.cache
def _transposed(bilinear_map, axes):
    return BilinearMap.of(bilinear_map.table.transpose(axes))


def _evaluate(a, b, *, of):
    return _by_components(a, b, of) if of.shape[0] <= _FEW else _by_columns(a, b, of)


def _by_components(a, b, of):
    components = lambda x: [x[..., k : k + 1] for k in range(x.shape[-1])]
    of_a, of_b = components(a), components(b)
    sums: list = [None] * of.shape[0]
    for i, j, k, value in of.terms:
        product = of_a[j] * of_b[k]
        if abs(value) != 1:
            product = product * np.asarray(abs(value), a.dtype)
        if sums[i] is None:
            sums[i] = product if value > 0 else -product
        else:
            sums[i] = sums[i] + product if value > 0 else sums[i] - product
    zero = jnp.zeros((*a.shape[:-1], 1), a.dtype)
    return jnp.concatenate([zero if component is None else component for component in sums], axis=-1)


def _by_columns(a, b, of):
    # Sums of constant columns, with the leading axes of the operands. A reduction of some thousand numbers would be a
    # library call: the accelerations of the rows of a chain of 200 ball joints would take 85 µs instead of 18.
    table = of.table.astype(a.dtype).reshape(*(1,) * (a.ndim - 1), *of.shape)

    def column(j):
        return add_up(table[..., j, k] * b[..., k : k + 1] for k in np.flatnonzero(of.table[:, j].any(axis=0)))

    return add_up(column(j) * a[..., j : j + 1] for j in np.flatnonzero(of.table.any(axis=(0, 2))))


_apply = bilinear_primitive(
    "bilinear_map",
    _evaluate,
    lambda a, b, *, of: (*a.shape[:-1], of.shape[0]),
    lambda c, b, *, of: _apply(c, b, of=of.transpose(1, 0, 2)),
    lambda c, a, *, of: _apply(a, c, of=of.transpose(2, 1, 0)),
    parameters=("of",),
)
