"""Entries at static places, and sums of entries by static places, each the transpose of the other.

Both consist of gathers. The transpose of JAX's gather is a scatter, which XLA compiles to a loop on CPUs, and which is
slow on other devices. Scatters were a quarter of the kernels of a gradient in space.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._compat import define_linear
from .digest import digest

# The number of entries of a place that one pass adds up. More entries take another pass, so work grows with them.
_WIDTH = 4


@dataclasses.dataclass(frozen=True)
class PlacedSums:
    """Which entries add up to the value of each place; static, compared by its `key`.

    **Fields:** `passes`, each (sums, width): indices into the results of the pass before, followed by a zero.
    """

    key: Any
    passes: tuple[np.ndarray, ...] = dataclasses.field(compare=False)

    def __call__(self, entries: Float[Array, "e *s"]) -> Float[Array, "places *s"]:
        """The sums of each place; zero where a place has no entry."""
        for index in self.passes:
            entries = jnp.concatenate([entries, jnp.zeros((1, *entries.shape[1:]), entries.dtype)])
            parts = [unchecked_take(entries, index[:, k]) for k in range(index.shape[1])]
            entries = functools.reduce(jnp.add, parts)
        return entries


def placed_sums(place: Int[np.ndarray, "e"], places: int) -> PlacedSums:
    """The sums by the place of each entry; entries with a place out of bounds are dropped."""
    passes = []
    if np.array_equal(place, np.arange(places)):
        return PlacedSums(digest([]), ())
    kept = np.flatnonzero((place >= 0) & (place < places))
    order, entries = kept[np.argsort(place[kept], kind="stable")], place.size
    while True:
        ordered_places = place[order]
        counts = np.bincount(ordered_places, minlength=places)
        number = np.arange(ordered_places.size) - np.repeat(np.cumsum(counts) - counts, counts)
        last = np.max(counts, initial=0) <= _WIDTH
        # The sum that contains each entry: of its place, or of its group of entries at that place.
        groups = np.ones(places, int) if last else -(-counts // _WIDTH)
        first = np.cumsum(groups) - groups
        index = np.full((int(groups.sum()), min(_WIDTH, max(1, np.max(counts, initial=0)))), entries, np.int32)
        index[first[ordered_places] + number // _WIDTH, number % _WIDTH] = order
        passes.append(index)
        if last:
            break
        place = np.repeat(np.arange(places), groups)
        order, entries = np.arange(place.size), place.size
    return PlacedSums(digest(passes), tuple(passes))


def with_entries(values: Float[Array, "n"], places: Int[np.ndarray, "e"], entries: Float[Array, "e"]) -> Array:
    """A copy of the values with new entries at static places, all different."""
    return jnp.where(np.isin(np.arange(values.size), places), placed_sums(places, values.size)(entries), values)


def unchecked_take(values: Float[Array, "n *k"], index: Int[np.ndarray, "..."]) -> Float[Array, "..."]:
    """`values[index]` as a gather without checks: the indices are in bounds by construction. NumPy in, NumPy out."""
    if isinstance(values, np.ndarray):
        return values[index]
    if isinstance(index, jax.Array) or not jnp.issubdtype(values.dtype, jnp.floating):
        return _gather(values, index, 0)
    index = np.asarray(index, np.int32)
    return _take(values, of=_Index(digest([index]), index))


@dataclasses.dataclass(frozen=True)
class _Index:
    """A static index, compared by its `key`."""

    key: bytes
    index: np.ndarray = dataclasses.field(compare=False)


def _gather(values, index, lead):
    return values.at[(*(slice(None),) * lead, index)].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _sums_of_entries(cotangent, shape, *, of, lead):
    """The cotangent of the values, of the given shape, from the cotangent of the entries at an index."""
    end = lead + of.index.ndim
    entries = cotangent.reshape(*cotangent.shape[:lead], of.index.size, *cotangent.shape[end:])
    sums = placed_sums(of.index.ravel(), shape[lead])
    return jnp.moveaxis(sums(jnp.moveaxis(entries, lead, 0)), 0, lead)


_take = define_linear(
    "static_take",
    lambda values, *, of, lead: _gather(values, of.index, lead),
    lambda shape, *, of, lead: (*shape[:lead], *of.index.shape, *shape[lead + 1 :]),
    _sums_of_entries,
    parameters=("of",),
)
