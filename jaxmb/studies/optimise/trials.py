"""The trials of an optimisation: each is evaluated once, and failed trials are marked."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from .evaluation import Limits, Program, linearised

# Largest violation of a satisfied constraint, relative to its size.
HOLDS = 1e-6

# Number of trials in the cache.
_KEPT = 32

# Least relative decrease of violations at which their reduction continues.
_STALLED = 1e-3

# The smallest size of a constraint's side, relative to its output.
_ROUNDED = 1e-7


@dataclasses.dataclass(frozen=True)
class Iteration:
    """One line of the log: the number of the iteration, the objective, the largest violation of a constraint relative
    to its size, the largest change of a parameter relative to its scale, the numbers of trials and of failed trials so
    far, and whether it was `accepted` as the best so far: otherwise it was only tried, on the way of the method.
    """

    number: int
    objective: float
    violation: float
    step: float
    trials: int
    failed: int
    accepted: bool


@dataclasses.dataclass(frozen=True)
class Trial:
    """Values and derivatives at a vector z; not finite if the trial failed.

    **Fields:** `rows`, shape (1 + constraints,), the objective first; `jacobian`; `outputs` by name.
    """

    z: np.ndarray
    rows: np.ndarray
    jacobian: np.ndarray
    outputs: dict[str, np.ndarray]

    @property
    def good(self) -> bool:
        return bool(np.all(np.isfinite(self.rows)) and np.all(np.isfinite(self.jacobian)))


class Trials:
    """Evaluates a program at vectors within the box of its space, with a cache."""

    def __init__(self, program: Program, limits: Limits, start: Trial):
        self.program, self.limits, self.box = program, limits, program.space.box
        self.start = self.good = self.best = start
        self.count = self.failed = 0
        self.scales = constraint_scales(limits, start)
        self.log: list[Iteration] = []
        self._noted = start.z
        self._kept = {np.asarray(start.z, float).tobytes(): start}
        self.record(start.z)

    def __call__(self, z: np.ndarray) -> Trial:
        z = np.clip(np.asarray(z, float), *self.box)
        trial = self._kept.get(z.tobytes())
        # After a failure, a line search begins again with the same points.
        if trial is None:
            trial = evaluate(self.program, z)
            self.count += 1
            self.failed += not trial.good
            self._kept[z.tobytes()] = trial
            if len(self._kept) > _KEPT:
                self._kept.pop(next(iter(self._kept)))
        if trial.good:
            self.good = trial
            self.best = min(self.best, trial, key=self.merit)
        return trial

    def ended(self, z: np.ndarray) -> None:
        """Take the end of a converged run as the best trial, if the present best violates constraints more.

        The present best may owe its objective to a violation within `HOLDS`.
        """
        end = self(z)
        if end.good and self.violation(end) < self.violation(self.best):
            self.best = end

    def violation(self, trial: Trial) -> float:
        """The largest violation of a constraint, relative to its size."""
        return float(np.max(self.limits.excess(trial.rows[1:], self.scales), initial=0.0))

    def merit(self, trial: Trial) -> tuple[float, float]:
        """The order of trials: first feasibility, then the objective."""
        violation = self.violation(trial)
        return (violation if violation > HOLDS else 0.0), float(trial.rows[0])

    def record(self, z: np.ndarray) -> None:
        """Note the end of an iteration."""
        trial = self(z)
        if trial.good:
            step = float(np.max(np.abs(trial.z - self._noted), initial=0.0))
            values = float(trial.rows[0]), self.violation(trial), step
            accepted = self.merit(trial) <= self.merit(self.best)
            self.log.append(Iteration(len(self.log), *values, self.count, self.failed, accepted))
            self._noted = trial.z


def evaluate(program: Program, z: np.ndarray) -> Trial:
    """One trial. An error raised by the program, such as by a simulation that throws, makes it a failed trial. Errors
    of the machine, or of a user's function that the program calls, are raised.
    """
    try:
        rows, jacobian, outputs = linearised(program, jnp.asarray(z, jnp.result_type(float)))
        rows = np.asarray(rows)
    except eqx.EquinoxRuntimeError:
        return Trial(z, np.full(1, np.nan), np.full((1, z.size), np.nan), {})
    return Trial(z, rows, np.asarray(jacobian), {name: np.asarray(value) for name, value in outputs.items()})


def constraint_scales(limits: Limits, start: Trial) -> np.ndarray:
    """Sizes of the lower and the upper side of constraints: the size of each side's bound, so that a far bound does not
    loosen the other side, or the distance of both bounds if smaller.

    A bound of zero has the size of the output's first value or, if larger, of its change when a parameter changes by
    its scale; but at most the size of the other bound. A bound of almost zero has a size far above rounding errors of
    these values.
    """
    or_infinite = lambda size: np.where((size > 0) & np.isfinite(size), size, np.inf)
    of_bounds = or_infinite(np.abs([limits.low, limits.high]))
    first = or_infinite(np.maximum(np.abs(start.rows[1:]), np.max(np.abs(start.jacobian[1:]), axis=1, initial=0.0)))
    size = np.where(np.isfinite(of_bounds), of_bounds, np.minimum(of_bounds[::-1], first))
    size = np.minimum(size, or_infinite(limits.high - limits.low))
    size = np.maximum(size, np.where(np.isfinite(first), _ROUNDED * first, 0.0))
    return np.where(np.isfinite(size), size, 1.0)


def nearer(trials: Trials, here: Trial, aside: float, most: int) -> Trial:
    """A more feasible trial, by least squares of violations within the box. Contradictory linearised constraints do not
    stop the search; nor does a slope of zero, with `aside`.

    **Arguments:** `aside`: the distance of the start from `here`, in a random direction; `most`: largest number of
    trials.
    """
    limits = trials.limits
    step = aside * np.random.default_rng(0).uniform(-1.0, 1.0, here.z.size)
    low, high = trials.box
    start = trials(here.z + np.where((here.z + step < low) | (here.z + step > high), -step, step))
    if not start.good or most < 1:
        return here

    def slopes(z):
        trial = trials(z)
        values = trial.rows[1:]
        weights = (values > limits.high) / trials.scales[1] - (values < limits.low) / trials.scales[0]
        return weights[:, None] * trial.jacobian[1:]

    excess = lambda z: limits.excess(trials(z).rows[1:], trials.scales)
    if excess(start.z).any():
        options: dict[str, Any] = {"jac": slopes, "bounds": trials.box, "ftol": _STALLED, "max_nfev": most}
        result = optimize.least_squares(excess, start.z, **options)
        start = trials(result.x)
    return start
