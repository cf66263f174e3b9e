"""Small displacements of a configuration along velocities."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from .equation import AbstractSystem


def displaced(system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], step: Float[Array, "nu"]) -> Float[Array, "nq"]:
    """The coordinates after a small displacement along the velocities."""
    if system.rates_are_velocities:
        return q + step
    _, change = jax.jvp(lambda u: system.rates(t, q, u), (jnp.zeros_like(step),), (step,))
    return system.normalize(q + change)
