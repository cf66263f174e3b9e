"""Nonlinear least squares with few unknowns and residuals that are dear: one evaluation and one Jacobian a trial.

Source: J. J. Moré, "The Levenberg–Marquardt algorithm: implementation and theory", Lecture Notes in Mathematics 630,
1978; damping after H. B. Nielsen, IMM-REP-1999-05, Technical University of Denmark.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

Linearise = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

# Damping to start with, and beyond which no step is worth trying.
_DAMPING = 1e-3
_LARGEST_DAMPING = 1e12
# Where a step fails although it would change the residuals by less than this share, they are minimal to the accuracy
# they have.
_NEGLIGIBLE = 1e-3


class LeastSquares(NamedTuple):
    """The end of an iteration: `z`, the number of trials, and whether it converged."""

    z: np.ndarray
    iterations: int
    success: bool


def levenberg_marquardt(linearise: Linearise, z: np.ndarray, *, tol: float, limit: int, cut: float) -> LeastSquares:
    """Minimise `|r(z)|²`.

    **Arguments:** `linearise(z)`: residuals and their Jacobian; infinite residuals are a trial that failed; `tol`: stop
    when a full Gauss–Newton step would change the root mean square of the residuals by less than this, absolute and
    relative; `limit`: largest number of trials; `cut`: singular values below this share of the largest do not count.
    """
    r, J = linearise(z)
    damping, growth, largest = _DAMPING, 2.0, np.zeros(z.size)
    for trial in range(limit):
        rms = np.sqrt(np.mean(r**2))
        full = np.linalg.lstsq(J, -r, rcond=cut)[0]
        gain = np.sqrt(np.mean((J @ full) ** 2))
        if gain <= tol * (1.0 + rms):
            return LeastSquares(z, trial, True)
        largest = np.maximum(largest, np.sum(J**2, axis=0))
        weight = damping * np.where(largest > 0, largest, 1.0)
        stacked = np.concatenate([J, np.diag(np.sqrt(weight))])
        step = np.linalg.lstsq(stacked, -np.concatenate([r, np.zeros(z.size)]), rcond=None)[0]
        r_ahead, J_ahead = linearise(z + step)
        predicted = np.sum((J @ step) ** 2) + 2 * np.sum(weight * step**2)
        ratio = (np.sum(r**2) - np.sum(r_ahead**2)) / predicted
        if ratio > 1e-4:
            z, r, J = z + step, r_ahead, J_ahead
            damping, growth = damping * max(1 / 3, 1 - (2 * min(ratio, 1.0) - 1) ** 3), 2.0
        elif gain <= _NEGLIGIBLE * rms:
            return LeastSquares(z, trial + 1, True)
        else:
            damping, growth = damping * growth, growth * 2
            if damping > _LARGEST_DAMPING:
                return LeastSquares(z, trial + 1, False)
    return LeastSquares(z, limit, False)
