"""The end of an identification, from which further studies continue."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from ..._types import State
from ...system import AbstractSystem
from .covariance import Covariance, combinations, covariance
from .problem import Problem
from .residuals import Outlier, Series, outliers, series


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """The problem, the final point of the iteration, and the results there.

    **Fields:** `z`: the vector of the unknowns; `objective`: minus the logarithm of likelihood and prior; `ends`:
    objective and unknowns of every start, the best first; `residuals` of the data, in units of the noise; `jacobian` of
    all rows, along the columns of `along`, the free directions of z (None: the components of z); `readings`:
    predictions by experiment and sensor; `iterations`: the number of trials; `success`: whether the iteration
    converged; `segments` and `continuity` of multiple shooting.
    """

    problem: Problem
    z: Array
    objective: float
    ends: Sequence[tuple[float, Array]]
    residuals: np.ndarray
    jacobian: np.ndarray
    readings: dict[str, dict[str, Any]]
    iterations: int
    success: bool
    tol: float
    max_iterations: int
    along: np.ndarray | None = None
    segments: int = 1
    continuity: float = 0.0

    @functools.cached_property
    def parameters(self) -> dict[str, np.ndarray]:
        """The estimates by name."""
        return {name: np.asarray(value) for name, value in self.problem.free(self.z).items()}

    @property
    def start(self) -> dict[str, np.ndarray]:
        """The starting values of the estimates."""
        return {name: np.asarray(value) for name, value in self.problem.free.start.items()}

    @functools.cached_property
    def components(self) -> tuple[str, ...]:
        """The names of all scalar components of the estimates."""
        return tuple(self.problem.free.components())

    @functools.cached_property
    def uncertainty(self) -> Covariance:
        """The covariance of the components, and the undetermined directions."""
        problem, data = self.problem, self.residuals
        changes = np.asarray(jax.jacfwd(problem.free.flat)(self.z))
        if self.along is not None:
            changes = changes @ self.along
        pull, slopes = problem.loss.influence(data)
        squares = None if problem.known_noise and not problem.loss.robust else float(np.sum(pull**2))
        return covariance(self.jacobian, changes, squares, data.size, float(np.mean(slopes)), problem.rtol)

    @property
    def dispersion(self) -> float:
        """The ratio of twice a difference of the objective to a χ² variable."""
        if not self.problem.loss.robust:
            return 1.0
        return self.uncertainty.noise**2 * float(np.mean(self.problem.loss.influence(self.residuals)[1]))

    @property
    def covariance(self) -> np.ndarray:
        """The covariance of all components."""
        return self.uncertainty.matrix

    @property
    def undetermined(self) -> tuple[str, ...]:
        """The components that can change, alone or together, without changing the residuals."""
        return tuple(np.array(self.components)[self.uncertainty.undetermined].tolist())

    @property
    def combinations(self) -> tuple[dict[str, float], ...]:
        """The joint changes, relative to the estimates, that do not change the residuals."""
        return combinations(self.components, flat(self.parameters), self.uncertainty)

    @functools.cached_property
    def series(self) -> tuple[Series, ...]:
        """The residuals in order of time, by sensor."""
        return series(self.problem, self.parameters, self.readings)

    @functools.cached_property
    def outliers(self) -> tuple[Outlier, ...]:
        """The residuals beyond five standard deviations of the noise."""
        return outliers(self.series)

    @property
    def objectives(self) -> tuple[float, ...]:
        """The objectives of all starts, the smallest first."""
        return tuple(value for value, _ in self.ends)

    @functools.cached_property
    def _started(self) -> dict[str, tuple[AbstractSystem, State]]:
        return {name: self.problem.start(number, self.z) for number, name in enumerate(self.problem.names)}

    @property
    def systems(self) -> dict[str, AbstractSystem]:
        """The systems with the estimated parameters, by experiment."""
        return {name: system for name, (system, _) in self._started.items()}

    @property
    def states(self) -> dict[str, State]:
        """The initial states with the estimated parameters, by experiment."""
        return {name: state for name, (_, state) in self._started.items()}

    @property
    def system(self) -> AbstractSystem:
        """The system of the first experiment."""
        return self.systems[self.problem.names[0]]

    @property
    def state(self) -> State:
        """The initial state of the first experiment."""
        return self.states[self.problem.names[0]]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def size_of_residuals(self) -> str:
        """The number of residuals and their root mean square with its unit, in words."""
        unit = "" if self.problem.known_noise else " of the range"
        return f"{self.residuals.size} residuals, rms {self.rms:.3g}{unit}"

    def whole_motions(self, what: str) -> None:
        """Raise a `ValueError` after multiple shooting, for studies that need simulations from start to end."""
        if self.segments > 1:
            raise ValueError(
                f"{what} simulates whole motions; identify again with segments=1, from the estimates as starts."
            )


def flat(values: Mapping[str, Any]) -> np.ndarray:
    """All values, raveled one after the other."""
    return np.concatenate([np.ravel(value) for value in values.values()])
