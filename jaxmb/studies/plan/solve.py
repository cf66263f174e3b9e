"""From a guess to an optimum: rounds of minimisation, each in charts and with steps that suit the last."""

import dataclasses
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .guess import Guess
from .problem import Evaluated
from .solvers import Answer, chosen_method, minimise
from .task import Task
from .transcription import Transcription

# The most rounds; the most steps of an interval; charts beyond this quality are replaced.
_ROUNDS, _MOST_STEPS, _WORN = 40, 256, 3.0
# The factor by which a round may have more steps than the last: far from a motion, errors are no measure.
_FURTHER = 4
# Parts of a control's range: jumps at a node that belong to a switch, and the least sum of them.
_SMALL_JUMP, _SWITCH = 0.02, 0.4


class Iteration(NamedTuple):
    """An iteration of the method: its number, the objective, the largest violation of a condition in its unit, and the
    seconds since the start.
    """

    number: int
    objective: float
    violation: float
    seconds: float


@dataclasses.dataclass(frozen=True)
class Solution:
    """The end of the rounds: the last `transcription`, the method's `answer` in it, the `found` states and controls, the
    log, and the largest error of an interval's end, relative to typical changes.
    """

    transcription: Transcription
    answer: Answer
    found: Guess
    iterations: tuple[Iteration, ...]
    error: float


def solved(
    task: Task, guess: Guess, method: str | None, limit: int, tol: float, told: Callable[[Iteration], None]
) -> Solution:
    """The optimum near a guess.

    **Raises:** `ValueError` if a segment fails with the guess, or if conditions depend on each other.
    """
    begin, steps, scales, answer = time.perf_counter(), 1, None, None
    log: list[Iteration] = []
    for number in range(_ROUNDS):
        transcription = Transcription.of(task, guess, steps, scales)
        steps, _ = _enough_steps(
            transcription, transcription.start, steps, tol, _MOST_STEPS if scales is None else steps
        )
        at = transcription.problem.at(transcription.start)
        if scales is None:
            _check_start(transcription, at)
            _check_ends(transcription, at)
            scales = _control_scales(transcription, at)
            transcription = Transcription.of(task, guess, steps, scales)

        def watched(objective: float, violation: float, transcription=transcription) -> bool:
            log.append(Iteration(len(log) + 1, objective, violation, time.perf_counter() - begin))
            told(log[-1])
            return transcription.quality() <= _WORN or len(log) == 1

        problem, left = transcription.problem, max(limit - len(log), 1)
        chosen = chosen_method(method, problem.scale.size)
        answer = minimise(problem, transcription.start, answer, chosen, left, tol, watched)
        problem.at(answer.z)
        worn, before, last = transcription.quality(), steps, guess
        guess = transcription.read(answer.z)
        steps, error = _enough_steps(transcription, answer.z, steps, tol, _FURTHER * steps)
        lost = not all(np.all(np.isfinite(x)) for x in (guess.states.q, guess.states.u))
        is_last = answer.interrupted or len(log) >= limit or lost or number == _ROUNDS - 1
        if is_last or (steps == before and worn <= _WORN):
            return Solution(transcription, answer, last if lost else guess, tuple(log), error)
    raise AssertionError


def arcs_of(task: Task, found: Guess) -> tuple[int, ...]:
    """The first and the last node, and between them the nodes where a held control switches: its jumps at neighbouring
    nodes add up to a large part of its range.
    """
    switches = set()
    for numbers in found.controls:
        for values in numbers.T:
            jumps = np.diff(values) / max(float(np.ptp(values)), 1e-300)
            cluster: list[int] = []
            for k, jump in enumerate([*jumps, 0.0]):
                if abs(jump) > _SMALL_JUMP and (not cluster or np.sign(jump) == np.sign(jumps[cluster[0]])):
                    cluster.append(k)
                elif cluster:
                    if abs(sum(jumps[cluster])) > _SWITCH:
                        switches.add(1 + max(cluster, key=lambda j: abs(jumps[j])))
                    cluster = [k] if abs(jump) > _SMALL_JUMP else []
    return (0, *sorted(switches), task.intervals)


