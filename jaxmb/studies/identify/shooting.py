"""Multiple shooting on the constraint manifold: long motions that are chaotic or unstable, in short segments.

The states at the starts of segments are unknowns, each in the independent coordinates of a chart there (see
`jaxmb.manifold.Chart`). Equality constraints `c = 0` join the start of each segment to the end of the previous segment.
Each step solves

    minimise ½ |r + J s|² + ½ μ |D s|²  subject to  c + C s = 0

by orthogonal factorisation of C, which avoids the growth of a recursion over the segments. Charts are then moved to the
new states.

Source: H. G. Bock, "Recent Advances in Parameter Identification Techniques for O.D.E.", in: Numerical Treatment of
Inverse Problems in Differential and Integral Equations, Birkhäuser 1983.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from ..minimise import Linearised, levenberg_marquardt, null_basis
from .problem import Problem, level_mask, with_likely_levels
from .segments import Place, evaluated, first_place, moved, segmented

# Largest number of trials in which each segment fits its own data, before all are joined, and their tolerance.
_ALONE, _COARSE = 13, 1e-3


class Shot(NamedTuple):
    """The end of multiple shooting.

    **Fields:** as in `Fit`: `jacobian` along the directions that keep the motion continuous, `along` with the changes
    of z along them, and `continuity`, the largest gap.
    """

    z: Array
    residuals: np.ndarray
    jacobian: np.ndarray
    along: np.ndarray
    objective: float
    readings: dict[str, dict[str, np.ndarray]]
    continuity: float
    iterations: int
    success: bool


def shoot(problem: Problem, z: Float[Array, "n"], segments: int, tol: float, limit: int) -> Shot:
    """Fit all experiments in segments.

    **Arguments:** `segments` of each experiment; `tol`: change of unknowns and objective at which to stop; `limit`:
    largest number of steps.

    **Raises:** `ValueError` for sensors with a delay, residual functions, more segments than samples, and if the
    simulations with the starting values fail.
    """
    lanes = tuple(
        segmented(problem.names[number], number, trial, segments)
        for number, trial in enumerate(problem.trials)
        if problem.fitted[number]
    )
    evaluate = functools.partial(evaluated, problem, lanes)
    move = functools.partial(moved, problem, lanes)
    place = _each_to_its_data(evaluate, move, first_place(problem, lanes, z))
    if level_mask(problem).any():
        place = place._replace(z=with_likely_levels(problem, place.z, evaluate(place).readings))
    # In a continuous motion, the states follow from the unknowns.
    size = lambda place, step: float(np.max(np.abs(step[: z.size]) / (1 + np.abs(place.z))))
    end = levenberg_marquardt(lambda place: evaluate(place).linearised, place, tol, limit, move=move, size=size)
    model = evaluate(end.z)
    basis = null_basis(model.linearised.closing)[2]
    return Shot(
        z=end.z.z,
        residuals=model.plain.residuals[: model.data],
        jacobian=model.plain.jacobian @ basis,
        along=basis[: z.size],
        objective=end.value,
        readings=model.readings,
        continuity=model.continuity,
        iterations=end.iterations,
        success=end.success,
    )


def _each_to_its_data(evaluate, move, place: Place) -> Place:
    """The states from which each segment alone fits its data, with unchanged parameters.

    These states only start the joint iteration, and are fitted by least squares.
    """

    def alone(place):
        model = evaluate(place)
        return Linearised(model.plain.residuals[: model.data], model.plain.jacobian[: model.data])

    size = lambda _, step: float(np.max(np.abs(step)))
    held = np.arange(place.size) < place.z.size
    end = levenberg_marquardt(alone, place, _COARSE, _ALONE, held, move, size)
    if not np.isfinite(end.value):
        raise ValueError("The simulation of the segments fails with the starting values.")
    return end.z
