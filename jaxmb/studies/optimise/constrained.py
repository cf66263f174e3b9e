"""SciPy's methods for optimisation with constraints, SLSQP and trust-constr, on trials that may fail.

Where a trial fails, the objective is far above all others and everything else is as at the last good trial, so that
both methods shorten the step: SLSQP its line search, trust-constr its trust region.
"""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from .trials import HOLDS, Trial, Trials

# The objective of a trial that failed, in units of the size of the objective.
_FAILED = 1e10

# Largest number of runs, each with an objective of unit size and a fresh Hessian.
_RUNS = 10

# The factor from run to run of the first barrier of trust-constr.
_BARRIER = 1e-2


def slsqp(trials: Trials, start: Trial, tol: float, limit: int) -> tuple[bool, str]:
    """Sequential least squares programming."""
    optimize = _scipy()

    def run(here, size, left, number):
        del number
        result = _quietly(
            optimize.minimize,
            lambda z: _value(trials, z, size),
            here.z,
            jac=lambda z: _good(trials, z).jacobian[0] / size,
            method="SLSQP",
            bounds=optimize.Bounds(*trials.box),
            constraints=_one_sided(trials),
            callback=trials.record,
            options={"ftol": tol, "maxiter": left},
        )
        if result.status == 0:
            trials.ended(result.x)
        return result.nit, result.status == 0, str(result.message)

    return _repeated(run, trials, start, tol, limit)


def trust_constr(trials: Trials, start: Trial, tol: float, limit: int) -> tuple[bool, str]:
    """SciPy's trust-region interior point method, with quasi-Newton Hessians."""
    optimize = _scipy()
    low, high = trials.limits.low / trials.scales, trials.limits.high / trials.scales
    constraints = []
    if trials.scales.size:
        values = lambda z: _good(trials, z).rows[1:] / trials.scales
        slopes = lambda z: _good(trials, z).jacobian[1:] / trials.scales[:, None]
        constraints = [optimize.NonlinearConstraint(values, low, high, jac=slopes, hess=optimize.BFGS())]

    def run(here, size, left, number):
        result = _quietly(
            optimize.minimize,
            lambda z: _value(trials, z, size),
            here.z,
            jac=lambda z: _good(trials, z).jacobian[0] / size,
            hess=optimize.BFGS(),
            method="trust-constr",
            bounds=optimize.Bounds(*trials.box, keep_feasible=True),
            constraints=constraints,
            callback=lambda z, state: trials.record(z),
            options={"gtol": tol, "xtol": tol, "barrier_tol": tol, "maxiter": left}
            | {name: max(_BARRIER**number, tol) for name in ("initial_barrier_parameter", "initial_barrier_tolerance")},
        )
        return result.nit, result.status in (1, 2), str(result.message)

    return _repeated(run, trials, start, tol, limit)


def _repeated(run: Callable[..., tuple[int, bool, str]], trials: Trials, start: Trial, tol: float, limit: int):
    """Run a method from its own result, with the objective in units of what is left of it and of its gradient, until a
    run gains no more than the tolerance: SciPy's tolerances are absolute, and its Hessians and barriers may mislead it.
    """
    here, left, ended, message = start, limit, False, ""
    for number in range(1, _RUNS + 1):
        size = _size(here)
        spent, well, how = run(here, size, left, number)
        left -= max(spent, 1)
        new = trials.best
        gained = trials.merit(here)[0] > trials.merit(new)[0] or here.rows[0] - new.rows[0] > tol * size
        # A run that gains nothing confirms the one before, however it ends.
        if gained or not ended:
            ended, message = well, how
        here = new
        if not gained and (well or number > 1):
            break
        if left <= 0:
            return False, "the iterations are used up"
    return ended, message.strip().rstrip(".")


def multipliers(trials: Trials, trial: Trial) -> tuple[np.ndarray, np.ndarray, float]:
    """What one unit more of each constraint's bound would gain of the objective, which constraints are active, and the
    largest component of the gradient of the objective that they do not balance.

    The multipliers are those that come closest, in least squares, to balancing the gradient of the objective with those
    of active constraints and bounds.
    """
    low, high, values = trials.limits.low, trials.limits.high, trial.rows[1:]
    near = 10 * HOLDS * trials.scales
    below, above = values <= low + near, values >= high - near
    active = below | above
    at_bound = (trial.z <= trials.box[0]) | (trial.z >= trials.box[1])
    # A constraint without a gradient, such as a gap that is closed, balances nothing.
    gradients = np.where(active[:, None], trial.jacobian[1:], 0.0)[:, ~at_bound]
    found = np.linalg.lstsq(gradients.T, trial.jacobian[0, ~at_bound], rcond=1e-10)[0] if active.any() else 0.0 * values
    signed = np.where(below, found, -found)
    left = float(np.max(np.abs(trial.jacobian[0, ~at_bound] - gradients.T @ found), initial=0.0))
    return np.where(active, np.where(low == high, np.abs(found), signed), 0.0) + 0.0, active, left


def _one_sided(trials: Trials) -> list[dict[str, Any]]:
    """The constraints as SLSQP wants them: equations, and functions that are not negative."""
    limits, scales = trials.limits, trials.scales
    out = []

    def add(kind: str, which: np.ndarray, sign: float, bound: np.ndarray) -> None:
        if which.any():
            value = lambda z: (sign * (_good(trials, z).rows[1:] - bound) / scales)[which]
            slope = lambda z: (sign * _good(trials, z).jacobian[1:] / scales[:, None])[which]
            out.append({"type": kind, "fun": value, "jac": slope})

    equal = limits.low == limits.high
    add("eq", equal, 1.0, limits.low)
    add("ineq", np.isfinite(limits.low) & ~equal, 1.0, limits.low)
    add("ineq", np.isfinite(limits.high) & ~equal, -1.0, limits.high)
    return out


def _size(trial: Trial) -> float:
    """The size of the objective, or of its change where parameters change by their scales, if that is larger."""
    size = max(abs(float(trial.rows[0])), float(np.max(np.abs(trial.jacobian[0]), initial=0.0)))
    return size if size > 0 else 1.0


def _value(trials: Trials, z: np.ndarray, size: float) -> float:
    trial = trials(z)
    return float(trial.rows[0]) / size if trial.good else _FAILED * (1.0 + abs(float(trials.good.rows[0])) / size)


def _good(trials: Trials, z: np.ndarray) -> Trial:
    trial = trials(z)
    return trial if trial.good else trials.good


def _quietly(run: Callable[..., Any], *args: Any, **options: Any) -> Any:
    with warnings.catch_warnings():
        # SciPy warns of functions that are linear, and of steps to a bound; the result says how it ended.
        warnings.simplefilter("ignore")
        return run(*args, **options)


def _scipy() -> Any:
    try:
        from scipy import optimize
    except ImportError:
        raise ImportError("This method is SciPy's: install it, or jaxmb[studies].") from None
    return optimize
