"""Optimisation without constraints, by any optimiser of optax."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ..ranges import FreeParameters
from .evaluation import Program
from .trials import Trial, Trials


def first_order(
    optimiser: optax.GradientTransformation, trials: Trials, start: Trial, tol: float, limit: int
) -> tuple[bool, str]:
    """Steps of an optax optimiser in a change of variables that keeps bounds. A failed trial halves its step. A step
    below `tol` ends the method.
    """
    free = trials.program.space.unbounded(jnp.asarray(start.z, jnp.result_type(float)))
    y = jnp.zeros(free.size)
    memory, trial = optimiser.init(y), start
    for _ in range(limit):
        value, gradient = jnp.asarray(trial.rows[0]), jnp.asarray(trial.jacobian[0])
        step, memory = _step(optimiser, trials.program, free, y, memory, value, gradient)
        length = float(jnp.max(jnp.abs(step)))
        while True:
            trial = trials(np.asarray(_located(trials.program, free, y + step)))
            if trial.good or length <= tol:
                break
            step, length = 0.5 * step, 0.5 * length
        if length <= tol:
            return trial.good, "converged" if trial.good else "every step fails, however short"
        y = y + step
        trials.record(trial.z)
    return False, "the iterations are used up"


@eqx.filter_jit
def _located(program: Program, free: FreeParameters, y: Any) -> Any:
    """The vector of the program's space."""
    return program.space.locate(free(y))


@eqx.filter_jit
def _step(
    optimiser: optax.GradientTransformation, program: Program, free: FreeParameters, y, memory, value, gradient
) -> tuple[Any, Any]:
    """A step from a point, with the objective's value there and its gradient in the program's space."""
    place = lambda y: program.space.locate(free(y))
    (gradient,) = jax.vjp(place, y)[1](gradient)
    with jax.numpy_dtype_promotion("standard"):
        update = optax.with_extra_args_support(optimiser).update
        objective = lambda y: program.rows(place(y))[0][0]
        step, memory = update(gradient, memory, y, value=value, grad=gradient, value_fn=objective)
    return jnp.asarray(step, y.dtype), memory
