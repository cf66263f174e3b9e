"""The sizes that count as zero when contacts close or open, and friction sticks or slips."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Velocities
from ..system.equation import AbstractEquation

# Rates below this fraction of their summands, and squares of gradients, are zero.
REST = 1e-9
# Multiples of the gap that counts as zero: see the members of `ContactTolerance`.
_NEAR, _BOUNCE, _FAR = 1e2, 1e3, 1e6
# Slip in two directions, whose direction is undefined at rest, ends at this multiple of that gap per second: slower
# slips are turned more by errors of integration.
_SLOW = 1e4


class ContactTolerance(eqx.Module):
    """The sizes of gaps and slips that count as zero at an event, all multiples of `touch`.

    **Fields:** `touch`: gaps down to `-touch` count as zero, in units of the system's size, or in metres and radians
    (`in_metres`).
    """

    touch: Float[Array, ""]

    def in_metres(self, system: AbstractEquation) -> "ContactTolerance":
        """The tolerance in metres and radians, from units of the system's size."""
        return ContactTolerance(self.touch * system.length)

    @property
    def near(self) -> Float[Array, ""]:
        """The gap at which a step ends that was meant to end at an event."""
        return _NEAR * self.touch

    @property
    def slowest(self) -> Float[Array, ""]:
        """The rate per second up to which gaps and slips do not change."""
        return self.touch

    @property
    def bounce(self) -> Float[Array, ""]:
        """The height of the bounces that are omitted."""
        return _BOUNCE * self.touch

    @property
    def far(self) -> Float[Array, ""]:
        """The largest motion of the state until the event at which a step ends."""
        return _FAR * self.touch

    def slow(self, system: AbstractEquation, u: Velocities) -> Float[Array, ""]:
        """The velocity [m/s] up to which slip in two directions has ended, for a tolerance in metres."""
        return _SLOW * self.touch * (1 + jnp.max(jnp.abs(u) / system.velocity_scale()))
