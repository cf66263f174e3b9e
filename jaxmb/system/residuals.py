"""Residuals of the constraints as rows of A, their sizes in units of the coordinates, and small displacements."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar, State, Velocities
from ..linalg.jacobian import AbstractJacobian
from ..linalg.sums import placed_sums
from .equation import AbstractEquation


def position_rows(system: AbstractEquation, t: Scalar, q: Coordinates) -> Float[Array, "m"]:
    """Φ, and zeros for the rows that bind velocities or accelerations only."""
    return jnp.pad(system.position_residual(t, q), (0, system.acceleration_rows - system.position_rows))


def velocity_rows(system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "m"]:
    """ψ, and zeros for the rows that bind accelerations only."""
    return jnp.pad(system.velocity_residual(t, q, u), (0, system.acceleration_rows - system.velocity_rows))


def binding_velocities(system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> AbstractJacobian:
    """A whose independent rows are those that bind positions or velocities."""
    jacobian = system.structured_jacobian(t, q, u)
    if system.acceleration_rows == system.velocity_rows:
        return jacobian
    return jacobian.of_rows(tuple(range(system.velocity_rows)))


def displaced(system: AbstractEquation, t: Scalar, q: Coordinates, step: Float[Array, "nu"]) -> Float[Array, "nq"]:
    """The coordinates after a small displacement along the velocities."""
    if system.rates_are_velocities:
        return q + step
    _, change = jax.jvp(lambda u: system.rates(t, q, u), (jnp.zeros_like(step),), (step,))
    return system.normalize(q + change)


def friction_force(
    system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities, own: Float[Array, "k"]
) -> Float[Array, "nu"]:
    """C, from the multipliers of the `friction_rows` that it depends on."""
    return system.nonideal_force(t, q, u, placed_sums(system.friction_rows, system.acceleration_rows)(own))


def drops_rows(system: AbstractEquation) -> bool:
    """Whether rows of ψ are left out because others imply them."""
    return system.velocity_rank < system.velocity_rows


def row_sizes(system: AbstractEquation, t: Scalar, y: State) -> Float[Array, "velocity_rows"]:
    """The norm of the gradient of each row of ψ, in the scales of the velocities."""
    sizes = system.structured_jacobian(t, y.q, y.u).row_norms(system.velocity_scale())[: system.velocity_rows]
    return jnp.maximum(sizes, jnp.finfo(sizes.dtype).eps ** 0.75 * jnp.max(sizes) + jnp.finfo(sizes.dtype).tiny)


def violations(
    system: AbstractEquation, t: Scalar, y: State, sizes: Float[Array, "velocity_rows"]
) -> tuple[Float[Array, "position_rows"], Float[Array, "velocity_rows"]]:
    """For each row of Φ the change of the coordinates, in their scales, that restores it; for each row of ψ the change
    of the velocities that does, relative to the largest velocity.
    """
    speed = jnp.max(jnp.abs(y.u) / system.velocity_scale())
    rate = jnp.abs(system.velocity_residual(t, y.q, y.u)) / sizes
    positions = jnp.abs(system.position_residual(t, y.q)) / sizes[: system.position_rows]
    # At rest there are only rounding errors to compare.
    return positions, jnp.where(rate > jnp.finfo(rate.dtype).eps ** 0.75, rate / speed, 0.0)


def violation_of_dropped_rows(
    system: AbstractEquation, t: Scalar, y: State, sizes: Float[Array, "velocity_rows"]
) -> Float[Array, ""]:
    """The largest violation of a state that satisfies the independent rows: that of rows that are left out."""
    positions, velocities = violations(system, t, y, sizes)
    # Where all rows left out are of positions, their velocities follow.
    follow = system.velocity_rank - system.position_rank == system.velocity_rows - system.position_rows
    largest = jnp.max(positions, initial=0.0)
    return largest if follow else jnp.maximum(largest, jnp.max(velocities))
