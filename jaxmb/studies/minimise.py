"""Two ways to make residuals small: Levenberg–Marquardt, and any optimiser of optax."""

from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

# The objective as a function of the unknowns z; infinite where it fails.
Objective = Callable[[Float[Array, "n"]], Float[Array, ""]]

# Damping of the first step of Levenberg–Marquardt, and its smallest value.
_FIRST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-12


class Linearised(NamedTuple):
    """A model of an objective at one point: its gradient is `Jᵀ r`, and `Jᵀ J` approximates its second derivatives.

    **Fields:** `residuals` r and their `jacobian` J, infinite where the simulation fails; `objective`, default
    `½ |r|²`.
    """

    residuals: Any
    jacobian: Any
    objective: Any = None

    @property
    def value(self) -> float:
        """The objective."""
        return float(0.5 * self.residuals @ self.residuals if self.objective is None else self.objective)


class Minimum(NamedTuple):
    """The end of an iteration: `z`, the number of trials, whether it converged, and the objective."""

    z: Float[Array, "n"]
    iterations: int
    success: bool
    value: float


def levenberg_marquardt(
    linearised: Callable[[Float[Array, "n"]], Any],
    z: Float[Array, "n"],
    tol: float,
    limit: int,
    held: np.ndarray | None = None,
) -> Minimum:
    """Minimise an objective from its linearised residuals; trials that fail are rejected.

    A step s minimises `|r + J s|² + μ |D s|²`, with D the norms of the columns of J (Marquardt). The damping μ follows
    the gain, the ratio of the decrease of the objective to that of the linear model. Where the model promises a
    decrease of less than `tol` times the objective, errors of the motions, which differ from step to step, are more
    than that: the objective does not tell good steps from bad ones any more. These steps are taken without it, as long
    as each is less than a tenth of the one before.

    Source: H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, Technical University of Denmark.

    **Arguments:** `linearised`: residuals and their Jacobian, or a `Linearised`; `tol`: change of the unknowns and of
    the objective at which to stop, absolute and relative; `limit`: largest number of evaluations of `linearised`;
    `held`: a mask of the unknowns that stay as they are.
    """
    return minimise_together(lambda zs: [linearised(zs[0])], [z], tol, limit, held)[0]


def minimise_together(
    linearised: Callable[[list[Array]], list[Any]],
    starts: Sequence[Float[Array, "n"]],
    tol: float,
    limit: int,
    held: np.ndarray | None = None,
) -> list[Minimum]:
    """`levenberg_marquardt` from several starts, whose trials are evaluated together."""
    runs = [_trials(z, tol, limit, held) for z in starts]
    points = [next(run) for run in runs]
    found: dict[int, Minimum] = {}
    while len(found) < len(runs):
        models = linearised(points)
        for k, run in enumerate(runs):
            if k not in found:
                try:
                    points[k] = run.send(Linearised(*models[k]))
                except StopIteration as end:
                    found[k] = end.value
    return [found[k] for k in range(len(runs))]


def _trials(
    z: Float[Array, "n"], tol: float, limit: int, held: np.ndarray | None
) -> Generator[Float[Array, "n"], Linearised, Minimum]:
    """The iteration: it yields trials, and is sent the model of the objective there."""
    free = np.ones(z.size, bool) if held is None else ~held

    def at(point, model):
        residuals, jacobian = np.asarray(model.residuals), np.asarray(model.jacobian)[:, free]
        return point, residuals, jacobian, model.value if np.all(np.isfinite(jacobian)) else np.inf

    z, residuals, jacobian, objective = at(z, (yield z))
    if not np.isfinite(objective):
        return Minimum(z, 1, False, np.inf)
    damping, growth, last = _FIRST_DAMPING, 2.0, np.inf
    for iteration in range(1, limit):
        norms = np.linalg.norm(jacobian, axis=0)
        weights = np.sqrt(damping) * np.where(norms > 0, norms, 1.0)
        rows, target = np.vstack([jacobian, np.diag(weights)]), np.append(-residuals, np.zeros_like(weights))
        step = np.linalg.lstsq(rows, target, rcond=None)[0]
        whole = np.zeros(z.size)
        whole[free] = step
        point = z + jnp.asarray(whole, z.dtype)
        trial = at(point, (yield point))
        decrease = objective - trial[-1]
        predicted = 0.5 * step @ (weights**2 * step - jacobian.T @ residuals)
        gain = decrease / predicted if predicted > 0 else 0.0
        settled = predicted <= tol * (1 + abs(objective)) and abs(decrease) <= np.sqrt(tol) * (1 + abs(objective))
        # With more damping a step may promise little far from the minimum.
        hidden = settled and damping <= _FIRST_DAMPING and predicted <= tol * abs(objective)
        size = np.max(np.abs(whole) / (1 + np.abs(z)))
        if hidden and size > 0.1 * last:
            return Minimum(z, iteration + 1, True, objective)
        converged = size <= tol and settled
        gain, last = (1.0, size) if hidden else (gain, np.inf)
        if gain > 0:
            damping, growth = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), _LEAST_DAMPING), 2.0
            z, residuals, jacobian, objective = trial
        else:
            damping, growth = damping * growth, 2 * growth
        if converged:
            return Minimum(z, iteration + 1, True, objective)
    return Minimum(z, limit, False, objective)


def descend(
    optimiser: optax.GradientTransformation, objective: Objective, z: Float[Array, "n"], tol: float, limit: int
) -> Minimum:
    """Minimise an objective, with reverse-mode derivatives; where a trial fails, half its step is taken.

    **Arguments:** `tol`: size of a step at which to stop; `limit`: largest number of trials.
    """
    memory = optimiser.init(z)
    best, best_value, good = z, np.inf, z
    for iteration in range(limit):
        value, finite, step, later = _step(objective, optimiser, z, memory)
        if not bool(finite):
            z = 0.5 * (good + z)
            continue
        if float(value) < best_value:
            best, best_value = z, float(value)
        good, memory, z = z, later, z + step
        if float(jnp.max(jnp.abs(step))) <= tol:
            return Minimum(best, iteration + 1, True, best_value)
    return Minimum(best, limit, False, best_value)


@eqx.filter_jit
def _step(objective: Objective, optimiser: optax.GradientTransformation, z: Float[Array, "n"], memory: Any):
    value, gradient = jax.value_and_grad(objective)(z)
    finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))
    return value, finite, *next_step(optimiser, memory, z, value, gradient, objective)


def next_step(
    optimiser: optax.GradientTransformation,
    memory: Any,
    z: Float[Array, "n"],
    value: Array,
    gradient: Array,
    objective: Callable[[Float[Array, "n"]], Array],
) -> tuple[Float[Array, "n"], Any]:
    """A step of an optax optimiser from a point, and its memory after it."""
    with jax.numpy_dtype_promotion("standard"):
        update = optax.with_extra_args_support(optimiser).update
        step, memory = update(gradient, memory, z, value=value, grad=gradient, value_fn=objective)
    return jnp.asarray(step, z.dtype), memory
