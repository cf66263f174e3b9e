"""Contact of the tracked vehicle's wheels with the ground."""

import jax.numpy as jnp

from ..parts.contact import AbstractContact


class WheelContact(AbstractContact):
    """Contact with ground of small slopes, as in the vehicle's published equations: depth and damping along the
    vertical, friction along the horizontal by the load of the normal law at the depth, and damping in proportion to the
    depth up to `damping_depth`, which may pull while a wheel separates.

    **Arguments:** as in `planar.Contact`.
    """

    def distance(self, centre):
        return centre[-1] - self.terrain.height(centre[:-1])

    def outward(self, centre):
        return jnp.zeros_like(centre).at[-1].set(1.0)

    def onset(self, depth):
        return jnp.clip(depth, 0.0, 1.0)

    def pressing(self, spring, damping, load):
        del spring
        return damping, load
