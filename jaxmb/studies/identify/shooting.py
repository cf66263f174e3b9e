"""Multiple shooting on the constraint manifold: long motions that are chaotic or unstable, in short segments.

The states at the starts of segments are unknowns, each in independent coordinates: a chart of the constraint manifold
takes w to the state closest to `x + T w`, with T a basis of the tangent space at x. That each segment begins where the
last one ends are equality constraints `c = 0`. Each step solves

    minimise ½ |r + J s|² + ½ μ |D s|²  subject to  c + C s = 0

by orthogonal factorisation of C, which a recursion over the segments would be without its growth. Charts are then moved
to the new states.

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

# Trials of all segments, each for its own data, before they are joined, and their tolerance.
_ALONE, _COARSE = 13, 1e-3


class Shot(NamedTuple):
    """Where multiple shooting ended.

    **Fields:** as of `Fit`: `jacobian` is along the directions that keep the motion continuous, `along` says how z
    changes along them, and `continuity` is the largest gap.
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
    # The states follow from the unknowns where the motion is continuous.
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
        continuity=float(np.max(np.abs(model.linearised.gaps))),
        iterations=end.iterations,
        success=end.success,
    )


def _each_to_its_data(evaluate, move, place: Place) -> Place:
    """The states from which each segment alone fits its data, with the parameters as they are.

    They are only where the joint iteration starts, and weigh all residuals by their squares.
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
