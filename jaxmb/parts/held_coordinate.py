"""A coordinate of a joint held at a value, for initial states."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .base import AbstractConstraint


class HeldCoordinate(AbstractConstraint):
    """A joint's own coordinate that is `value + rate (t − start)`.

    **Fields:** `joint`, with every number filled in; `coordinate`, its name in the joint; `value` and `rate`, of its
    shape; `start` [s].
    """

    name: str = eqx.field(static=True)
    joint: Any
    coordinate: str = eqx.field(static=True)
    value: Float[Array, "*n"]
    rate: Float[Array, "*n"]
    start: Float[Array, ""]
    rows: int = eqx.field(static=True)
    rheonomic: ClassVar[bool] = True

    def residual(self, space, poses, t):
        found = self.joint.coordinates(space, poses)[self.coordinate]
        target = self.value + self.rate * (t - self.start)
        return difference(found, target, self.coordinate in self.joint.periodic).reshape(-1)


def difference(value: Float[Array, "*n"], target: Float[Array, "*n"], periodic: bool) -> Float[Array, "*n"]:
    """`value − target`, of angles known up to full turns the smallest such difference."""
    out = value - target
    return out - 2 * np.pi * lax.stop_gradient(jnp.round(out / (2 * np.pi))) if periodic else out
