"""Sums of entries by static places, by gathers alone: scatters are slow on some devices."""

import dataclasses
import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .arrays import unchecked_take
from .digest import digest

# Entries of one place that one pass adds up; more take another pass, so the work is proportional to the entries.
_WIDTH = 4


@dataclasses.dataclass(frozen=True)
class PlacedSums:
    """Which entries add up to the value of each place; static, compared by its `key`.

    **Fields:** `passes`: each of shape (sums, width), indices into the entries of the pass before followed by a zero.
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
    """From the place of each entry; entries with a place out of bounds are left out."""
    passes = []
    kept = np.flatnonzero((place >= 0) & (place < places))
    order, entries = kept[np.argsort(place[kept], kind="stable")], place.size
    while True:
        own = place[order]
        counts = np.bincount(own, minlength=places)
        number = np.arange(own.size) - np.repeat(np.cumsum(counts) - counts, counts)
        last = np.max(counts, initial=0) <= _WIDTH
        # The sum that each entry is part of: of its place, or of its place and of its group of entries there.
        groups = np.ones(places, int) if last else -(-counts // _WIDTH)
        first = np.cumsum(groups) - groups
        index = np.full((int(groups.sum()), min(_WIDTH, max(1, np.max(counts, initial=0)))), entries, np.int32)
        index[first[own] + number // _WIDTH, number % _WIDTH] = order
        passes.append(index)
        if last:
            break
        place = np.repeat(np.arange(places), groups)
        order, entries = np.arange(place.size), place.size
    return PlacedSums(digest(passes), tuple(passes))
