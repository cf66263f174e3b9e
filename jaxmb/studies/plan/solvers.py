"""Methods for nonlinear programs: IPOPT with exact second derivatives, or SciPy's SLSQP for small programs."""

import importlib.util
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize

from .problem import Evaluated, Problem

# The largest number of variables for SLSQP, whose matrices are dense.
_SMALL = 400
# The objective of a failed trial, in units of the last.
_FAILED = 1e10
_SOLVED, _ACCEPTABLE, _STOPPED = 0, 1, 5
# IPOPT's first weight of the barrier.
_BARRIER = 0.1
_CURE = "another guess=, more intervals or wider bounds may help"
_MESSAGES = {
    0: "converged",
    1: "converged to a lower accuracy",
    2: f"no motion near the last meets all conditions; {_CURE}",
    3: f"the step became too small; {_CURE}",
    5: "stopped to change charts",
    -1: "the limit of iterations was reached",
    -2: f"the search for a motion that meets all conditions failed; {_CURE}",
    -3: "no step could be computed",
    -10: "there are more conditions than variables",
}


class Answer(NamedTuple):
    """The end of a method: the variables, multipliers of the rows and of the bounds (positive at upper bounds), whether
    the method converged, its message, and whether Ctrl-C ended it; the last weight of IPOPT's `barrier`.
    """

    z: np.ndarray
    multipliers: np.ndarray
    of_bounds: np.ndarray
    success: bool
    message: str
    interrupted: bool = False
    barrier: float = 0.0


# Told of each iteration: the objective, and the largest violation of a row; whether to go on.
Told = Callable[[float, float], bool]


def minimise(
    problem: Problem, z: np.ndarray, before: Answer | None, method: str, limit: int, tol: float, told: Told
) -> Answer:
    """The local minimum near z.

    **Arguments:** `before`: the answer in other charts that led to z; `limit`: the largest number of iterations.
    """
    return _ipopt(problem, z, before, limit, tol, told) if method == "ipopt" else _slsqp(problem, z, limit, tol, told)


def chosen_method(method: str | None, size: int) -> str:
    """The method by name, by default IPOPT where it is installed.

    **Raises:** `ValueError` for an unknown name and a program too large for SLSQP; `ImportError` without `ipyopt`.
    """
    installed = importlib.util.find_spec("ipyopt") is not None
    if method not in (None, "ipopt", "slsqp"):
        raise ValueError(f"plan: method must be 'ipopt' or 'slsqp', got {method!r}.")
    if method == "ipopt" and not installed:
        raise ImportError('plan: method="ipopt" needs ipyopt; install it with: pip install "jaxmb[plan]"')
    chosen = method or ("ipopt" if installed else "slsqp")
    if chosen == "slsqp" and size > _SMALL:
        raise ValueError(
            f"plan: SciPy's SLSQP takes up to {_SMALL} variables, and this plan has {size}. Take fewer intervals, or "
            'install IPOPT with: pip install "jaxmb[plan]"'
        )
    return chosen


def _ipopt(problem: Problem, z: np.ndarray, before: Answer | None, limit: int, tol: float, told: Told) -> Answer:
    import ipyopt

    scale, count = problem.scale, problem.row_low.size
    rows, columns = problem.places
    first, interrupted, barrier = rows == 0, False, _BARRIER
    pairs = np.prod([scale[places] for places in problem.lower_places], axis=0)

    def filled(function):
        """A callback that fills an array from all functions at a point; NaN, which ends the method, after Ctrl-C."""

        def callback(w, *arguments):
            nonlocal interrupted
            try:
                arguments[-1][:] = function(problem.at(w * scale), *arguments[:-1])
            except KeyboardInterrupt:
                interrupted = True
            if interrupted:
                arguments[-1][:] = np.nan

        return callback

    def gradient(here):
        out = np.zeros(scale.size)
        out[columns[first]] = problem.slopes(here)[first] * scale[columns[first]]
        return out

    def objective(w):
        value = np.zeros(1)
        filled(lambda here: here.rows[:1])(w, value)
        return float(value[0])

    def after(mode, number, value, violation, of_dual, mu, *_):
        nonlocal barrier, interrupted
        barrier = mu
        try:
            return told(value, violation) and not interrupted
        except KeyboardInterrupt:
            interrupted = True
            return False

    options = {"print_level": 0, "sb": "yes", "tol": tol, "constr_viol_tol": tol, "max_iter": limit}
    options |= {"bound_relax_factor": 0.0, "mu_init": _BARRIER if before is None else max(before.barrier, tol)}
    program = ipyopt.Problem(
        n=scale.size,
        x_l=problem.low / scale,
        x_u=problem.high / scale,
        m=count,
        g_l=problem.row_low,
        g_u=problem.row_high,
        sparsity_indices_jac_g=(rows[~first] - 1, columns[~first]),
        sparsity_indices_h=problem.lower_places,
        eval_f=objective,
        eval_grad_f=filled(gradient),
        eval_g=filled(lambda here: here.rows[1:]),
        eval_jac_g=filled(lambda here: (problem.slopes(here) * scale[columns])[~first]),
        eval_h=filled(lambda here, of_rows, weight: problem.bends(here, np.append(weight, of_rows)) * pairs),
        intermediate_callback=after,
        ipopt_options=options,
    )
    multipliers, below, above = np.zeros(count), np.zeros(scale.size), np.zeros(scale.size)
    w, _, status = program.solve(z / scale, mult_g=multipliers, mult_x_L=below, mult_x_U=above)
    message = "interrupted" if interrupted else _MESSAGES.get(status, f"IPOPT ended with status {status}")
    # IPOPT has no multipliers of variables that are fixed: they balance the slope of the Lagrangian.
    slope: Any = problem.jacobian(problem.at(w * scale)).T @ np.append(1.0, multipliers)
    of_bounds = np.where(problem.low == problem.high, -slope, (above - below) / scale)
    return Answer(w * scale, multipliers, of_bounds, status in (_SOLVED, _ACCEPTABLE), message, interrupted, barrier)


