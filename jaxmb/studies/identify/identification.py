"""What `identify` returns: estimates, how certain they are, and what follows from them."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..._types import State
from ...system import AbstractSystem
from .covariance import combinations, covariance
from .density import LogDensity, logdensity
from .fit import Fit
from .prediction import HeldOut, Prediction, held_out, predict
from .problem import Problem
from .profile import Profile, profile
from .report import write_report


@dataclasses.dataclass(frozen=True)
class Identification:
    """The result of `identify`; `print` shows a table.

    **Fields:**

    - `parameters`: estimates by name; `start`: where they started from.
    - `deviations`: standard deviations by name, of the same shapes, from the residuals' Jacobian at the solution.
        Without `sigma` the noise is estimated from the residuals. Infinite for parameters that the data do not
        determine, NaN where there are no more residuals than parameters and no `sigma`.
    - `covariance`: of all components, in the order of `components`, the names of all scalar components.
    - `undetermined`: names of components that can change, alone or together, without changing the residuals;
        `combinations`: the changes, relative to the estimates, that do so together.
    - `residuals`: weighted, of the data, at the solution; `rms`: their root mean square.
    - `iterations`; `success`: whether the iteration converged; `message` says how it ended.
    - `system`, `state`: with the estimated parameters, ready for `simulate`; of the first experiment.
    - `systems`, `states`: the same by experiment.
    - `objectives`: of every start, the smallest first: minus the logarithm of likelihood and prior.
    - `continuity`: the largest gap between segments, of multiple shooting.
    """

    parameters: dict[str, np.ndarray]
    start: dict[str, np.ndarray]
    deviations: dict[str, np.ndarray]
    covariance: np.ndarray
    components: tuple[str, ...]
    undetermined: tuple[str, ...]
    combinations: tuple[dict[str, float], ...]
    residuals: np.ndarray
    iterations: int
    success: bool
    message: str
    system: AbstractSystem
    state: State
    systems: dict[str, AbstractSystem]
    states: dict[str, State]
    objectives: tuple[float, ...]
    continuity: float
    fit: Fit = dataclasses.field(repr=False)

    @property
    def rms(self) -> float:
        """Root mean square of the weighted residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def held_out(self) -> dict[str, HeldOut]:
        """How well the experiments that were held out are predicted, by their names."""
        return held_out(self.fit)

    def profile(self, component: str, *, level: float = 0.95, values: ArrayLike | None = None) -> Profile:
        """The profile likelihood of one component: all others are fitted anew to each of its values.

        **Arguments:** `component`: one of `components`, but of no matrix; `level` of the interval; `values`: default
        steps of half a standard deviation from the estimate, until they are beyond the ends of the interval.

        **Returns:** a `Profile`. Without known noise levels, the ratios are those of the likelihood with the noise
        level that is most likely for each value.

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

        **Arguments:** `quantities`: names, as `Trajectory.quantity` takes them; `ts`: times [s], default those of the
        data; `experiment`: its name, default the first; `level`: probability within the band.

        **Raises:** `ValueError` for unknown names, wrong times, and after multiple shooting.
        """
        return predict(self.fit, quantities, ts=ts, experiment=experiment, level=level)

    def logdensity(self, mode: Literal["forward", "reverse"] = "forward") -> LogDensity:
        """The posterior density as a function of an unconstrained vector, for samplers.

        **Arguments:** `mode`: `"forward"`: gradients by forward-mode derivatives of the simulation, offered to
        `jax.grad` as a custom rule, which is faster up to some dozens of unknowns; `"reverse"`: by reverse mode.

        **Raises:** `ValueError` if the noise level of a sensor is neither known nor free, and after multiple shooting.
        """
        return logdensity(self.fit, mode)

    def report(self, path: str | Path, *, profiles: Sequence[str] = ()) -> Path:
        """Write one HTML page: the table, each sensor's fit and residuals, correlations and profiles.

        **Arguments:** `path`: a file that ends in `.html`, or a folder; `profiles`: components whose profile likelihood
        is computed and shown.

        **Returns:** the path of the page.

        **Raises:** `ValueError` as `profile`; `ImportError` without Matplotlib.
        """
        return write_report(
            self.fit,
            path,
            message=self.message,
            start=_flat(self.start),
            deviations=_flat(self.deviations),
            combinations=self.combinations,
            profiles=profiles,
        )

    def __str__(self) -> str:
        columns = (_flat(self.start), _flat(self.parameters), _flat(self.deviations))
        width = max(len("parameter"), *(len(name) for name in self.components))
        lines = [f"{'parameter':{width}}  {'start':>12}  {'estimate':>12}  {'deviation':>10}"]
        for name, start, value, deviation in zip(self.components, *columns, strict=True):
            lines.append(f"{name:{width}}  {start:12.6g}  {value:12.6g}  {deviation:10.2g}")
        count = f"{self.residuals.size} residuals, rms {self.rms:.3g}, {self.iterations} iterations"
        return "\n".join([*lines, f"{count}: {self.message}"])


