"""Functions with a kink, whose derivative at the kink is that of one side.

JAX takes the mean of both sides for `jnp.clip`, `jnp.maximum` and `jnp.minimum`: half of the derivative within a range
at its end. Here the side counts on which the law acts: within the range, beyond the threshold.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar


def clipped(x: Float[Array, "*n"], low: Scalar, high: Scalar) -> Float[Array, "*n"]:
    """The number between `low` and `high` that is nearest to x. At an end the derivative is that within."""
    return jnp.where(x < low, low, jnp.where(x > high, high, x))


def excess(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """x where it is positive, else zero. At zero the derivative is one, that of positive numbers."""
    return jnp.where(x < 0, 0.0, x)
