"""Multiple shooting on the constraint manifold: long motions that are chaotic or unstable, in short segments.

The states at the starts of segments are unknowns, each in independent coordinates: a chart of the constraint manifold
takes w to the state closest to `x + T w`, with T a basis of the tangent space at x. That each segment begins where the
last one ends are equality constraints `c = 0`. Each step solves

    minimise ½ |r + J s|² + ½ μ |D s|²  subject to  c + C s = 0

by orthogonal factorisation of C, which a recursion over the segments would be without its growth; its length is chosen
such that `f + ν |c|₁` decreases. Charts are then moved to the new states.

Source: H. G. Bock, "Recent Advances in Parameter Identification Techniques for O.D.E.", in: Numerical Treatment of
Inverse Problems in Differential and Integral Equations, Birkhäuser 1983.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._types import State
from .problem import Problem, with_likely_levels
from .segments import Point, evaluated, initial_everywhere, moved, retracted, segmented

# Steps of each segment towards its own data, before they are joined.
_ALONE = 12
# The largest gap, in scaled coordinates, of a motion that counts as continuous.
_CONTINUOUS = 1e-9
# Damping of the first step, its bounds, and halvings of a step before the damping grows.
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING, _HALVINGS = 1e-6, 1e-12, 1e8, 6


class Shot(NamedTuple):
    """Where multiple shooting ended.

    **Fields:** as of `Fit`: `jacobian` is along the directions that keep the motion continuous, `along` says how z
    changes along them, and `continuity` is the largest gap.
    """

    z: Array
    residuals: np.ndarray
    jacobian: np.ndarray
    along: np.ndarray
    objective: float
    readings: dict[str, dict[str, np.ndarray]]
    continuity: float
    iterations: int
    success: bool


def shoot(problem: Problem, z: Float[Array, "n"], segments: int, tol: float, limit: int) -> Shot:
    """Fit all experiments in segments.

    **Arguments:** `segments` of each experiment; `tol`: change of unknowns and objective at which to stop; `limit`:
    largest number of steps.

    **Raises:** `ValueError` for sensors with a delay, residual functions, more segments than samples, and if the
    simulations with the starting values fail.
    """
    lanes = tuple(
        segmented(problem.names[number], number, trial, segments)
        for number, trial in enumerate(problem.trials)
        if problem.fitted[number]
    )
    evaluate = lambda z, states: evaluated(problem, lanes, z, states)
    states = tuple(initial_everywhere(problem, own, z) for own in lanes)
    point = evaluate(z, states)
    if not np.isfinite(point.objective):
        raise ValueError("The simulation of the segments fails with the starting values.")
    point = _each_to_its_data(lanes, evaluate, point)
    likely = with_likely_levels(problem, point.z, point.readings)
    if not np.array_equal(likely, point.z):
        point = evaluate(likely, point.states)
    point, iterations, success = _join(problem, lanes, evaluate, point, tol, limit)
    basis = _null_basis(point.continuity)[2]
    return Shot(
        point.z,
        point.plain.residuals[: point.data],
        point.plain.jacobian @ basis,
        basis[: z.size],
        point.objective,
        point.readings,
        float(np.max(np.abs(point.gaps))),
        iterations,
        success,
    )


def _join(problem, lanes, evaluate: Callable, point: Point, tol: float, limit: int) -> tuple[Point, int, bool]:
    """Steps of the constrained problem, until the motion is continuous and nothing changes."""
    damping, weight = _FIRST_DAMPING, 0.0
    for iteration in range(1, limit + 1):
        step, multipliers = _step(point, damping)
        weight = max(weight, 2 * float(np.max(np.abs(multipliers), initial=0.0)))
        change = point.residuals @ (point.jacobian @ step)
        expected = weight * np.sum(np.abs(point.gaps)) - change
        for halving in range(_HALVINGS):
            length = 0.5**halving
            trial = evaluate(*moved(problem, lanes, point, length * step))
            small = np.all(np.abs(length * step[: point.z.size]) <= tol * (1 + np.abs(np.asarray(point.z))))
            still = abs(trial.objective - point.objective) <= tol * (1 + abs(point.objective))
            continuous = np.max(np.abs(trial.gaps)) <= _CONTINUOUS
            if halving == 0 and small and still and continuous:
                return trial, iteration, True
            if _merit(trial, weight) <= _merit(point, weight) - 1e-4 * length * max(expected, 0.0):
                break
        else:
            damping = max(10 * damping, _FIRST_DAMPING)
            if damping > _MOST_DAMPING:
                return point, iteration, False
            continue
        damping = max(damping / 10, _LEAST_DAMPING) if length == 1 else damping
        point = trial
    return point, limit, False


def _merit(point: Point, weight: float) -> float:
    """The objective, and the gaps as they weigh against it."""
    return point.objective + weight * np.sum(np.abs(point.gaps)) if np.isfinite(point.objective) else np.inf


def _null_basis(matrix: Float[np.ndarray, "m n"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bases of the row space and of the null space of a matrix of full row rank, and its triangular factor."""
    whole, upper = np.linalg.qr(matrix.T, mode="complete")
    m = matrix.shape[0]
    return whole[:, :m], upper[:m], whole[:, m:]


