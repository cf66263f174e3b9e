"""Sizes of coordinates and velocities that follow the motion, for tolerances that do not depend on units."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float


class RunningScales(eqx.Module):
    """Sizes of the components of a state of coordinates and velocities: the largest coordinate and the largest velocity
    that a motion has shown so far, in natural units of each component.

    With them an absolute tolerance is a pure number, and a component that never moves may be zero.

    **Fields:** `units` of the components of the raveled state, those of velocities for one unit of time; `split`, the
    number of coordinates; `rate`, that of velocities where nothing is known of them [1/s].
    """

    units: Float[Array, " n"]
    split: int = eqx.field(static=True)
    rate: Any

    def start(self, y: Float[Array, " n"], f: Float[Array, " n"]) -> Float[Array, "2"]:
        """The sizes at the start of a motion, from the state and its derivative."""
        coordinates, velocities = self._largest(y)
        coordinates = jnp.where(coordinates > 0, coordinates, 1.0)
        # From rest, an acceleration causes a motion of the size of the coordinates with this velocity.
        ahead = jnp.sqrt(coordinates * self._largest(f)[1])
        velocities = jnp.maximum(velocities, jnp.where(jnp.isfinite(ahead), ahead, 0.0))
        velocities = jnp.where(velocities > 0, velocities, jnp.asarray(self.rate, y.dtype))
        return lax.stop_gradient(jnp.stack([coordinates, velocities]))

    def grown(self, sizes: Float[Array, "2"], y: Float[Array, " n"]) -> Float[Array, "2"]:
        """The sizes after a step to y."""
        return lax.stop_gradient(jnp.maximum(sizes, jnp.stack(self._largest(y))))

    def of_components(self, sizes: Float[Array, "2"]) -> Float[Array, " n"]:
        """The size of each component."""
        n = self.units.size
        return self.units * jnp.concatenate([jnp.full(self.split, sizes[0]), jnp.full(n - self.split, sizes[1])])

    def _largest(self, y):
        relative = jnp.abs(y) / self.units
        return jnp.max(relative[: self.split], initial=0.0), jnp.max(relative[self.split :], initial=0.0)
