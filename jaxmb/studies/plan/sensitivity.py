"""Derivatives of an optimum by parameters of the system: of the objective by the envelope theorem, of controls and
states by the linear system of the optimality conditions.

Source: A. V. Fiacco, "Introduction to Sensitivity and Stability Analysis in Nonlinear Programming", Academic Press,
1983.
"""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import linalg

from ...parts.names import unknown
from ...system import parameters
from .lanes import by_name
from .problem import Problem
from .solve import Solution
from .transcription import Places, Transcription

# A bound is active if its multiplier, for scaled variables and rows, is above this fraction of the largest.
_ACTIVE = 1e-6
DURATION = "duration"


class Sensitivity(NamedTuple):
    """Derivatives of an optimum by one parameter; its axes come last in all arrays.

    **Fields:** of the `objective`; of the `duration` [s]; of the `controls` by name, at the nodes (of held ones, on the
    intervals; of cubic ones values, then rates); of the optimised `parameters` by name.
    """

    objective: np.ndarray
    duration: np.ndarray
    controls: dict[str, np.ndarray]
    parameters: dict[str, np.ndarray]


class _Extended(NamedTuple):
    """An optimum with further parameters as variables, whose places are `extra`."""

    transcription: Transcription
    z: np.ndarray
    extra: np.ndarray

    @property
    def problem(self) -> Problem:
        return self.transcription.problem


def _extended(solution: Solution, names: tuple[str, ...]) -> _Extended:
    transcription, z, found = solution.transcription, solution.answer.z, solution.found
    task, places = transcription.task, transcription.places
    existing, taken = parameters(task.system), (*(c.name for c in task.controls), *(name for name, _ in task.design))
    shapes, values = [], []
    for name in names:
        if name == DURATION and not task.timed:
            continue
        if name not in existing:
            raise unknown("parameter", name, (*existing, DURATION), "plan")
        if name in taken:
            raise ValueError(f"plan: {name!r} is optimised itself; an optimum has no derivative by it.")
        shapes.append((name, existing[name].shape))
        values.append(np.asarray(existing[name], float))
    ends = tuple((value, value) for value in values)
    larger = dataclasses.replace(task, design=(*task.design, *shapes), design_bounds=(*task.design_bounds, *ends))
    if DURATION in names and not task.timed:
        larger = dataclasses.replace(larger, duration=(task.duration[0], np.nextafter(task.duration[0], np.inf)))
    flat = np.concatenate([found.design, *(np.ravel(value) for value in values)])
    block = transcription.problem.terms[0].block
    made = Transcription.of(larger, found._replace(design=flat), block.steps, transcription.scales, transcription.nodes)
    whole = np.zeros(made.places.size)
    for a, b in zip(_each(made.places), _each(places), strict=True):
        whole[a[: len(b)]] = z[b]
    kept = made.places.design[places.design.size :]
    whole[kept] = flat[places.design.size :]
    if DURATION in names and not task.timed:
        whole[made.places.times] = task.duration[0]
        kept = np.concatenate([kept, made.places.times])
    return _Extended(made, whole, kept)


def _each(places: Places) -> list[Any]:
    return [places.x, places.times, *places.controls, places.design]


def derivatives(solution: Solution, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The derivatives of the objective by named parameters, at the optimum: those of the Lagrangian."""
    extended, multipliers = _extended(solution, names), solution.answer.multipliers
    return _by_name(solution, names, _gradient(extended, np.append(1.0, multipliers)))


def _gradient(extended, weights):
    jacobian = extended.problem.jacobian(extended.problem.at(extended.z))
    return (jacobian.T @ weights)[extended.extra]


def _by_name(solution, names, values):
    """Rows of derivatives by parameter, the last axis of `values`, in the parameters' shapes."""
    existing, out, begin = parameters(solution.transcription.task.system), {}, 0
    for name in (*(n for n in names if n != DURATION), *(n for n in names if n == DURATION)):
        shape = () if name == DURATION else existing[name].shape
        size = int(np.prod(shape, dtype=int))
        out[name] = values[..., begin : begin + size].reshape((*values.shape[:-1], *shape))
        begin += size
    return out


def sensitivities(solution: Solution, names: tuple[str, ...]) -> dict[str, Sensitivity]:
    """The derivatives of the optimum by named parameters, with the active bounds as they are."""
    extended, answer = _extended(solution, names), solution.answer
    problem, places = extended.problem, extended.transcription.places
    at = problem.at(extended.z)
    scale, count = problem.scale, problem.scale.size
    weights = np.append(1.0, answer.multipliers)
    rows, columns = problem.lower_places
    bends = problem.bends(at, weights, central=True) * scale[rows] * scale[columns]
    lower = sparse.csr_array((bends, (rows, columns)), shape=(count, count))
    hessian = sparse.csr_array(lower + lower.T - sparse.diags_array(lower.diagonal()))
    jacobian = sparse.csr_array(problem.jacobian(at) @ sparse.diags_array(scale))
    of_bounds = np.zeros(count)
    for a, b in zip(_each(places), _each(solution.transcription.places), strict=True):
        of_bounds[a[: len(b)]] = answer.of_bounds[b]
    pressed = np.abs(of_bounds * scale)
    largest = max(float(np.max(pressed, initial=0.0)), float(np.max(np.abs(answer.multipliers), initial=0.0)))
    fixed = problem.low == problem.high
    free = np.flatnonzero(~fixed & (pressed <= _ACTIVE * largest))
    free = np.setdiff1d(free, extended.extra)
    equal = problem.row_low == problem.row_high
    active = 1 + np.flatnonzero(equal | (np.abs(answer.multipliers) > _ACTIVE * largest))
    inner, constraints = hessian[free][:, free], jacobian[active][:, free]
    matrix = sparse.block_array([[inner, constraints.T], [constraints, None]], format="csc")
    right = sparse.vstack([hessian[free][:, extended.extra], jacobian[active][:, extended.extra]]).toarray()
    moved = np.zeros((count, extended.extra.size))
    moved[free] = -linalg.splu(matrix).solve(right)[: free.size] * scale[free, None]
    moved[extended.extra] = np.diag(scale[extended.extra])
    moved /= scale[extended.extra]
    return _read(solution, names, extended, moved, weights)


def _read(solution, names, extended, moved, weights):
    task, places = solution.transcription.task, extended.transcription.places
    gradient = _gradient(extended, weights)
    of = lambda values: _by_name(solution, names, values)
    objective = of(gradient)
    controls, whole, growth = [], float(np.ptp(solution.found.ts)), moved[places.times].sum(axis=0)
    for control, where, numbers in zip(task.controls, places.controls, solution.found.controls, strict=True):
        own, first = moved[where], task.intervals + 1
        if control.course.smooth:
            # Rates by the share of the duration become rates by time.
            own[first:] = (own[first:] - numbers[first:, :, None] * growth / whole) / whole
        controls.append(of(own.reshape(len(where), *control.shape, -1)))
    durations = of(growth)
    designs = [of(own) for own in by_name(task.design, moved[places.design]).values()]
    return {
        name: Sensitivity(
            objective[name],
            durations[name],
            {c.name: own[name] for c, own in zip(task.controls, controls, strict=True)},
            {designed: own[name] for (designed, _), own in zip(task.design, designs, strict=True)},
        )
        for name in names
    }
