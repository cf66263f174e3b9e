"""Tests by trials beside the result of an optimisation, whether it is a minimum."""

from collections.abc import Callable, Iterator

import numpy as np

from .constrained import Balance, objective_size
from .trials import HOLDS, Trial, Trials

# Gradients below this, relative to the objective, belong to an optimum.
_BALANCED = 1e-3

# Distance beside the result of the test for a leap of the objective, in units of the scales of parameters.
_BESIDE = 1e-5

# Distances beside the result at which the objective must increase, in the same units.
_NEAR, _FAR = 1e-3, 1e-2

# Largest number of directions in which the curvature is measured.
_DIRECTIONS = 8

# Least ratio of the slopes at the far and the near point for a true decrease: a remaining slope of the iteration is
# constant.
_STEEPER = 3.0

# Least significant decrease on both sides, and on one side, relative to the objective.
_BOTH, _ONE = 1e-11, 1e-7

# Constraints and bounds with less than this fraction of the gradient do not hold the result.
_WEAK = 1e-6


def objection(at: Callable[[np.ndarray], Trial], trials: Trials, balance: Balance, components: list[str]) -> str | None:
    """The objection to a converged result, or None.

    **Arguments:** `at(z)`: a trial; `components`: the names of z's components.
    """
    best = trials.best
    if (reason := _steep(at, trials, balance)) is not None:
        return reason
    if not best.jacobian[0].any() and not trials.start.jacobian[0].any():
        others = [at(z) for z in _around(trials)]
        if not any(other.jacobian[0].any() for other in others):
            return _flat(best, [float(other.rows[0]) for other in others])
    return _unstable(at, trials, balance, components)


def _steep(at, trials: Trials, balance: Balance) -> str | None:
    """An unbalanced gradient, as beside another branch of assembly, or from a method that ended too early. A kink of
    the objective is a minimum.
    """
    best, rest = trials.best, balance.rest
    length = float(np.linalg.norm(rest))
    if length <= _BALANCED * objective_size(best):
        return None
    beside = at(np.clip(best.z - _BESIDE * rest / length, *trials.box))
    if not beside.good:
        return None
    gained = best.rows[0] - beside.rows[0]
    slope = max(np.linalg.norm(trial.jacobian[0]) for trial in (best, beside))
    if gained < -10 * slope * _BESIDE:
        return (
            f"beside the result the objective leaps to {beside.rows[0]:.6g}, though its gradient promises a decrease: "
            "constrain a margin from there, or give the assembly a guess closer to the branch"
        )
    if gained > 0.5 * length * _BESIDE:
        return "the objective still decreases along the constraints: start elsewhere, or use another method"
    return None


def _around(trials: Trials) -> Iterator[np.ndarray]:
    """Points about the best trial, within half the scale of parameters."""
    step = np.random.default_rng(0).uniform(-0.5, 0.5, (4, trials.best.z.size))
    return (np.clip(trials.best.z + offset, *trials.box) for offset in step)


def _flat(best: Trial, others: list[float]) -> str | None:
    """Words for an objective without a gradient. A constant objective is minimal wherever constraints hold."""
    if any(value != best.rows[0] for value in others):
        return (
            "the derivative of the objective is exactly zero, though its value changes: it changes in steps, as by "
            "rounding, counting or comparing, which have no gradient"
        )
    if best.rows.size > 1:
        return None
    return "the objective does not change: its derivative by every parameter is exactly zero"


def _unstable(at, trials: Trials, balance: Balance, components: list[str]) -> str | None:
    """A direction in which the objective decreases on the constraints, to second order."""
    size = objective_size(trials.best)
    basis = _tangents(trials, balance)
    if basis.shape[1] == 0:
        return None
    seen = _Lagrangian(at, trials, balance)
    direction, largest = _least_curved(seen, basis)
    lower = [seen.decrease(direction), seen.decrease(-direction)]
    both = min(lower) > _BOTH * size
    if not both and max(lower) <= _ONE * size:
        return None
    way = direction if lower[0] >= lower[1] else -direction
    k = int(np.argmax(np.abs(way)))
    what = "a saddle" if largest > 0 else "a maximum"
    what = f"{what} of the objective, not a minimum" if both else "not a minimum of the objective"
    side = "increases" if way[k] > 0 else "decreases"
    return f"the result is {what}: the objective decreases where {components[k]!r} {side}. Start there"


