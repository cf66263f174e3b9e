"""Sizes of coordinates and velocities that follow the motion, for tolerances that do not depend on units."""

import itertools
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

# What a block counts as at least, in its natural units, as a power of eps: 1e-4 in double precision. Much more hides a
# small motion that starts at zero; much less asks for the digits of rounding errors.
_LEAST = 0.25
# What a step at rest moves by at most, in natural units, as a power of eps: 2e-14 in double precision. Rounding errors
# of a chain of many bodies add up to nearly that; much more hides slow motions.
_REST = 0.875


class Block(eqx.Module):
    """A block of components of a state that are measured by the largest one among them.

    **Fields:** its `name`; `size`: the number of its components; `initial`: what the block counts as at the start of a
    motion, in natural units of its components, where it is zero but for rounding errors, and None for a block that
    counts as 1e-4 at least; `rate_of`: the name of the block before it whose rate of change it is, or None.
    """

    name: str = eqx.field(static=True)
    size: int = eqx.field(static=True)
    initial: Any = None
    rate_of: str | None = eqx.field(static=True, default=None)


def ends_of(sizes: Iterable[int]) -> tuple[tuple[int, int], ...]:
    """The first index of each block in the raveled state, and that after its last."""
    return tuple(itertools.pairwise(itertools.accumulate(sizes, initial=0)))


class RunningScales(eqx.Module):
    """Sizes of the components of a state: the largest in each block that a motion has shown so far, in natural units of
    each component.

    With them an absolute tolerance is a pure number, and a component that never moves may be zero.

    **Fields:** `units`: the natural sizes of the components of the raveled state, those of rates for one unit of time;
    `blocks` of it, in order.
    """

    units: Float[Array, " n"]
    blocks: tuple[Block, ...]

    def none(self, dtype: Any) -> Float[Array, " groups"]:
        """Zeros, for sizes that are not known yet."""
        return jnp.zeros(len(self.blocks), dtype)

    def start(self, y: Float[Array, " n"], f: Float[Array, " n"]) -> Float[Array, " groups"]:
        """The sizes at the start of a motion, from the state and its derivative."""
        sizes: dict[str, Array] = {}
        eps = jnp.finfo(y.dtype).eps
        for block, size, rate in zip(self.blocks, self._largest(y), self._largest(f), strict=True):
            if block.rate_of is not None:
                # From rest, a rate causes a motion of the size of the other block with this one.
                ahead = jnp.sqrt(sizes[block.rate_of] * rate)
                size = jnp.maximum(size, jnp.where(jnp.isfinite(ahead), ahead, 0.0))
            if block.initial is None:
                sizes[block.name] = jnp.maximum(size, eps**_LEAST)
            else:
                # Rounding errors of what constraints hold at rest are no size.
                initial = jnp.asarray(block.initial, y.dtype)
                sizes[block.name] = jnp.where(size > eps * initial, size, initial)
        return lax.stop_gradient(jnp.stack(list(sizes.values())))

    def grown(self, sizes: Float[Array, " groups"], y: Float[Array, " n"]) -> Float[Array, " groups"]:
        """The sizes after a step to y."""
        return lax.stop_gradient(jnp.maximum(sizes, jnp.stack(self._largest(y))))

    def of_components(self, sizes: Float[Array, " groups"]) -> Float[Array, " n"]:
        """The size of each component."""
        return self.units * jnp.concatenate([jnp.full(block.size, sizes[k]) for k, block in enumerate(self.blocks)])

    def at_rest(self, y: Float[Array, " n"], h: Any) -> Float[Array, " n"]:
        """The errors of rates that move nothing in a step of length h to y; zero for all else.

        Where forces balance, accelerations are the rounding errors of these forces, and no step is so short that its
        error estimate is not made of them. What rates are there does not matter as long as nothing moves. The errors
        fall with the square of what the step does move, to far below those of any tolerance.
        """
        least = float(jnp.finfo(y.dtype).eps) ** _REST
        moved = jnp.abs(h) * jnp.stack(self._largest(y))
        errors = least / jnp.abs(h) * jnp.minimum((least / moved) ** 2, 1.0)
        is_rate = np.array([block.rate_of is not None for block in self.blocks])
        return lax.stop_gradient(self.of_components(jnp.where(is_rate, errors, 0.0)))

    def rate(self, sizes: Float[Array, " groups"]) -> Float[Array, ""]:
        """The size of the first block of rates over that of the block whose rates they are [1/s]."""
        names = [block.name for block in self.blocks]
        k, of = next((k, names.index(block.rate_of)) for k, block in enumerate(self.blocks) if block.rate_of)
        return sizes[k] / sizes[of]

    def _largest(self, y):
        relative = jnp.abs(y) / self.units
        return tuple(jnp.max(relative[a:b], initial=0.0) for a, b in ends_of(block.size for block in self.blocks))
