"""The end of an identification, for the studies that go on from it."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Array

from .covariance import Covariance
from .problem import Problem
from .residuals import Series


@dataclasses.dataclass(frozen=True)
class Fit:
    """The problem, the point where the iteration ended, and what is known of it there.

    **Fields:** `z`: the vector of the unknowns, and `values` by name; `components`: the names of all scalar components
    of these; `objective`: minus the logarithm of likelihood and prior; `residuals` of the data, in units of the noise;
    `series`: the same in order of time, by sensor; `jacobian` of all rows, and `readings`: the predicted ones by
    experiment and sensor; `known_noise`: whether the noise level of every reading is known, or an unknown of its own;
    `success`: whether the iteration converged; `doubts`: what speaks against the estimates as a whole; `dispersion`:
    the factor of twice a difference of the objective over a χ² variable; `segments`: of multiple shooting.
    """

    problem: Problem
    z: Array
    values: dict[str, np.ndarray]
    components: tuple[str, ...]
    objective: float
    residuals: np.ndarray
    series: tuple[Series, ...]
    jacobian: np.ndarray
    covariance: Covariance
    readings: dict[str, dict[str, Any]]
    known_noise: bool
    success: bool
    doubts: tuple[str, ...]
    dispersion: float
    segments: int
    tol: float
    max_iterations: int

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def size_of_residuals(self) -> str:
        """The number of residuals and their root mean square with its unit, in words."""
        unit = "" if self.known_noise else " of the range"
        return f"{self.residuals.size} residuals, rms {self.rms:.3g}{unit}"

    def whole_motions(self, what: str) -> None:
        """Raise a `ValueError` for what needs simulations from start to end, after multiple shooting."""
        if self.segments > 1:
            raise ValueError(
                f"{what} simulates whole motions; identify again with segments=1, from the estimates as starts."
            )
