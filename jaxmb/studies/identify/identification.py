"""Results of `identify`: estimates, their uncertainty, and further studies."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import ArrayLike

from ..._arguments import package_for_tables
from ..._pictured import picture
from ..._printed import Printed
from ...bodies.units import named, parameter_unit
from .density import LogDensity, logdensity
from .fit import Fit, flat
from .prediction import HeldOut, Prediction, held_out, predict
from .profile import Profile, profile
from .report import write_report
from .verdict import UNDETERMINED, Verdict, judge

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NO_FIT = "These estimates are not to be trusted"


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Identification(Printed, Fit):
    """The result of `identify`; `print` shows a table.

    ```python
    print(fit)  # A table of estimates and their standard deviations, for `fit` from `identify`.
    fit.parameters["bar.inertia"], fit.deviations["bar.inertia"], fit.converged
    motion = jaxmb.simulate(fit.system, fit.state, t1=1.0)
    fit.plot().savefig("fit.png")
    ```

    **Fields:**

    - `parameters`: estimates by name; `start`: their starting values.
    - `converged`: whether the iteration converged and all tests of the fit passed; otherwise `warnings` give reasons
        and remedies. `message`: the verdict in one sentence, which starts with "converged" only if `converged` is true.
    - `deviations`: standard deviations by name, of the same shapes, from the residuals' Jacobian at the solution.
        Without `sigma`, or with a robust loss, the noise is estimated from the residuals; a robust loss gives the
        deviations of Huber's M-estimate, valid for any distribution of the noise. Deviations are infinite for
        parameters that the data do not determine, and NaN if meaningless: the iteration did not converge; the residuals
        are not noise of the size of `sigma`; the estimate is at an end of its range; or the noise is unknown and there
        are no more residuals than parameters.
    - `covariance` of the problem linearised at the solution, also if meaningless, in the order of `components`, the
        names of all scalar components.
    - `undetermined`: names of components that can change, alone or together, without changing the residuals;
        `combinations`: these joint changes, relative to the estimates.
    - `residuals`: of the data at the solution, predicted minus measured, in units of the noise (of the readings' range
        if it is unknown); `rms`: their root mean square; `outliers`: residuals beyond five standard deviations of the
        noise, each an `Outlier`.
    - `iterations`: the number of simulated trials; halved steps of multiple shooting do not count.
    - `system`, `state`: with the estimated parameters, ready for `simulate`; of the first experiment.
    - `systems`, `states`: of all experiments, by name.
    - `objectives` of all starts, the smallest first: minus the logarithm of likelihood and prior.
    - `continuity`: the largest gap between segments in multiple shooting.
    - `reasons` for missing standard deviations, in a few words, by component.
    """

    @functools.cached_property
    def verdict(self) -> Verdict:
        """The tests' objections to the estimates."""
        return judge(self)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Objections to the estimates, with remedies."""
        return self.verdict.warnings

    @property
    def reasons(self) -> dict[str, str]:
        """Reasons for missing standard deviations, by component."""
        return self.verdict.reasons

    @property
    def converged(self) -> bool:
        """Whether the iteration converged and all tests of the fit passed."""
        return not self.warnings

    @property
    def message(self) -> str:
        """The verdict in one sentence."""
        if self.warnings:
            return f"{_NO_FIT}: {'; '.join(self.warnings)}"
        if not self.outliers:
            return "converged"
        lighter = "; if these are errors of measurement, loss='soft_l1' or 'huber' reduces their weight"
        cure = "" if self.problem.loss.robust else lighter
        return f"converged, with residuals beyond 5 σ (`outliers`), {len(self.outliers)} in number{cure}"

    @property
    def deviations(self) -> dict[str, np.ndarray]:
        """The standard deviations of the estimates."""
        out = self.uncertainty.deviations
        out[[self.reasons.get(name, UNDETERMINED) != UNDETERMINED for name in self.components]] = np.nan
        ends = np.cumsum([value.size for value in self.parameters.values()])
        each = zip(self.parameters.items(), np.split(out, ends[:-1]), strict=True)
        return {name: part.reshape(value.shape) for (name, value), part in each}

    @property
    def held_out(self) -> dict[str, HeldOut]:
        """The quality of prediction of held-out experiments, by name."""
        return held_out(self)

    def profile(self, component: str, *, level: float = 0.95, values: ArrayLike | None = None) -> Profile:
        """The profile likelihood of one component: all others are refitted for each of its values.

        **Arguments:** `component`: one of `components`, not of a matrix; `level` of the interval; `values`: default
        steps of half a standard deviation from the estimate, until beyond the ends of the interval.

        **Returns:** a `Profile`. Without known noise levels, the ratios are likelihood ratios with the most likely
        noise level for each value. With a robust loss, twice the difference of the objective is divided by the mean
        squared slope of the loss over its mean curvature; this quotient is χ² distributed.

        **Raises:** `ValueError` for an unknown component, a level that is not between 0 and 1, values out of bounds,
        and after multiple shooting.
        """
        return profile(self, component, level=level, values=values)

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

        **Arguments:** `quantities`: names for `Trajectory.quantity`; `ts`: times [s], default the data's; `experiment`:
        its name, default the first; `level`: probability within the band, 0.95 for 95 %.

        **Raises:** `ValueError` for unknown names, wrong times, a level that is not between 0 and 1, and after multiple
        shooting.
        """
        return predict(self, quantities, ts=ts, experiment=experiment, level=level, trusted=not self.verdict.doubts)

    def logdensity(self) -> LogDensity:
        """The posterior density as a function of an unconstrained vector, for samplers.

        With a robust loss the likelihood is the exponential of minus the loss, for noise with long tails.

        **Raises:** `ValueError` if the noise level of a sensor is neither known nor free, and after multiple shooting.
        """
        return logdensity(self)

    def plot(self, *sensors: str, level: float | None = 0.95) -> "Figure":
        """Plot the fit of each sensor beside its data, and the residuals.

        The band contains the true value with the probability `level`, as in `predict`; None leaves it out, and so do
        sensors with gain, bias or delay. Grey are residuals up to two standard deviations of the noise, rings mark
        residuals beyond five. Of many sensors, the eight with the largest residuals are shown.

        **Arguments:** `sensors` by name, default all.

        **Returns:** a matplotlib `Figure` with a row for each sensor of each experiment.

        **Raises:** `ValueError` for an unknown sensor and for a residual function; `ImportError` without matplotlib.
        """
        return picture("identification.plot", self, sensors, level)

    def to_pandas(self) -> Any:
        """A `pandas.DataFrame` with a row for each component: `start`, `estimate`, `deviation` and the `reason` for a
        missing deviation.

        **Raises:** `ImportError` without pandas.
        """
        numbers = zip(*map(flat, (self.start, self.parameters, self.deviations)), strict=True)
        rows = [(*of_row, self.reasons.get(name, "")) for name, of_row in zip(self.components, numbers, strict=True)]
        columns = ["start", "estimate", "deviation", "reason"]
        return package_for_tables("pandas", "pandas").DataFrame(rows, index=list(self.components), columns=columns)

    def report(self, path: str | Path, *, profiles: Sequence[str] = ()) -> Path:
        """Write one HTML page: the verdict, the table, each sensor's fit and residuals, correlations and profiles.

        Residuals beyond five standard deviations of the noise are marked and listed.

        **Arguments:** `path`: a file that ends in `.html`, or a folder; `profiles`: components whose profile likelihood
        is computed and shown.

        **Returns:** the path of the page.

        **Raises:** `ValueError` as `profile`; `ImportError` without Matplotlib.
        """
        return write_report(self, path, self._headlines, self._rows, profiles)

    @property
    def _headlines(self) -> tuple[str, ...]:
        """The message in one line, or a headline and a line for each warning."""
        return (_NO_FIT + ":", *self.warnings) if self.warnings else (self.message,)

    @property
    def _rows(self) -> list[tuple[str, str, str, str, str]]:
        """For each component its name, start, estimate, standard deviation or the reason for its absence, and unit."""
        columns = zip(self.components, *map(flat, (self.start, self.parameters, self.deviations)), strict=True)
        return [
            (name, f"{a:.6g}", f"{b:.6g}", self.reasons.get(name, f"{c:.2g}"), self._unit(name))
            for name, a, b, c in columns
        ]

    def _unit(self, name: str) -> str:
        """The unit of a component of a parameter, a start value or a sensor's bias or delay; "" if it is unknown."""
        system, base = self.problem.system, name.split("[")[0].rpartition("/")[2].removeprefix("initial.")
        if base in {**system.coordinate_names(), **system.rate_names()}:
            return named(system, base).unit
        channels = {channel.name: channel for trial in self.problem.trials for channel in trial.channels}
        sensor, _, number = base.rpartition(".")
        if sensor in channels and number in ("bias", "delay"):
            return "s" if number == "delay" else named(system, channels[sensor].quantity).unit
        return parameter_unit(system, base)

    def __repr__(self) -> str:
        return f"Identification of {', '.join(self.parameters)}: {self.message}"

    def __str__(self) -> str:
        headline, *reasons = self._headlines
        width = max(len("parameter"), *map(len, self.components))
        table = [("parameter", "start", "estimate", "deviation", "unit"), *self._rows]
        return "\n".join(
            [
                headline,
                *(f"- {reason}" for reason in reasons),
                *(
                    f"{name:{width}}  {start:>12}  {value:>12}  {deviation:>12}  {unit}".rstrip()
                    for name, start, value, deviation, unit in table
                ),
                f"{self.size_of_residuals}, {self.iterations} iterations",
            ]
        )
