"""Two ways to make residuals small: Levenberg–Marquardt, and any optimiser of optax."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

# Residuals of the unknowns z, given how to differentiate the simulation in them; infinite where it fails.
Residuals = Callable[[Float[Array, "n"], diffrax.AbstractAdjoint | None], Float[Array, "residuals"]]

# Residuals and their Jacobian; infinite where the simulation fails.
Linearised = Callable[[Float[Array, "n"]], tuple[Float[Array, "residuals"], Float[Array, "residuals n"]]]

# Damping of the first step of Levenberg–Marquardt, and its smallest value.
_FIRST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-12


class Minimum(NamedTuple):
    """The end of an iteration: `z`, the number of trials, and whether it converged."""

    z: Float[Array, "n"]
    iterations: int
    success: bool


def levenberg_marquardt(linearised: Linearised, z: Float[Array, "n"], tol: float, limit: int) -> Minimum:
    """Minimise `½ |r(z)|²`; trials that fail are rejected.

    A step s minimises `|r + J s|² + μ |D s|²`, with D the norms of the columns of J (Marquardt). The damping μ follows
    the gain, the ratio of the decrease of the objective to that of the linear model.

    Source: H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, Technical University of Denmark.

    **Arguments:** `linearised`: residuals and their Jacobian; `tol`: change of the unknowns and of the objective at
    which to stop, absolute and relative; `limit`: largest number of evaluations of `linearised`.
    """
    residuals, jacobian = map(np.asarray, linearised(z))
    objective = 0.5 * residuals @ residuals
    damping, growth = _FIRST_DAMPING, 2.0
    for iteration in range(1, limit):
        norms = np.linalg.norm(jacobian, axis=0)
        weights = np.sqrt(damping) * np.where(norms > 0, norms, 1.0)
        rows, target = np.vstack([jacobian, np.diag(weights)]), np.append(-residuals, np.zeros_like(weights))
        step = np.linalg.lstsq(rows, target, rcond=None)[0]
        trial = z + jnp.asarray(step, z.dtype)
        trial_residuals, trial_jacobian = map(np.asarray, linearised(trial))
        trial_objective = 0.5 * trial_residuals @ trial_residuals
        decrease = objective - trial_objective
        predicted = 0.5 * step @ (weights**2 * step - jacobian.T @ residuals)
        gain = decrease / predicted if predicted > 0 else 0.0
        converged = np.all(np.abs(step) <= tol * (1 + np.abs(z))) and abs(decrease) <= tol * (1 + objective)
        if gain > 0:
            damping, growth = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), _LEAST_DAMPING), 2.0
            z, residuals, jacobian, objective = trial, trial_residuals, trial_jacobian, trial_objective
        else:
            damping, growth = damping * growth, 2 * growth
        if converged:
            return Minimum(z, iteration + 1, True)
    return Minimum(z, limit, False)


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
