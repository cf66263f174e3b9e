"""Levenberg–Marquardt's method, also with equality constraints, and from several starts at once."""

from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

# Damping of the first step, and its smallest value.
_FIRST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-12
# The largest gap that counts as closed, and the smallest fraction to which a step is halved.
_CLOSED, _LEAST_SHARE = 1e-9, 2.0**-5


class Linearised(NamedTuple):
    """A model of an objective at one point: its gradient is `Jᵀ r`, and `Jᵀ J` approximates its second derivatives.

    **Fields:** `residuals` r and their `jacobian` J, infinite where the simulation fails; `objective`, default `½
    |r|²`; `gaps`, to be closed to zero, and their derivatives, `closing`, of full row rank.
    """

    residuals: Any
    jacobian: Any
    objective: Any = None
    gaps: Any = None
    closing: Any = None

    @property
    def value(self) -> float:
        """The objective."""
        return float(0.5 * self.residuals @ self.residuals if self.objective is None else self.objective)


class Minimum(NamedTuple):
    """The end of an iteration: its last point `z`, the number of trials except halved steps, whether the iteration
    converged, and the objective.
    """

    z: Any
    iterations: int
    success: bool
    value: float


def _relative(z: Any, step: np.ndarray) -> float:
    return float(np.max(np.abs(step) / (1 + np.abs(z))))


def _sum(z: Any, step: np.ndarray) -> Any:
    return z + jnp.asarray(step, z.dtype)


def levenberg_marquardt(
    linearised: Callable[[Any], Any],
    z: Any,
    tol: float,
    limit: int,
    held: np.ndarray | None = None,
    move: Callable[[Any, np.ndarray], Any] = _sum,
    size: Callable[[Any, np.ndarray], float] = _relative,
) -> Minimum:
    """Minimise an objective from its linearised residuals; trials that fail are rejected.

    A step s minimises `|r + J s|² + μ |D s|²`, with D the norms of the columns of J (Marquardt), subject to `c + C s =
    0` for gaps c. With gaps the merit function is `f + ν |c|₁`; a rejected step is then halved, down to 1/32, before μ
    grows. The damping μ follows the gain, the ratio of the actual to the predicted decrease. With gaps an accepted full
    step divides μ by ten.

    Integration errors, which vary from trial to trial, hide any decrease below `tol` times the objective. If the model
    predicts no more, small μ and closed gaps let steps pass without a gain, each at most a tenth of the last.

    Source: H. B. Nielsen, "Damping parameter in Marquardt's method", IMM-REP-1999-05, Technical University of Denmark.

    **Arguments:** `linearised`: residuals and their Jacobian, or a `Linearised`; `tol`: change of the unknowns and of
    the objective at which to stop, absolute and relative; `limit`: largest number of trials, except halved steps;
    `held`: a mask of the fixed unknowns; `move(z, step)`: the point after a step, and `size(z, step)`: its length, for
    points that are not vectors.
    """
    return minimise_together(lambda zs: [linearised(zs[0])], [z], tol, limit, held, move, size)[0]


def minimise_together(
    linearised: Callable[[list[Any]], list[Any]],
    starts: Sequence[Any],
    tol: float,
    limit: int,
    held: np.ndarray | None = None,
    move: Callable[[Any, np.ndarray], Any] = _sum,
    size: Callable[[Any, np.ndarray], float] = _relative,
) -> list[Minimum]:
    """`levenberg_marquardt` from several starts, whose trials are evaluated together."""
    runs = [_trials(z, tol, limit, held, move, size) for z in starts]
    points = [next(run) for run in runs]
    minima: dict[int, Minimum] = {}
    while len(minima) < len(runs):
        models = linearised(points)
        for k, run in enumerate(runs):
            if k not in minima:
                try:
                    points[k] = run.send(Linearised(*models[k]))
                except StopIteration as end:
                    minima[k] = end.value
    return [minima[k] for k in range(len(runs))]


