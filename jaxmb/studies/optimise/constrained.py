"""Optimisation with constraints by SciPy's SLSQP, on trials that may fail.

Where a trial fails, the objective is far above all others and everything else is as at the last good trial, so that the
line search shortens the step.
"""

import dataclasses
import warnings
from typing import Any

import numpy as np
from scipy import linalg, optimize

from .trials import HOLDS, Trial, Trials, nearer

# The objective of a trial that failed, in units of the size of the objective.
_FAILED = 1e10

# Largest number of runs, each with an objective of unit size and a fresh Hessian.
_RUNS = 10

# How far from its last point a method that cannot go on starts anew, in units of the scales of parameters.
_ASIDE = (0.0, 0.1)

# A gain is what leaves no more than this of the violation of constraints; less may be errors of simulations.
_LESS = 0.9

# A gradient of unit length is a combination of others where no more than this is left of it.
_DEPENDENT = 1e-8


def slsqp(trials: Trials, start: Trial, tol: float, limit: int) -> tuple[bool, str]:
    """Sequential least squares programming, again and again from its own result, with the objective in units of what is
    left of it and of its gradient, until a run gains no more than the tolerance: SciPy's tolerances are absolute, and
    its Hessians may mislead it.

    Where it cannot go on it starts anew at a point where constraints hold better, or a little aside.
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
        # A run that gains nothing confirms the one before, however it ends.
        if gained or not ended:
            message = "no step leads on from here" + f" (SciPy: {how.strip()!r})" * (not well)
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
    """One run, the objective in units of a size: the number of iterations, whether it converged, and SciPy's words."""
    unit = _unit(trials, here, size, tol)
    values, slopes, equal = _one_sided(trials, unit)
    kept = _independent(slopes(here.z / unit), equal)
    constraints = [
        {"type": kind, "fun": lambda y, own=own: values(y)[own], "jac": lambda y, own=own: slopes(y)[own]}
        for kind, own in (("eq", kept & equal), ("ineq", kept & ~equal))
        if own.any()
    ]
    with warnings.catch_warnings():
        # SciPy warns of functions that are linear, and of steps to a bound; the result says how it ended.
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
    """Whether constraints that do not hold at another trial are violated far less."""
    return trials.merit(trial)[0] < _LESS * trials.merit(other)[0]


def _balanced(trials: Trials, trial: Trial, tol: float) -> bool:
    """Whether constraints hold and no change of the parameters by their scales promises more than the tolerance."""
    rest = float(np.linalg.norm(balance_at(trials, trial).rest))
    return trials.violation(trial) <= HOLDS and rest <= tol * objective_size(trial)


@dataclasses.dataclass(frozen=True)
class Balance:
    """How constraints and the bounds of parameters balance the gradient of the objective.

    **Fields:** `pull`: the objective's gain of one unit more of each constraint's output, shape (constraints,);
    `active` constraints; `push` of bounds and `rest`, the part of the gradient that is not balanced, shape (n,).
    """

    pull: np.ndarray
    active: np.ndarray
    push: np.ndarray
    rest: np.ndarray


def balance_at(trials: Trials, trial: Trial) -> Balance:
    """The multipliers that come closest, in least squares, to balancing the gradient of the objective by those of
    active constraints and bounds, each of which only pushes inwards.
    """
    low, high, values = trials.limits.low, trials.limits.high, trial.rows[1:]
    near = 10 * HOLDS
    below, above = values <= low + near * trials.scales[0], values >= high - near * trials.scales[1]
    at_low, at_high = trial.z <= trials.box[0] + near, trial.z >= trials.box[1] - near
    gradient, slopes, axes = trial.jacobian[0], trial.jacobian[1:], np.eye(trial.z.size)
    inwards = np.vstack([slopes[below], -slopes[above], axes[at_low], -axes[at_high]])
    # The solver's tolerance is absolute: all are made of length one. A constraint without a gradient, such as a gap
    # that is closed, balances nothing.
    length, lengths = (x + (x == 0) for x in (np.linalg.norm(gradient), np.linalg.norm(inwards, axis=1)))
    found = np.zeros(0)
    # SciPy's solver crashes without unknowns.
    if inwards.size:
        found = optimize.nnls((inwards / lengths[:, None]).T, gradient / length)[0] * length / lengths
    sides, bounds = np.zeros((2, low.size)), np.zeros((2, trial.z.size))
    ends = np.cumsum([below.sum(), above.sum(), at_low.sum()])
    sides[0, below], sides[1, above], bounds[0, at_low], bounds[1, at_high] = np.split(found, ends)
    return Balance(sides[0] - sides[1], below | above, bounds[0] - bounds[1], gradient - inwards.T @ found)


def _one_sided(trials: Trials, unit: float):
    """The constraints as SciPy wants them, relative to the sizes of their sides: functions of z in a unit, which are
    not negative, or zero for equations; their derivatives; and which of them are equations.
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
    """Constraints for SciPy's method, which takes any point for an optimum where gradients of equations are linearly
    dependent, or where an inequality's gradient is a combination of them.
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
    """The size of the objective, or of its change where parameters change by their scales, if that is larger."""
    size = max(abs(float(trial.rows[0])), float(np.max(np.abs(trial.jacobian[0]), initial=0.0)))
    return size if size > 0 else 1.0


def _unit(trials: Trials, here: Trial, size: float, tol: float) -> float:
    """The unit of parameters' changes for SLSQP, which takes a Hessian of one at first, and ends where the step that
    follows from it promises less than the tolerance, as where the objective has a large constant part. There the unit
    is such that the first step promises ten times the tolerance, unless it is then longer than one: what is left shows.

    A power of two, so that nothing is rounded.
    """
    slope = float(np.linalg.norm(balance_at(trials, here).rest)) / size
    # Where constraints are violated, they make the step; a smaller slope is that of an optimum, and may be rounding.
    if slope <= tol or slope**2 >= tol or trials.violation(here) > HOLDS:
        return 1.0
    return 2.0 ** np.round(-0.5 * np.log2(max(slope, slope**2 / (10 * tol))))


def _value(trials: Trials, z: np.ndarray, size: float) -> float:
    trial = trials(z)
    return float(trial.rows[0]) / size if trial.good else _FAILED * (1.0 + abs(float(trials.good.rows[0])) / size)


def _good(trials: Trials, z: np.ndarray) -> Trial:
    trial = trials(z)
    return trial if trial.good else trials.good
