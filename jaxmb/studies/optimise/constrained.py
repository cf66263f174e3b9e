"""Optimisation with constraints by SciPy's SLSQP, on trials that may fail.

A failed trial gets an objective far above all others, and its other values from the last good trial, so that the line
search shortens the step.
"""

import dataclasses
import warnings
from typing import Any

import numpy as np
from scipy import linalg, optimize

from .trials import HOLDS, Trial, Trials, nearer

# The objective of a failed trial, in units of the size of the objective.
_FAILED = 1e10

# Largest number of runs, each with an objective of unit size and a fresh Hessian.
_RUNS = 10

# The distances from the last point at which a stalled run restarts, in turn, in units of the scales of parameters.
_ASIDE = (0.0, 0.1)

# A gain reduces the violation of constraints at least to this fraction; a smaller reduction may be errors of
# simulations.
_LESS = 0.9

# A gradient of unit length depends on others if its remainder is no longer than this.
_DEPENDENT = 1e-8


def slsqp(trials: Trials, start: Trial, tol: float, limit: int) -> tuple[bool, str]:
    """Sequential least squares programming, restarted from its result until a run gains no more than the tolerance. The
    objective is scaled by its present size and gradient, since SciPy's tolerances are absolute and its Hessians may
    mislead it.

    A stalled run restarts at a more feasible point, or slightly aside.
    """
    here, left, ended, message = start, limit, False, ""
    aside = list(_ASIDE)
    for _ in range(_RUNS):
        size = objective_size(here)
        spent, well, how = _run(trials, here, size, tol, left)
        left -= max(spent, 1)
        new = trials.best
        gained = _nearer(trials, new, here) or (
            trials.merit(here)[0] >= trials.merit(new)[0] and here.rows[0] - new.rows[0] > tol * size
        )
        # A run without a gain confirms the previous run, however it ends.
        if gained or not ended:
            message = "no step makes progress from here" + f" (SciPy: {how.strip()!r})" * (not well)
            ended = (well and trials.violation(new) <= HOLDS) or _balanced(trials, new, tol)
        here = new
        if not gained and (ended or not aside):
            break
        if not gained:
            count = trials.count
            others = (nearer(trials, new, aside.pop(0), left) for _ in _ASIDE if aside)
            here = next((z for z in others if trials.merit(new)[0] == 0 or _nearer(trials, z, new)), None)
            left -= trials.count - count
            if here is None:
                break
        if left <= 0:
            return False, "the iterations are used up"
    return ended, "converged" if ended else message


def _run(trials: Trials, here: Trial, size: float, tol: float, left: int) -> tuple[int, bool, str]:
    """One run, with the objective in units of a size: the number of iterations, whether it converged, and SciPy's
    message.
    """
    unit = _unit(trials, here, size, tol)
    values, slopes, equal = _one_sided(trials, unit)
    kept = _independent(slopes(here.z / unit), equal)
    constraints = [
        {"type": kind, "fun": lambda y, mask=mask: values(y)[mask], "jac": lambda y, mask=mask: slopes(y)[mask]}
        for kind, mask in (("eq", kept & equal), ("ineq", kept & ~equal))
        if mask.any()
    ]
    with warnings.catch_warnings():
        # SciPy warns of linear functions and of steps to a bound; the result has the status.
        warnings.simplefilter("ignore")
        result: Any = optimize.minimize(
            lambda y: _value(trials, y * unit, size),
            here.z / unit,
            jac=lambda y: _good(trials, y * unit).jacobian[0] * unit / size,
            method="SLSQP",
            bounds=np.stack(trials.box, axis=1) / unit,
            constraints=constraints,
            callback=lambda y: trials.record(y * unit),
            options={"ftol": tol, "maxiter": left},
        )
    if result.status == 0:
        trials.ended(result.x * unit)
    return result.nit, result.status == 0, str(result.message)


def _nearer(trials: Trials, trial: Trial, other: Trial) -> bool:
    """Whether the constraints violated at another trial are violated far less."""
    return trials.merit(trial)[0] < _LESS * trials.merit(other)[0]


def _balanced(trials: Trials, trial: Trial, tol: float) -> bool:
    """Whether constraints hold and no change of the parameters by their scales promises more than the tolerance."""
    rest = float(np.linalg.norm(balance_at(trials, trial).rest))
    return trials.violation(trial) <= HOLDS and rest <= tol * objective_size(trial)


@dataclasses.dataclass(frozen=True)
class Balance:
    """The balance of the objective's gradient by constraints and bounds of parameters.

    **Fields:** `pull`: the change of the objective per unit of each constraint's output, shape (constraints,); `active`
    constraints; `push` of bounds and `rest`, the unbalanced part of the gradient, shape (n,).
    """

    pull: np.ndarray
    active: np.ndarray
    push: np.ndarray
    rest: np.ndarray