def _step(point: Point, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The step, and the multipliers of the gaps."""
    rows, upper, null = _null_basis(point.continuity)
    restored = rows @ np.linalg.solve(upper.T, -point.gaps)
    norms = np.linalg.norm(point.jacobian, axis=0)
    weights = np.sqrt(damping) * np.where(norms > 0, norms, 1.0)
    whole = np.vstack([point.jacobian, np.diag(weights)])
    target = np.append(-point.residuals, np.zeros(weights.size)) - whole @ restored
    step = restored + null @ np.linalg.lstsq(whole @ null, target, rcond=None)[0]
    gradient = point.jacobian.T @ (point.residuals + point.jacobian @ step) + weights**2 * step
    return step, np.linalg.solve(upper, -rows.T @ gradient)


def _each_to_its_data(lanes, evaluate, point: Point) -> Point:
    """The states from which each segment alone fits its data, with the parameters as they are, by damped steps.

    They are only where the joint iteration starts, and weigh all residuals by their squares.
    """
    dampings = [np.full(len(own.samples), 1e-3) for own in lanes]
    for _ in range(_ALONE):
        moves = []
        for lane, (_, residuals, jacobians), damping in zip(lanes, point.alone, dampings, strict=True):
            steps = []
            for k in range(len(lane.samples)):
                norms = np.linalg.norm(jacobians[k], axis=0)
                weights = np.sqrt(damping[k]) * np.where(norms > 0, norms, 1.0)
                rows = np.vstack([jacobians[k], np.diag(weights)])
                steps.append(np.linalg.lstsq(rows, np.append(-residuals[k], 0 * weights), rcond=None)[0])
            moves.append(np.stack(steps))
        states = tuple(
            retracted(lane, system, state, charts, move)
            for lane, (system, *_), state, charts, move in zip(
                lanes, point.alone, point.states, point.charts, moves, strict=True
            )
        )
        trial = evaluate(point.z, states)
        better = []
        for (_, before, _), (_, after, _), damping in zip(point.alone, trial.alone, dampings, strict=True):
            size = lambda rows: np.sum(np.where(np.isfinite(rows), rows, np.inf) ** 2, axis=1)
            better.append(size(after) < size(before))
            damping *= np.where(better[-1], 0.2, 5.0)
        if not any(own.any() for own in better):
            break
        pick = lambda own, new, old: jnp.where(jnp.asarray(own)[:, None], new, old)
        states = tuple(
            State(pick(own, new.q, old.q), pick(own, new.u, old.u))
            for own, new, old in zip(better, states, point.states, strict=True)
        )
        point = evaluate(point.z, states)
    return point