def identification(
    problem: Problem,
    z: Array,
    *,
    data: np.ndarray,
    jacobian: np.ndarray,
    along: np.ndarray | None = None,
    objective: float,
    readings: dict[str, dict[str, Any]],
    known_noise: bool,
    iterations: int,
    success: bool,
    objectives: tuple[float, ...],
    tol: float,
    max_iterations: int,
    segments: int = 1,
    continuity: float = 0.0,
) -> Identification:
    """The result at the end of an iteration.

    **Arguments:** `data`: weighted residuals of the data; `jacobian`: of all rows, along the directions in which the
    unknowns may change, which are the columns of `along` (the components of z where it is None).
    """
    free = problem.free
    values = {name: np.asarray(value) for name, value in free(z).items()}
    components = tuple(component for name, value in values.items() for component in _components(name, value.shape))
    ahead = np.asarray(jax.jacfwd(free.flat)(z))
    ahead = ahead if along is None else ahead @ along
    found = covariance(jacobian, ahead, None if known_noise else float(np.sum(data**2)), data.size)
    undetermined = tuple(np.array(components)[found.undetermined].tolist())
    message = "converged" if success else "the iteration did not converge; try another start, or more iterations"
    if undetermined:
        message += f"; the data do not determine {', '.join(undetermined)} separately"
    starts = {name: problem.start(number, z) for number, name in enumerate(problem.names)}
    first = next(iter(starts.values()))
    return Identification(
        parameters=values,
        start={name: np.asarray(r.start) for name, r in zip(free.names, free.ranges, strict=True)},
        deviations=_unflatten(np.sqrt(np.diag(found.matrix)), values),
        covariance=found.matrix,
        components=components,
        undetermined=undetermined,
        combinations=combinations(components, _flat(values), found),
        residuals=data,
        iterations=iterations,
        success=success,
        message=message,
        system=first[0],
        state=first[1],
        systems={name: system for name, (system, _) in starts.items()},
        states={name: state for name, (_, state) in starts.items()},
        objectives=objectives,
        continuity=continuity,
        fit=Fit(
            problem=problem,
            z=jnp.asarray(z),
            values=values,
            components=components,
            objective=objective,
            residuals=data,
            jacobian=jacobian,
            covariance=found,
            readings=readings,
            known_noise=known_noise,
            success=success,
            segments=segments,
            tol=tol,
            max_iterations=max_iterations,
        ),
    )


def _components(name: str, shape: tuple[int, ...]) -> list[str]:
    return [name + (f"[{', '.join(map(str, index))}]" if index else "") for index in np.ndindex(shape)]


def _flat(values: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([np.ravel(value) for value in values.values()])


def _unflatten(flat: np.ndarray, like: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    out, position = {}, 0
    for name, value in like.items():
        out[name] = flat[position : position + value.size].reshape(value.shape)
        position += value.size
    return out