def _enough_steps(
    transcription: Transcription, z: np.ndarray, steps: int, tol: float, most: int = _MOST_STEPS
) -> tuple[int, float]:
    """The number of steps in an interval that makes the errors of its end small, and the largest error then, relative
    to typical changes, by comparison with twice as many; `most` at most.
    """
    term, nodes = transcription.problem.terms[0], transcription.nodes
    inputs, indices = term.at(z), nodes.charts[1][1:]
    coarse, error = None, np.inf
    while steps <= most:
        fine = term.block.linearised(inputs, 2 * steps)[0]
        coarse = term.block.linearised(inputs, steps)[0] if coarse is None else coarse
        differences = np.take_along_axis(fine - coarse, indices, 1) / nodes.scales[1:]
        error = float(np.max(np.abs(differences))) if np.all(np.isfinite(differences)) else np.inf
        if error <= max(tol, 1e-10):
            break
        steps, coarse = 2 * steps, fine
    term.block.steps = min(steps, most)
    return term.block.steps, error


def _check_start(transcription: Transcription, at: Evaluated) -> None:
    if at.finite:
        return
    bad = [
        not np.all(np.isfinite(np.concatenate([y, jacobian.reshape(-1)])))
        for y, jacobian in zip(at.outputs[0], at.jacobians[0], strict=True)
    ]
    if any(bad):
        k = int(np.argmax(bad))
        ts = transcription.read(transcription.start).ts
        raise ValueError(
            f"plan: interval {k}, from t = {ts[k]:.4g} to {ts[k + 1]:.4g} s, cannot be integrated with the guess: the "
            "mechanism locks up on the way, a spring is stiff, or a force is not finite. Take more intervals, or a "
            "guess= nearer to a motion."
        )
    raise ValueError("plan: a bound along the way, an end or the objective is not finite with the guess.")


def _check_ends(transcription: Transcription, at: Evaluated) -> None:
    """Refuse equations at an end that depend on each other."""
    problem = transcription.problem
    jacobian = None
    for where in ("start", "end"):
        rows = transcription.rows_of.get(where, np.zeros(0, int))
        equal = rows[problem.row_low[rows - 1] == problem.row_high[rows - 1]]
        if equal.size:
            jacobian = problem.jacobian(at) if jacobian is None else jacobian
            own = jacobian[equal].toarray() * problem.scale
            if np.linalg.matrix_rank(own, tol=1e-8) < equal.size:
                names = ", ".join(problem.names[k - 1].partition(" at node")[0] for k in equal)
                raise ValueError(
                    f"plan: the conditions of the {where} depend on each other: {names}. The machine has "
                    f"{transcription.places.x.shape[1]} independent coordinates and rates; leave the others out."
                )


def _control_scales(transcription: Transcription, at: Evaluated) -> list[np.ndarray]:
    """Changes of controls that change the end of their interval as much as typical changes, over all intervals."""
    task, nodes, block = transcription.task, transcription.nodes, transcription.problem.terms[0].block
    indices = nodes.charts[1][1:]
    jacobian = np.take_along_axis(at.jacobians[0], indices[:, :, None], 1) / nodes.scales[1:, :, None]
    effect = np.zeros(transcription.problem.terms[0].inputs.shape[0] // task.intervals)
    effect[list(block.active)] = np.abs(jacobian).max(axis=(0, 1))
    begin, out = nodes.coordinates.shape[1] + 2, []
    for control in task.controls:
        own = effect[begin : begin + control.size * control.course.local].reshape(control.course.local, -1)[0]
        begin += control.size * control.course.local
        out.append(np.where(own > 0, 1.0 / (np.where(own > 0, own, 1.0) * task.intervals), 1.0))
    return out