def balance_at(trials: Trials, trial: Trial) -> Balance:
    """The multipliers that best balance, in least squares, the gradient of the objective by gradients of active
    constraints and bounds, which only push inwards.
    """
    low, high, values = trials.limits.low, trials.limits.high, trial.rows[1:]
    near = 10 * HOLDS
    below, above = values <= low + near * trials.scales[0], values >= high - near * trials.scales[1]
    at_low, at_high = trial.z <= trials.box[0] + near, trial.z >= trials.box[1] - near
    gradient, slopes, axes = trial.jacobian[0], trial.jacobian[1:], np.eye(trial.z.size)
    inwards = np.vstack([slopes[below], -slopes[above], axes[at_low], -axes[at_high]])
    # The solver's tolerance is absolute: all gradients are normalised. A constraint without a gradient, such as a
    # closed gap, balances nothing.
    length, lengths = (x + (x == 0) for x in (np.linalg.norm(gradient), np.linalg.norm(inwards, axis=1)))
    multipliers = np.zeros(0)
    # SciPy's solver crashes without unknowns.
    if inwards.size:
        multipliers = optimize.nnls((inwards / lengths[:, None]).T, gradient / length)[0] * length / lengths
    sides, bounds = np.zeros((2, low.size)), np.zeros((2, trial.z.size))
    ends = np.cumsum([below.sum(), above.sum(), at_low.sum()])
    sides[0, below], sides[1, above], bounds[0, at_low], bounds[1, at_high] = np.split(multipliers, ends)
    return Balance(sides[0] - sides[1], below | above, bounds[0] - bounds[1], gradient - inwards.T @ multipliers)


def _one_sided(trials: Trials, unit: float):
    """One-sided constraints for SciPy, relative to the sizes of their sides: their values and derivatives as functions
    of z / `unit`, and a mask of the equations. Values are zero for an equation that holds, and non-negative for an
    inequality.
    """
    limits = trials.limits
    equal = limits.low == limits.high
    lower, upper = np.flatnonzero(np.isfinite(limits.low)), np.flatnonzero(np.isfinite(limits.high) & ~equal)
    which = 1 + np.concatenate([lower, upper])
    bounds = np.concatenate([limits.low[lower], limits.high[upper]])
    scales = np.concatenate([trials.scales[0, lower], -trials.scales[1, upper]])
    values = lambda y: (_good(trials, y * unit).rows[which] - bounds) / scales
    slopes = lambda y: _good(trials, y * unit).jacobian[which] / scales[:, None] * unit
    return values, slopes, np.concatenate([equal[lower], np.zeros(upper.size, bool)])


def _independent(slopes: np.ndarray, equal: np.ndarray) -> np.ndarray:
    """The mask of independent constraints. SciPy's method takes any point for an optimum if gradients of equations are
    linearly dependent, or if an inequality's gradient is a combination of them.
    """
    lengths = np.linalg.norm(slopes, axis=1)
    units = slopes / np.where(lengths > 0, lengths, 1.0)[:, None]
    equations = np.flatnonzero(equal & (lengths > 0))
    kept = lengths == 0
    if equations.size == 0:
        return np.ones(kept.size, bool)
    factors: Any = linalg.qr(units[equations].T, mode="economic", pivoting=True)
    basis, triangle, order = factors
    rank = int(np.sum(np.abs(np.diag(triangle)) > _DEPENDENT))
    kept[equations[order[:rank]]] = True
    left = units - (units @ basis[:, :rank]) @ basis[:, :rank].T
    return kept | (~equal & (np.linalg.norm(left, axis=1) > _DEPENDENT))


def objective_size(trial: Trial) -> float:
    """The size of the objective, or if larger of its change when a parameter changes by its scale."""
    size = max(abs(float(trial.rows[0])), float(np.max(np.abs(trial.jacobian[0]), initial=0.0)))
    return size if size > 0 else 1.0


def _unit(trials: Trials, here: Trial, size: float, tol: float) -> float:
    """The unit of parameters' changes for SLSQP, whose first Hessian is one. SLSQP ends if its first step promises less
    than the tolerance, for example with a large constant part of the objective. The unit then makes the first step
    promise ten times the tolerance, with a length of one at most.

    A power of two, without rounding.
    """
    slope = float(np.linalg.norm(balance_at(trials, here).rest)) / size
    # Violated constraints determine the step; a smaller slope belongs to an optimum, and may be rounding.
    if slope <= tol or slope**2 >= tol or trials.violation(here) > HOLDS:
        return 1.0
    return 2.0 ** np.round(-0.5 * np.log2(max(slope, slope**2 / (10 * tol))))


def _value(trials: Trials, z: np.ndarray, size: float) -> float:
    trial = trials(z)
    return float(trial.rows[0]) / size if trial.good else _FAILED * (1.0 + abs(float(trials.good.rows[0])) / size)


def _good(trials: Trials, z: np.ndarray) -> Trial:
    trial = trials(z)
    return trial if trial.good else trials.good
