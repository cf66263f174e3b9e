"""The gaps of compliant contacts and stops along a motion."""

import jax.numpy as jnp
from jax import lax

from ..solvers.manifold_term import AbstractGaps
from ..system.equation import AbstractEquation

# Depths below this many units in the last place of the system's size are rounding errors.
_ROUNDING = 64


class CompliantGaps(AbstractGaps):
    """The gaps of the forces of a system."""

    system: AbstractEquation

    @property
    def touch(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return _ROUNDING * jnp.finfo(self.system.length.dtype).eps * lax.stop_gradient(self.system.length)

    def seen(self, t, y):
        system, y = lax.stop_gradient((self.system, y))
        t = jnp.asarray(t, y.q.dtype)
        return system.gaps_seen(t, system.normalize(t, y.q), y.u)


def compliant_gaps(system: AbstractEquation) -> CompliantGaps | None:
    """The gaps of a system's forces; None if no force has a gap."""
    return CompliantGaps(system) if system.has_gaps else None
