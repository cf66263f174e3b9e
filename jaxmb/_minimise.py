"""Two ways to make residuals small: Levenberg–Marquardt from optimistix, and any optimiser of optax."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Float

# Residuals of the unknowns z, given how to differentiate the simulation in them; infinite where it fails.
Residuals = Callable[[Float[Array, "n"], diffrax.AbstractAdjoint | None], Float[Array, "residuals"]]

# In place of infinite residuals: no sum of squares comes near it, and it has a square.
_FAILED = 1e100


class Minimum(NamedTuple):
    """The end of an iteration: `z`, the number of trials, and whether it converged."""

    z: Float[Array, "n"]
    iterations: int
    success: bool


def levenberg_marquardt(residuals: Residuals, z: Float[Array, "n"], tol: float, limit: int) -> Minimum:
    """Minimise `|r(z)|²`, with forward-mode derivatives; trials that fail are rejected.

    **Arguments:** `tol`: change of unknowns and of residuals at which to stop, absolute and relative; `limit`: largest
    number of trials.
    """
    z, steps, result = _levenberg_marquardt(residuals, z, tol, limit)
    return Minimum(z, int(steps), bool(result == optx.RESULTS.successful))


@eqx.filter_jit
def _levenberg_marquardt(residuals: Residuals, z: Float[Array, "n"], tol: float, limit: int):
    def fn(z, _):
        r = residuals(z, diffrax.ForwardMode())
        return jnp.where(jnp.isfinite(r), r, _FAILED)

    solver = optx.LevenbergMarquardt(rtol=tol, atol=tol)
    sol = optx.least_squares(fn, solver, z, options={"jac": "fwd"}, max_steps=limit, throw=False)
    return sol.value, sol.stats["num_steps"], sol.result


def descend(
    optimiser: optax.GradientTransformation, residuals: Residuals, z: Float[Array, "n"], tol: float, limit: int
) -> Minimum:
    """Minimise half the mean square, with reverse-mode derivatives; where a trial fails, half its step is taken.

    **Arguments:** `tol`: size of a step at which to stop; `limit`: largest number of trials.
    """
    memory = optimiser.init(z)
    best, best_value, good = z, np.inf, z
    for iteration in range(limit):
        value, finite, step, ahead = _step(residuals, optimiser, z, memory)
        if not bool(finite):
            z = 0.5 * (good + z)
            continue
        if float(value) < best_value:
            best, best_value = z, float(value)
        good, memory, z = z, ahead, z + step
        if float(jnp.max(jnp.abs(step))) <= tol:
            return Minimum(best, iteration + 1, True)
    return Minimum(best, limit, False)


@eqx.filter_jit
def _step(residuals: Residuals, optimiser: optax.GradientTransformation, z: Float[Array, "n"], memory: Any):
    def loss(z):
        return 0.5 * jnp.mean(residuals(z, None) ** 2)

    value, gradient = jax.value_and_grad(loss)(z)
    finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))
    with jax.numpy_dtype_promotion("standard"):
        update = optax.with_extra_args_support(optimiser).update
        step, memory = update(gradient, memory, z, value=value, grad=gradient, value_fn=loss)
    return value, finite, jnp.asarray(step, z.dtype), memory