def _trials(z: Any, tol: float, limit: int, held: np.ndarray | None, move, size) -> Generator[Any, Linearised, Minimum]:
    """The iteration, which yields trial points and is sent the linearised objective at each."""
    model = _numbers((yield z), held)
    if not np.isfinite(model.value):
        return Minimum(z, 1, False, np.inf)
    damping, growth, share, weight, last = _FIRST_DAMPING, 2.0, 1.0, 0.0, np.inf
    least, iteration = _FIRST_DAMPING if model.gaps.size else 0.0, 1
    while iteration < limit:
        iteration += share == 1.0
        step, multipliers = _step(model, damping)
        step, weight = share * step, max(weight, 2 * float(np.max(np.abs(multipliers), initial=0.0)))
        whole = np.zeros(step.size if held is None else held.size)
        whole[slice(None) if held is None else ~held] = step
        point = move(z, whole)
        trial, objective = _numbers((yield point), held), model.value
        gap, later = (np.sum(np.abs(either.gaps)) for either in (model, trial))
        decrease = objective - trial.value + weight * (gap - later)
        change = model.jacobian @ step
        predicted = weight * share * gap - model.residuals @ change - 0.5 * change @ change
        gain = decrease / predicted if predicted > 0 else 0.0
        settled = predicted <= tol * (1 + abs(objective)) and abs(decrease) <= np.sqrt(tol) * (1 + abs(objective))
        # More damping may make the promised decrease small far from the minimum.
        hidden = settled and damping <= _FIRST_DAMPING and predicted <= tol * abs(objective) and _closed(model)
        length = size(z, whole)
        if hidden and length > 0.1 * last:
            return Minimum(z, iteration, True, objective)
        converged = share == 1.0 and length <= tol and settled and _closed(trial)
        gain, last = (1.0, length) if hidden else (gain, np.inf)
        if gain > 0 or (converged and later < gap):
            # The curvature of gaps makes the gain small near the minimum as well.
            factor = 0.1 if model.gaps.size else max(1 / 3, 1 - (2 * gain - 1) ** 3)
            factor = factor if share == 1.0 else 1.0
            damping, growth, share = max(damping * factor, _LEAST_DAMPING), 2.0, 1.0
            z, model = point, trial
        elif model.gaps.size and share > _LEAST_SHARE:
            share *= 0.5
        else:
            damping, growth, share = max(damping * growth, least), 2 * growth, 1.0
        if converged:
            return Minimum(z, iteration, True, model.value)
    return Minimum(z, limit, False, model.value)


def _numbers(model: Linearised, held: np.ndarray | None) -> Linearised:
    """A model in NumPy arrays, for the free unknowns only; its objective is infinite if a part is not finite."""
    free = slice(None) if held is None else ~held
    residuals, jacobian = np.asarray(model.residuals), np.asarray(model.jacobian)[:, free]
    gaps = np.zeros(0) if model.gaps is None else np.asarray(model.gaps)
    closing = np.zeros((0, jacobian.shape[1])) if model.closing is None else np.asarray(model.closing)[:, free]
    finite = all(np.all(np.isfinite(array)) for array in (jacobian, gaps, closing))
    return Linearised(residuals, jacobian, model.value if finite else np.inf, np.where(finite, gaps, 0.0), closing)


def _closed(model: Linearised) -> bool:
    return bool(np.max(np.abs(model.gaps), initial=0.0) <= _CLOSED)


def _step(model: Linearised, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The step, and the multipliers of the gaps."""
    rows, upper, null = null_basis(model.closing)
    closed = rows @ np.linalg.solve(upper.T, -model.gaps)
    norms = np.linalg.norm(model.jacobian, axis=0)
    weights = np.sqrt(damping) * np.where(norms > 0, norms, 1.0)
    whole = np.vstack([model.jacobian, np.diag(weights)])
    target = np.append(-model.residuals, np.zeros_like(weights)) - whole @ closed
    step = closed + null @ np.linalg.lstsq(whole @ null, target, rcond=None)[0]
    gradient = model.jacobian.T @ (model.residuals + model.jacobian @ step) + weights**2 * step
    return step, np.linalg.solve(upper, -rows.T @ gradient)


def null_basis(matrix: Float[np.ndarray, "m n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For a matrix of full row rank: bases of its row and null spaces, and the triangular factor of its transpose."""
    whole, upper = np.linalg.qr(matrix.T, mode="complete")
    m = matrix.shape[0]
    return whole[:, :m], upper[:m], whole[:, m:]