def _slsqp(problem: Problem, z: np.ndarray, limit: int, tol: float, told: Told) -> Answer:
    scale, last, good = problem.scale, z / problem.scale, problem.at(z)
    equal = problem.row_low == problem.row_high
    lower, upper = np.isfinite(problem.row_low) & ~equal, np.isfinite(problem.row_high) & ~equal
    order = np.concatenate([np.flatnonzero(mask) for mask in (equal, lower, upper)])
    signs = np.concatenate([np.ones(equal.sum() + lower.sum()), -np.ones(upper.sum())])
    limits = np.concatenate([problem.row_low[equal], problem.row_low[lower], problem.row_high[upper]])

    def at(w) -> Evaluated:
        """All functions at a point, or at the last point where they were finite."""
        nonlocal good
        here = problem.at(w * scale)
        good = here if here.finite else good
        return good

    slopes = lambda w: problem.jacobian(at(w)).toarray() * scale
    values = lambda w: signs * (at(w).rows[1:][order] - limits)
    value = lambda w: float(at(w).rows[0]) if problem.at(w * scale).finite else _FAILED * (1 + abs(float(good.rows[0])))
    count = int(equal.sum())
    kinds: Any = [
        {
            "type": kind,
            "fun": lambda w, part=part: values(w)[part],
            "jac": lambda w, part=part: (signs[:, None] * slopes(w)[1:][order])[part],
        }
        for kind, part in (("eq", slice(0, count)), ("ineq", slice(count, None)))
        if order[part].size
    ]

    def after(w):
        nonlocal last
        last, rows = np.array(w), at(w).rows
        excess = np.maximum(problem.row_low - rows[1:], rows[1:] - problem.row_high)
        if not told(float(rows[0]), float(np.max(excess, initial=0.0))):
            raise StopIteration

    interrupted, success, message = False, False, "interrupted"
    try:
        found: Any = optimize.minimize(
            value,
            last,
            jac=lambda w: slopes(w)[0],
            bounds=np.stack([problem.low / scale, problem.high / scale], axis=1),
            constraints=kinds,
            callback=after,
            options={"maxiter": limit, "ftol": tol},
            method="SLSQP",
        )
        last, success, message = found.x, bool(found.success), str(found.message).lower()
    except StopIteration:
        message = _MESSAGES[_STOPPED]
    except KeyboardInterrupt:
        interrupted = True
    here = at(last)
    return Answer(here.z, *_multipliers(problem, here), success, message, interrupted)


def _multipliers(problem: Problem, here: Evaluated) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers of the rows and bounds at a minimum, by least squares over all that are active."""
    near = 1e-6
    jacobian = problem.jacobian(here).toarray() * problem.scale
    gradient, jacobian = jacobian[0], jacobian[1:]
    w, rows = here.z / problem.scale, here.rows[1:]
    active = (rows <= problem.row_low + near) | (rows >= problem.row_high - near)
    held = (w <= problem.low / problem.scale + near) | (w >= problem.high / problem.scale - near)
    multipliers = np.zeros(rows.size)
    multipliers[active] = np.linalg.lstsq(jacobian[active][:, ~held].T, -gradient[~held], rcond=None)[0]
    rest = gradient + jacobian.T @ multipliers
    return multipliers, np.where(held, -rest, 0.0) / problem.scale
