"""Results of `identify`: estimates, how certain they are, and what follows from them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..._printed import Printed
from ..._types import State
from ...simulate.arguments import DEFAULT_RTOL
from ...system import AbstractSystem
from ...system.quantities import component_names
from . import verdict
from .covariance import combinations, covariance
from .density import LogDensity, logdensity
from .fit import Fit
from .prediction import HeldOut, Prediction, held_out, predict
from .problem import Problem
from .profile import Profile, profile
from .report import write_report
from .residuals import Outlier, outliers, series

_NO_FIT = "These estimates are not to be trusted"
_UNDETERMINED = "undetermined"


@dataclasses.dataclass(frozen=True, repr=False)
class Identification(Printed):
    """The result of `identify`; `print` shows a table.

    ```python
    print(fit)  # A table of estimates and their standard deviations, for `fit` from `identify`.
    fit.parameters["bar.inertia"], fit.deviations["bar.inertia"], fit.converged
    motion = jaxmb.simulate(fit.system, fit.state, t1=1.0)
    ```

    **Fields:**

    - `parameters`: estimates by name; `start`: where they started from.
    - `converged`: whether the iteration converged and nothing speaks against its end; otherwise `warnings` say what
        does, and what helps. `message`: the same in one sentence, which starts with "converged" only if it did.
    - `deviations`: standard deviations by name, of the same shapes, from the residuals' Jacobian at the solution.
        Without `sigma` the noise is estimated from the residuals; with a robust loss as well: they are then those of
        Huber's M-estimate, which hold whatever the distribution of the noise. Infinite for parameters that the data do
        not determine. NaN where they mean nothing: if the iteration did not converge or the residuals are no noise of
        the size of `sigma`, for an estimate at an end of its range, and where the noise is to be estimated from no more
        residuals than there are parameters.
    - `covariance`: of all components, in the order of `components`, the names of all scalar components; of the problem
        that is linearised at the solution, also where that means nothing.
    - `undetermined`: names of components that can change, alone or together, without changing the residuals;
        `combinations`: the changes, relative to the estimates, that do so together.
    - `residuals`: of the data at the solution, predicted minus measured, in units of the noise (of the range of the
        readings where it is not known); `rms`: their root mean square; `outliers`: those beyond five standard
        deviations of the noise, each an `Outlier`.
    - `iterations`: how many trials were simulated.
    - `system`, `state`: with the estimated parameters, ready for `simulate`; of the first experiment.
    - `systems`, `states`: the same by experiment.
    - `objectives`: of every start, the smallest first: minus the logarithm of likelihood and prior.
    - `continuity`: the largest gap between segments, of multiple shooting.
    - `reasons`: in a few words, why components have no standard deviation, by their names.
    """

    parameters: dict[str, np.ndarray]
    start: dict[str, np.ndarray]
    deviations: dict[str, np.ndarray]
    covariance: np.ndarray
    components: tuple[str, ...]
    undetermined: tuple[str, ...]
    combinations: tuple[dict[str, float], ...]
    residuals: np.ndarray
    outliers: tuple[Outlier, ...]
    iterations: int
    converged: bool
    warnings: tuple[str, ...]
    message: str
    system: AbstractSystem
    state: State
    systems: dict[str, AbstractSystem]
    states: dict[str, State]
    objectives: tuple[float, ...]
    continuity: float
    reasons: dict[str, str] = dataclasses.field(repr=False)
    fit: Fit = dataclasses.field(repr=False)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return self.fit.rms

    @property
    def held_out(self) -> dict[str, HeldOut]:
        """How well the experiments that were held out are predicted, by their names."""
        return held_out(self.fit)

    def profile(self, component: str, *, level: float = 0.95, values: ArrayLike | None = None) -> Profile:
        """The profile likelihood of one component: all others are fitted anew to each of its values.

        **Arguments:** `component`: one of `components`, but of no matrix; `level` of the interval; `values`: default
        steps of half a standard deviation from the estimate, until they are beyond the ends of the interval.

        **Returns:** a `Profile`. Without known noise levels, the ratios are those of the likelihood with the noise
        level that is most likely for each value. With a robust loss they are those of the objective, divided by the
        ratio of the mean square of its slopes to its mean curvature, which has a χ² distribution.

        **Raises:** `ValueError` for an unknown component, a level that is not between 0 and 1, values out of bounds,
        and after multiple shooting.
        """
        return profile(self.fit, component, level=level, values=values)

    def predict(
        self,
        quantities: str | Sequence[str],
        *,
        ts: ArrayLike | None = None,
        experiment: str | None = None,
        level: float = 0.95,
    ) -> Prediction:
        """Quantities of one experiment's motion, with bands from the covariance of the estimates.

        If the fit did not converge, or does not explain its data, there are no bands: they are NaN.

        **Arguments:** `quantities`: names, as `Trajectory.quantity` takes them; `ts`: times [s], default those of the
        data; `experiment`: its name, default the first; `level`: probability within the band, 0.95 for 95 %.

        **Raises:** `ValueError` for unknown names, wrong times, a level that is not between 0 and 1, and after multiple
        shooting.
        """
        return predict(self.fit, quantities, ts=ts, experiment=experiment, level=level)

    def logdensity(self) -> LogDensity:
        """The posterior density as a function of an unconstrained vector, for samplers.

        With a robust loss the likelihood is the exponential of minus that loss, of noise with long tails.

        **Raises:** `ValueError` if the noise level of a sensor is neither known nor free, and after multiple shooting.
        """
        return logdensity(self.fit)

    def report(self, path: str | Path, *, profiles: Sequence[str] = ()) -> Path:
        """Write one HTML page: the verdict, the table, each sensor's fit and residuals, correlations and profiles.

        Residuals beyond five standard deviations of the noise are marked and listed.

        **Arguments:** `path`: a file that ends in `.html`, or a folder; `profiles`: components whose profile likelihood
        is computed and shown.

        **Returns:** the path of the page.

        **Raises:** `ValueError` as `profile`; `ImportError` without Matplotlib.
        """
        return write_report(
            self.fit,
            path,
            verdict=self._verdict,
            start=_flat(self.start),
            deviations=self._deviations,
            combinations=self.combinations,
            outliers=self.outliers,
            profiles=profiles,
        )

    @property
    def _verdict(self) -> tuple[str, ...]:
        """The message in one line, or a headline and a line for each warning."""
        return (_NO_FIT + ":", *self.warnings) if self.warnings else (self.message,)

    @property
    def _deviations(self) -> tuple[str, ...]:
        """The standard deviations of the components, or why there are none."""
        return tuple(
            self.reasons.get(name, f"{value:.2g}")
            for name, value in zip(self.components, _flat(self.deviations), strict=True)
        )

    def __repr__(self) -> str:
        return f"Identification of {', '.join(self.parameters)}: {self.message}"

    def __str__(self) -> str:
        headline, *reasons = self._verdict
        columns = (_flat(self.start), _flat(self.parameters), self._deviations)
        width = max(len("parameter"), *(len(name) for name in self.components))
        lines = [headline, *(f"- {reason}" for reason in reasons)]
        lines.append(f"{'parameter':{width}}  {'start':>12}  {'estimate':>12}  {'deviation':>12}")
        for name, start, value, deviation in zip(self.components, *columns, strict=True):
            lines.append(f"{name:{width}}  {start:12.6g}  {value:12.6g}  {deviation:>12}")
        lines.append(f"{self.fit.size_of_residuals}, {self.iterations} iterations")
        return "\n".join(lines)


def identification(
    problem: Problem,
    z: Array,
    *,
    ends: Sequence[tuple[float, Array]],
    data: np.ndarray,
    jacobian: np.ndarray,
    along: np.ndarray | None = None,
    objective: float,
    readings: dict[str, dict[str, Any]],
    known_noise: bool,
    iterations: int,
    success: bool,
    tol: float,
    max_iterations: int,
    segments: int = 1,
    continuity: float = 0.0,
) -> Identification:
    """The result at the end of an iteration.

    **Arguments:** `ends`: objective and unknowns of every start, the best first; `data`: residuals of the data;
    `jacobian`: of all rows, along the directions in which the unknowns may change, which are the columns of `along`
    (the components of z where it is None).
    """
    free = problem.free
    values = {name: np.asarray(value) for name, value in free(z).items()}
    components = tuple(component for name, value in values.items() for component in component_names(name, value.shape))
    by_directions = np.asarray(jax.jacfwd(free.flat)(z))
    if along is not None:
        by_directions = by_directions @ along
    squares, slope = None if known_noise else float(np.sum(data**2)), 1.0
    if problem.loss.robust:
        pull, slopes = problem.loss.influence(data)
        squares, slope = float(np.sum(pull**2)), float(np.mean(slopes))
    found = covariance(jacobian, by_directions, squares, data.size, slope, problem.rtol)
    dispersion = found.noise**2 * slope if problem.loss.robust else 1.0
    own = series(problem, values, readings, known_noise)
    far = outliers(own)
    doubts, reasons, warnings = _judged(
        problem, z, components, ends, segments, found, own, far, known_noise, success, dispersion
    )
    deviations = np.sqrt(np.diag(found.matrix))
    deviations[[name in reasons and reasons[name] != _UNDETERMINED for name in components]] = np.nan
    starts = {name: problem.start(number, z) for number, name in enumerate(problem.names)}
    first = next(iter(starts.values()))
    return Identification(
        parameters=values,
        start={name: np.asarray(value) for name, value in free.start.items()},
        deviations=_unflatten(deviations, values),
        covariance=found.matrix,
        components=components,
        undetermined=tuple(np.array(components)[found.undetermined].tolist()),
        combinations=combinations(components, _flat(values), found),
        residuals=data,
        outliers=far,
        iterations=iterations,
        converged=not warnings,
        warnings=warnings,
        message=_message(warnings, far, problem.loss.robust),
        system=first[0],
        state=first[1],
        systems={name: system for name, (system, _) in starts.items()},
        states={name: state for name, (_, state) in starts.items()},
        objectives=tuple(value for value, _ in ends),
        continuity=continuity,
        reasons=reasons,
        fit=Fit(
            problem=problem,
            z=jnp.asarray(z),
            values=values,
            components=components,
            objective=objective,
            residuals=data,
            series=own,
            jacobian=jacobian,
            covariance=found,
            readings=readings,
            known_noise=known_noise,
            success=success,
            doubts=doubts,
            dispersion=dispersion,
            segments=segments,
            tol=tol,
            max_iterations=max_iterations,
        ),
    )


def _judged(problem, z, components, ends, segments, found, own, far, known_noise, success, dispersion):
    """What speaks against the estimates as a whole; why components have no deviation; and all warnings in words."""
    finite = np.isfinite(ends[0][0])
    directions = found.root.shape[1]
    doubts = [] if success else ["the iteration did not converge; try another start, or more iterations"]
    if finite:
        tried = verdict.Tried(len(ends), segments)
        doubts += verdict.of_residuals(own, far, directions, problem.loss, tried)
    reasons, warnings = {}, list(doubts)
    deviations = np.sqrt(np.diag(found.matrix))
    if np.any(np.isnan(deviations)):
        reasons |= dict.fromkeys(components, "too few data")
    undetermined = np.array(components)[found.undetermined].tolist()
    if undetermined:
        warnings.append(
            f"the data do not determine {', '.join(undetermined)} separately (`combinations` says which changes leave "
            "the residuals as they are): free fewer of them, or measure more"
            + (f", or simulate with a smaller rtol than {problem.rtol:g}" if problem.rtol > DEFAULT_RTOL else "")
        )
        reasons |= dict.fromkeys(undetermined, _UNDETERMINED)
    at_end = problem.free.at_end(z, deviations)
    values, starts = _flat(problem.free(z)), _flat(problem.free.start)
    each = zip(components, at_end, values, starts, problem.free.ends(), strict=True)
    for name, reached, value, start, bounds in each:
        if reached:
            cure = "restrict it to plausible values (bounds=)"
            if bounds is not None:
                cure = "it is held by bounds=({:.6g}, {:.6g}): widen them".format(*bounds)
            warnings.append(
                f"{name} = {value:.3g} is at an end of its range, from a start at {start:.3g}: {cure}, try other "
                "starts (starts=), or leave it out of free if its effect is nothing"
            )
            reasons[name] = "at its end"
    if finite and len(ends) > 1:
        others = [(value, _flat(problem.free(point))) for value, point in ends if np.isfinite(value)]
        count = None if known_noise else sum(part.residuals.size for part in own)
        # Noise that the residuals show is at least what matters, or rounding would tell two ends apart.
        least = max(part.small for part in own) / found.noise if found.noise > 0 else np.inf
        if known_noise and not problem.loss.robust:
            least = 1.0
        warnings += verdict.of_starts(
            others, components, deviations * max(1.0, least), count, dispersion * max(1.0, least) ** 2
        )
    if doubts:
        reasons = dict.fromkeys(components, "no fit" if success else "not converged")
    return tuple(doubts), reasons, tuple(warnings)


def _message(warnings: Sequence[str], far: Sequence[Outlier], robust: bool) -> str:
    if warnings:
        return f"{_NO_FIT}: {'; '.join(warnings)}"
    if not far:
        return "converged"
    cure = "" if robust else "; if these are errors of measurement, loss='soft_l1' or 'huber' lets them weigh less"
    return f"converged, with residuals beyond 5 σ (`outliers`), {len(far)} in number{cure}"


def _flat(values: Mapping[str, Any]) -> np.ndarray:
    return np.concatenate([np.ravel(value) for value in values.values()])


def _unflatten(flat: np.ndarray, like: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    out, position = {}, 0
    for name, value in like.items():
        out[name] = flat[position : position + value.size].reshape(value.shape)
        position += value.size
    return out
