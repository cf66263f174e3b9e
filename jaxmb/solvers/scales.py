"""Sizes of coordinates and velocities that follow the motion, for tolerances that do not depend on units."""

import functools
import itertools
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

# The least size of a block, in its natural units, as a power of eps: 1e-4 in double precision. A much larger one hides
# a small motion that starts at zero; a much smaller one resolves rounding errors.
_LEAST = 0.25
# The largest motion of a step at rest, in natural units, as a power of eps: 2e-14 in double precision. Rounding errors
# of a chain of many bodies add up to nearly that; a much larger bound hides slow motions.
_REST = 0.875
# The least size of rates at the start of a motion, in units of their expected size, as a power of eps: 1e-6 in double
# precision. Steps of an explicit method beyond its stability enlarge rounding errors to nearly the tolerance.
_LEAST_RATE = 0.375


class Block(eqx.Module):
    """A block of components of a state, measured by its largest component.

    **Fields:** its `name`; `size`: the number of its components; `initial`: the expected size at the start of a motion,
    in natural units, for a block that is zero but for rounding errors; None for a block with a least size of 1e-4;
    `rate_of`: the name of a preceding block if this one is its rate of change, else None.
    """

    name: str = eqx.field(static=True)
    size: int = eqx.field(static=True)
    initial: Any = None
    rate_of: str | None = eqx.field(static=True, default=None)


def ends_of(sizes: Iterable[int]) -> tuple[tuple[int, int], ...]:
    """The first index of each block in the raveled state, and the index after its last."""
    return tuple(itertools.pairwise(itertools.accumulate(sizes, initial=0)))


class RunningScales(eqx.Module):
    """Sizes of the components of a state: the largest of each block in the motion so far, in natural units; and the
    largest actual rate, which is zero at a start from rest.

    With them an absolute tolerance is a pure number, and a component that never moves may be zero.

    **Fields:** `units`: the natural sizes of the components of the raveled state, of rates for one unit of time;
    `blocks` of it, in order; `counted`: the indices of the components that count, None for all.
    """

    units: Float[Array, " n"]
    blocks: tuple[Block, ...]
    counted: tuple[int, ...] | None = eqx.field(static=True, default=None)

    def none(self, dtype: Any) -> Float[Array, " sizes"]:
        """Zeros, for unknown sizes."""
        return jnp.zeros(len(self.blocks) + 1, dtype)

    def start(self, y: Float[Array, " n"], f: Float[Array, " n"]) -> Float[Array, " sizes"]:
        """The sizes at the start of a motion, from the state and its derivative."""
        sizes: dict[str, Array] = {}
        for block, size, rate in zip(self.blocks, self._largest(y), self._largest(f), strict=True):
            if block.rate_of is None:
                sizes[block.name] = _expected(block, size)
            else:
                # From rest, the acceleration reaches this velocity when the other block has moved by its size.
                ahead = jnp.sqrt(sizes[block.rate_of] * rate)
                size = jnp.maximum(size, jnp.where(jnp.isfinite(ahead), ahead, 0.0))
                # Less where the motion itself is small.
                least = jnp.finfo(y.dtype).eps ** _LEAST_RATE * jnp.minimum(sizes[block.rate_of], 1.0)
                sizes[block.name] = jnp.maximum(size, least * jnp.asarray(block.initial, y.dtype))
        return lax.stop_gradient(jnp.stack([*sizes.values(), self._largest_rate(self._largest(y))]))

    def expected(self, y: Float[Array, " n"]) -> Float[Array, " n"]:
        """The size of each component of a motion that starts at y, with the expected size for zero components."""
        sizes = [_expected(block, size) for block, size in zip(self.blocks, self._largest(y), strict=True)]
        return lax.stop_gradient(self.of_components(jnp.stack(sizes)))

    def grown(self, sizes: Float[Array, " sizes"], y: Float[Array, " n"]) -> Float[Array, " sizes"]:
        """The sizes after a step to y."""
        largest = self._largest(y)
        return lax.stop_gradient(jnp.maximum(sizes, jnp.stack([*largest, self._largest_rate(largest)])))

    def of_components(self, sizes: Float[Array, " sizes"]) -> Float[Array, " n"]:
        """The size of each component."""
        return self.units * jnp.concatenate([jnp.full(block.size, sizes[k]) for k, block in enumerate(self.blocks)])

    def at_rest(self, sizes: Float[Array, " sizes"], y: Float[Array, " n"], h: Any) -> Float[Array, " n"]:
        """Errors of rates that move nothing in a step of length h to y, where nothing has moved faster so far; zero for
        other components.

        Where forces balance, accelerations are the rounding errors of these forces, and dominate the error estimate of
        any step, however short. Such rates do not matter as long as nothing moves. The errors fall with the square of
        the motion in the step, to far below any tolerance.
        """
        least = float(jnp.finfo(y.dtype).eps) ** _REST
        moved = jnp.abs(h) * jnp.maximum(sizes[-1], self._largest_rate(self._largest(y)))
        error = least / jnp.abs(h) * jnp.minimum((least / moved) ** 2, 1.0)
        none = jnp.zeros_like(error)
        errors = jnp.stack([none if block.rate_of is None else error for block in self.blocks])
        return lax.stop_gradient(self.of_components(errors))

    def rate(self, sizes: Float[Array, " sizes"]) -> Float[Array, ""]:
        """The size of the first block of rates over the size of the block whose rates they are [1/s]."""
        names = [block.name for block in self.blocks]
        k, of = next((k, names.index(block.rate_of)) for k, block in enumerate(self.blocks) if block.rate_of)
        return sizes[k] / sizes[of]

    def _largest_rate(self, largest):
        rates = [size for block, size in zip(self.blocks, largest, strict=True) if block.rate_of is not None]
        return functools.reduce(jnp.maximum, rates, jnp.zeros_like(largest[0]))

    def _largest(self, y):
        relative = jnp.abs(y) / self.units
        if self.counted is not None:
            relative = jnp.where(np.isin(np.arange(y.size), self.counted), relative, 0.0)
        return tuple(jnp.max(relative[a:b], initial=0.0) for a, b in ends_of(block.size for block in self.blocks))


def _expected(block, size):
    eps = jnp.finfo(size.dtype).eps
    if block.initial is None:
        return jnp.maximum(size, eps**_LEAST)
    # Rounding errors of components that constraints hold at rest are not a size.
    initial = jnp.asarray(block.initial, size.dtype)
    return jnp.where(size > eps * initial, size, initial)
