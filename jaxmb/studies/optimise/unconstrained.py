"""Optimisation without constraints: BFGS of optimistix, and any optimiser of optax."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx

from ..minimise import next_step
from .evaluation import Program
from .trials import Trial, Trials


def bfgs(trials: Trials, start: Trial, tol: float, limit: int) -> tuple[bool, str]:
    """BFGS with a line search that takes the infinite value of a trial that failed for a step too long."""
    solver = optx.BFGS(rtol=tol, atol=tol)
    program, size = trials.program, _size(start, tol)
    options = {"autodiff_mode": "fwd" if program.forward else "bwd"}
    y = jnp.asarray(start.z, jnp.result_type(float))
    structure = jax.eval_shape(lambda: y[0])
    tags: frozenset[object] = frozenset()
    state = solver.init(_objective, y, (program, size), options, structure, None, tags)
    for _ in range(limit):
        y, state, done, result = _bfgs_step(solver, (program, size), y, state, options["autodiff_mode"])
        z = np.asarray(y, float)
        if not np.array_equal(z, trials.last.z):
            trials.record(z)
        if bool(done):
            ok = bool(result == optx.RESULTS.successful)
            return ok, "converged" if ok else "the line search found no better point"
    return False, "the iterations are used up"


def _size(start: Trial, tol: float) -> Any:
    """The change of the objective where parameters change by their scales, which a constant part of it does not enter;
    where its tolerance is larger, that.
    """
    size = max(float(np.max(np.abs(start.jacobian[0]), initial=0.0)), tol * abs(float(start.rows[0])))
    return jnp.asarray(size if size > 0 else 1.0, jnp.result_type(float))


def _objective(z, problem: tuple[Program, Any]):
    """The objective in units of its size: optimistix disregards changes of it below rounding errors of one."""
    program, size = problem
    value = program.rows(z)[0][0] / size
    return jnp.where(jnp.isfinite(value), value, jnp.inf), None


@eqx.filter_jit
def _bfgs_step(solver: Any, problem: tuple[Program, Any], y: Any, state: Any, mode: str):
    options, tags = {"autodiff_mode": mode}, frozenset()
    y, state, _ = solver.step(_objective, y, problem, options, state, tags)
    done, result = solver.terminate(_objective, y, problem, options, state, tags)
    return y, state, done, result


def first_order(
    optimiser: optax.GradientTransformation, trials: Trials, start: Trial, tol: float, limit: int
) -> tuple[bool, str]:
    """Steps of an optax optimiser; where a trial fails, half its step is taken. It ends with a step below `tol`."""
    z = jnp.asarray(start.z, jnp.result_type(float))
    memory, trial = optimiser.init(z), start
    for _ in range(limit):
        value, gradient = jnp.asarray(trial.rows[0]), jnp.asarray(trial.jacobian[0])
        step, memory = _update(optimiser, trials.program, z, memory, value, gradient)
        length = float(jnp.max(jnp.abs(step)))
        while True:
            trial = trials(np.asarray(z + step))
            if trial.good or length <= tol:
                break
            step, length = 0.5 * step, 0.5 * length
        if length <= tol:
            return trial.good, "converged" if trial.good else "every step fails, however short"
        z = z + step
        trials.record(trial.z)
    return False, "the iterations are used up"


@eqx.filter_jit
def _update(optimiser: optax.GradientTransformation, program: Program, z: Any, memory: Any, value: Any, gradient: Any):
    return next_step(optimiser, memory, z, value, gradient, lambda z: program.rows(z)[0][0])
