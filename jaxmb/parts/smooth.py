"""Smooth forms of functions with a kink."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from .kinks import clipped


def sign(speed: Float[Array, "*n"], transition_speed: Scalar) -> Float[Array, "*n"]:
    """`tanh(v / transition_speed)`, the sign of a speed v, regularised at rest. It is 0.76 at `transition_speed`, and 1
    to within 1e-8 at ten times that speed.
    """
    return jnp.tanh(speed / transition_speed)


def dry_friction(limit: Float[Array, ""], slip: Float[Array, "d"], transition_speed: Scalar) -> Float[Array, "d"]:
    """A force against a velocity of slip, as large as `limit` times the `sign` of the speed."""
    s = slip / transition_speed
    square = jnp.dot(s, s)
    small = square < 1e-3
    size = jnp.sqrt(jnp.where(small, 1.0, square))
    series = 1 - square * (1 / 3 - square * (2 / 15 - square * (17 / 315)))
    return -limit * jnp.where(small, series, jnp.tanh(size) / size) * s


def ramp(d: Float[Array, "*n"], width: Scalar) -> Float[Array, "*n"]:
    """`½ (d + √(d² + width²))`, a smooth and always positive `max(d, 0)`."""
    root = jnp.sqrt(d * d + width * width)
    # Below zero an equivalent form avoids cancellation, so that its powers stay finite far away.
    return jnp.where(d > 0, 0.5 * (d + root), 0.5 * width * width / (root - jnp.where(d > 0, 0.0, d)))


def without_pull(load: Float[Array, "*n"], damping: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """A force of damping beside a load that presses, reduced so that both together press or vanish, and never pull."""
    return jnp.where(damping > -load, damping, -load)


def step(s: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """A C² step from 0 at s ≤ 0 to 1 at s ≥ 1."""
    return quintic(clipped(s, 0.0, 1.0))


def quintic(s: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The polynomial of degree five from 0 to 1 on [0, 1], whose first two derivatives vanish at both ends."""
    return s**3 * (10 + s * (6 * s - 15))