class _Lagrangian:
    """The objective less the constraints times their multipliers, near the best trial: stationary there."""

    def __init__(self, at, trials: Trials, balance: Balance):
        self.at, self.trials, self.here = at, trials, trials.best
        self.weights = np.concatenate([[1.0], -balance.pull])
        self.gradient = self.weights @ self.here.jacobian

    def beside(self, step: np.ndarray) -> Trial | None:
        """A trial beside the result, unless it fails or is out of bounds."""
        z = self.here.z + step
        low, high = self.trials.box
        trial = self.at(np.clip(z, low, high)) if np.all((z >= low - HOLDS) & (z <= high + HOLDS)) else None
        return trial if trial is not None and trial.good else None

    def decrease(self, direction: np.ndarray) -> float:
        """The decrease along a direction; zero without one, or if a constraint blocks the way."""
        near, far = (self.beside(length * direction) for length in (_NEAR, _FAR))
        if near is None or far is None:
            return 0.0
        first, second = (self.weights @ trial.jacobian @ direction for trial in (near, far))
        if first >= 0 or second > _STEEPER * first:
            return 0.0
        # Constraints with multipliers hold to first order; others must not block the way.
        free = self.weights[1:] == 0
        excess = self.trials.limits.excess(far.rows[1:], self.trials.scales)
        if np.max(excess[free], initial=0.0) > HOLDS:
            return 0.0
        return float(self.weights @ (self.here.rows - far.rows))


def _tangents(trials: Trials, balance: Balance) -> np.ndarray:
    """An orthonormal basis of the changes that keep, to first order, the constraints that hold the result, shape (n,
    free).
    """
    best, size = trials.best, np.linalg.norm(trials.best.jacobian[0])
    slopes, equal = best.jacobian[1:], trials.limits.low == trials.limits.high
    lengths = np.linalg.norm(slopes, axis=1)
    rows = (lengths > 0) & (equal | (np.abs(balance.pull) * lengths > _WEAK * size))
    held = np.vstack([slopes[rows] / lengths[rows, None], np.eye(best.z.size)[np.abs(balance.push) > _WEAK * size]])
    _, values, turned = np.linalg.svd(held, full_matrices=True)
    return turned[int(np.sum(values > _WEAK)) :].T


def _least_curved(seen: _Lagrangian, basis: np.ndarray) -> tuple[np.ndarray, float]:
    """The direction of smallest curvature, and the largest curvature, by Lanczos's method."""
    free = lambda x: basis @ (basis.T @ x)
    new = free(np.random.default_rng(0).standard_normal(basis.shape[0]))
    directions, images = np.zeros((0, new.size)), np.zeros((0, new.size))
    while len(images) < min(_DIRECTIONS, basis.shape[1]) and np.linalg.norm(new) > 0:
        directions = np.vstack([directions, new / np.linalg.norm(new)])
        sides = ((sign, seen.beside(sign * _NEAR * directions[-1])) for sign in (1.0, -1.0))
        sign, trial = next(((sign, trial) for sign, trial in sides if trial is not None), (1.0, None))
        change = np.zeros(new.size) if trial is None else seen.weights @ trial.jacobian - seen.gradient
        images = np.vstack([images, free(change) / (sign * _NEAR)])
        new = images[-1]
        for _ in range(2):
            new = free(new - directions.T @ (directions @ new))
        if np.linalg.norm(new) <= _WEAK * np.linalg.norm(images[-1]):
            new = np.zeros(new.size)
    projected = directions @ images.T
    values, vectors = np.linalg.eigh(0.5 * (projected + projected.T))
    return vectors[:, 0] @ directions, float(values[-1])
