"""Residuals of positions and velocities as rows of A, and A with the rows that they bind."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.jacobian import AbstractJacobian
from .equation import AbstractSystem


def position_rows(system: AbstractSystem, t: Scalar, q: Float[Array, "nq"]) -> Float[Array, "m"]:
    """Φ, and zeros for the rows that bind velocities or accelerations only."""
    return jnp.pad(system.position_residual(t, q), (0, system.acceleration_rows - system.position_rows))


def velocity_rows(system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> Float[Array, "m"]:
    """ψ, and zeros for the rows that bind accelerations only."""
    return jnp.pad(system.velocity_residual(t, q, u), (0, system.acceleration_rows - system.velocity_rows))


def binding_velocities(
    system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]
) -> AbstractJacobian:
    """A whose independent rows are those that bind positions or velocities."""
    jacobian = system.structured_jacobian(t, q, u)
    return jacobian if system.acceleration_rows == system.velocity_rows else jacobian.of_first(system.velocity_rows)
