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

# Residuals and their Jacobian; infinite where the simulation fails.
Linearised = Callable[[Float[Array, "n"]], tuple[Float[Array, "residuals"], Float[Array, "residuals n"]]]

# In place of infinite residuals: no sum of squares comes near it, and it has a square.
_FAILED = 1e100


class Minimum(NamedTuple):
    """The end of an iteration: `z`, the number of trials, and whether it converged."""

    z: Float[Array, "n"]
    iterations: int
    success: bool


def levenberg_marquardt(linearised: Linearised, z: Float[Array, "n"], tol: float, limit: int) -> Minimum:
    """Minimise `|r(z)|²`; trials that fail are rejected.

    **Arguments:** `linearised`: residuals and their Jacobian; `tol`: change of unknowns and of residuals at which to
    stop, absolute and relative; `limit`: largest number of trials.
    """
    solver, state = optx.LevenbergMarquardt(rtol=tol, atol=tol), None
    for iteration in range(limit):
        trial = z if state is None else state.y_eval
        z, state = _levenberg_marquardt(solver, (trial, *linearised(trial)), z, state)
        stuck = bool(state.result != optx.RESULTS.successful)
        if stuck or bool(state.terminate):
            return Minimum(z, iteration + 1, not stuck)
    return Minimum(z, limit, False)


@eqx.filter_jit
def _levenberg_marquardt(solver: Any, known: tuple[Array, Array, Array], z: Float[Array, "n"], state: Any):
    """One step of the solver, from its state (None: the first); what it asks for at the trial point is known there."""
    at, residuals, jacobian = known
    finite = jnp.isfinite(residuals)
    known = at, jnp.where(finite, residuals, _FAILED), jnp.where(finite[:, None], jacobian, 0.0)

    # The tangent at the trial point, the only place where it is evaluated: so the program of the simulation and its
    # derivatives is compiled once, outside, for all who need it.
    def fn(z, known):
        at, residuals, jacobian = known
        return residuals + jacobian @ (z - at), None

    rest: Any = known, {"jac": "fwd"}
    if state is None:
        state = solver.init(fn, z, *rest, *eqx.filter_eval_shape(fn, z, known), frozenset())
    z, state, _ = solver.step(fn, z, *rest, state, frozenset())
    return z, state


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
