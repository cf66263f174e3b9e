"""Consistent states of long chains of joints, in a time proportional to their number.

The configuration nearest to a guess satisfies `q = q_guess − S² Aᵀ(q) μ`, `Φ(q) = 0` (S: scales, zero where coordinates
are held). With the constraints linearised at the last iterate μ follows from one block-tridiagonal system; repeated,
that converges to the minimiser, at once where the guess is on the constraints. Its derivatives are those of the fixed
point, by as many iterations again: they are as exact as those that found it.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Scalar, State
from ..system import AbstractSystem, DiagonalInertia
from ..system.corrector import Corrector, corrector

_ITERATIONS = 30


def positions(
    system: AbstractSystem, t: Scalar, guess: Float[Array, "nq"], held: Bool[np.ndarray, "nq"], tol: float
) -> tuple[Float[Array, "nq"], Bool[Array, ""], Float[Array, ""]]:
    """The configuration nearest to a guess; whether it was found; and the smallest pivot there."""

    def improved(q):
        here = _corrector(system, t, q, held)
        unmet = system.position_residual(t, q) + here.jacobian.product(guess - q)
        return guess - here.along(here.solve(unmet))

    def solve(_, start):
        def correct(carry):
            q, _, k = carry
            new = improved(q)
            return new, jnp.max(jnp.abs(new - q)), k + 1

        def proceed(carry):
            _, change, k = carry
            return (change > tol * system.length) & (k < _ITERATIONS)

        return lax.while_loop(proceed, correct, correct((start, jnp.zeros((), start.dtype), 0)))[0]

    def tangent_solve(linear, b):
        # x = b + (1 − L) x: the linear map is near the identity where the guess is near the constraints.
        return lax.fori_loop(0, _ITERATIONS, lambda _, x: b + (x - linear(x)), b)

    q = lax.custom_root(lambda q: q - improved(q), lax.stop_gradient(guess), solve, tangent_solve)
    pivot = _corrector(system, t, q, held).factor.smallest_pivot()
    # Another iteration changes nothing.
    change = jnp.max(jnp.abs(improved(q) - q))
    return q, jnp.all(jnp.isfinite(q)) & (change <= tol * system.length), pivot


def velocities(
    system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], guess: Float[Array, "nu"], held: Bool[np.ndarray, "nu"]
) -> tuple[Float[Array, "nu"], Float[Array, ""]]:
    """The velocities nearest to a guess, and the smallest pivot."""
    here = _corrector(system, t, q, held)
    u = guess + here.remove(system.velocity_residual(t, q, guess))
    return u, here.factor.smallest_pivot()


def _corrector(system, t, q, held) -> Corrector:
    # What is held has an infinite mass.
    metric = DiagonalInertia(jnp.where(held, jnp.inf, 1 / system.velocity_scale() ** 2))
    return corrector(system, t, State(q, jnp.zeros_like(q)), metric)
