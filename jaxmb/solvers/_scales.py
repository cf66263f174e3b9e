"""Sizes of coordinates and velocities that follow the motion, for tolerances that do not depend on units."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# What a group of further states counts as at least, in its natural units, as a power of eps: 1e-4 in double precision.
# Much more hides a small motion that starts at zero; much less asks for the digits of rounding errors.
_LEAST = 0.25


class RunningScales(eqx.Module):
    """Sizes of the components of a state: the largest coordinate, the largest velocity, and the largest of each further
    group of states that a motion has shown so far, in natural units of each component.

    With them an absolute tolerance is a pure number, and a component that never moves may be zero.

    **Fields:** `units` of the components of the raveled state, those of velocities for one unit of time; `ends`, the
    index after the last component of each group: of coordinates, of velocities, and of others; `rate`, that of
    velocities where nothing is known of them [1/s].
    """

    units: Float[Array, " n"]
    ends: tuple[int, ...] = eqx.field(static=True)
    rate: Any

    @property
    def blocks(self) -> tuple[tuple[int, int], ...]:
        """The groups as `(start, end)`."""
        return tuple(zip((0, *self.ends[:-1]), self.ends, strict=True))

    def start(self, y: Float[Array, " n"], f: Float[Array, " n"]) -> Float[Array, " groups"]:
        """The sizes at the start of a motion, from the state and its derivative."""
        coordinates, velocities, *others = self._largest(y)
        coordinates = jnp.where(coordinates > 0, coordinates, 1.0)
        # From rest, an acceleration causes a motion of the size of the coordinates with this velocity.
        ahead = jnp.sqrt(coordinates * self._largest(f)[1])
        velocities = jnp.maximum(velocities, jnp.where(jnp.isfinite(ahead), ahead, 0.0))
        velocities = jnp.where(velocities > 0, velocities, jnp.asarray(self.rate, y.dtype))
        least = jnp.finfo(y.dtype).eps ** _LEAST
        others = [jnp.maximum(size, least) for size in others]
        return lax.stop_gradient(jnp.stack([coordinates, velocities, *others]))

    def grown(self, sizes: Float[Array, " groups"], y: Float[Array, " n"]) -> Float[Array, " groups"]:
        """The sizes after a step to y."""
        return lax.stop_gradient(jnp.maximum(sizes, jnp.stack(self._largest(y))))

    def of_components(self, sizes: Float[Array, " groups"]) -> Float[Array, " n"]:
        """The size of each component."""
        return self.units * jnp.concatenate([jnp.full(b - a, sizes[k]) for k, (a, b) in enumerate(self.blocks)])

    def _largest(self, y):
        relative = jnp.abs(y) / self.units
        return tuple(jnp.max(relative[a:b], initial=0.0) for a, b in self.blocks)
