"""From a guess to an optimum: rounds of minimisation, each in charts and with steps that suit the last."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..._types import State
from ...system import AbstractSystem
from ..constraint_branches import APART, distance
from .guess import Guess
from .lanes import MOST_STEPS
from .problem import Evaluated
from .solvers import Answer, chosen_method, minimise
from .task import Task
from .transcription import Program, Transcription, full_turns

# The most rounds; charts beyond this quality are replaced.
_ROUNDS, _WORN = 40, 3.0
# The smallest error of an interval's end that is asked for.
_LEAST_ERROR = 1e-10
# The error of an interval's end, relative to typical changes, that is small enough for a guess.
_FIRST_ERROR = 1e-3
# The factor by which a round may have more steps than the last: far from a motion, errors are no measure.
_FURTHER = 4
# The effect of a control, relative to the largest of any, that is none.
_NO_EFFECT = 1e-13
_JUMP = (
    "at t = {:.4g} s the motion would jump from one branch of the constraints to another; take more intervals, or a "
    "guess= nearer to a motion"
)
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
    """A phase at the end of the rounds: its last `transcription`, the method's `answer` in it, the `found` states and
    controls, the log, and the largest error of an interval's end, relative to typical changes; whether it is the only
    phase.
    """

    transcription: Transcription
    answer: Answer
    found: Guess
    iterations: tuple[Iteration, ...]
    error: float
    alone: bool


def solved(
    tasks: Sequence[Task],
    guesses: Sequence[Guess],
    method: str | None,
    limit: int,
    tol: float,
    told: Callable[[Iteration], None],
) -> list[Solution]:
    """The optimum near a guess, of each phase.

    **Raises:** `ValueError` if a segment fails with the guess, or if conditions depend on each other.
    """
    begin, steps, scales, answer = time.perf_counter(), [1] * len(tasks), None, None
    log: list[Iteration] = []
    for rounds_left in reversed(range(_ROUNDS)):
        program = Program.of(tasks, guesses, steps, scales)
        if scales is None:
            # A guess is no motion: its errors need not be small yet.
            steps, _ = _enough_steps(program, program.start, steps, _FIRST_ERROR, [MOST_STEPS] * len(tasks))
            program.problem.at(program.start)
            _check_start(program)
            for part in program.parts:
                _check_ends(part)
            each = zip(program.parts, program.intervals(), strict=True)
            scales = [_control_scales(part, at) for part, at in each]
            program = Program.of(tasks, guesses, steps, scales)

        def watched(objective: float, violation: float, program: Program = program) -> bool:
            log.append(Iteration(len(log) + 1, objective, violation, time.perf_counter() - begin))
            told(log[-1])
            return program.quality() <= _WORN or len(log) == 1

        problem, left = program.problem, max(limit - len(log), 1)
        chosen = chosen_method(method, problem.scale.size)
        answer = minimise(problem, program.start, answer, chosen, left, tol, watched)
        problem.at(answer.z)
        worn, before = program.quality(), steps
        each = zip(program.parts, program.variables(answer.z), program.intervals(), strict=True)
        found = [_reached(part.read(z), at) for part, z, at in each]
        apart, moved = _rejoined(program, found) if answer.success else ("", False)
        steps, errors = _enough_steps(program, answer.z, steps, tol, [_FURTHER * count for count in steps])
        lost = not all(np.all(np.isfinite(x)) for guess in found for x in (guess.states.q, guess.states.u))
        guesses = guesses if lost else found
        is_last = answer.interrupted or len(log) >= limit or lost or not rounds_left
        if is_last or (steps == before and worn <= _WORN and not moved):
            answer = answer._replace(success=False, message=apart) if apart else answer
            return _each_phase(program, answer, guesses, tuple(log), errors)
    raise AssertionError("unreachable")


def _reached(found: Guess, at: Evaluated) -> Guess:
    """The states at nodes; the last, which may have left its chart since no interval begins there, is then the arrival
    of the last interval.
    """
    states = found.states
    if np.all(np.isfinite(states.q[-1])) and np.all(np.isfinite(states.u[-1])):
        return found
    return found._replace(states=_replaced(states, -1, _arrivals(states, at)[-1]))


def _arrivals(states: State, at: Evaluated) -> np.ndarray:
    """Coordinates, velocities and further states at the ends of intervals, side by side."""
    return at.outputs[0][:, : states.q.shape[1] + states.u.shape[1] + (0 if states.z is None else states.z.shape[1])]


def _replaced(states: State, node: int, values: np.ndarray) -> State:
    each: list[Any] = [np.array(x) for x in (states.q, states.u, states.z) if x is not None]
    for own, new in zip(each, np.split(values, np.cumsum([x.shape[1] for x in each])[:-1]), strict=True):
        own[node] = new
    return State(*each, angles=states.angles)


def _rejoined(program: Program, found: list[Guess]) -> tuple[str, bool]:
    """Where intervals meet in the coordinates of a chart and yet on different branches of the constraints, the node
    moves to the arrival of the interval before it, in `found`, unless its state is given.

    **Returns:** the first such place in words, and whether nodes moved.
    """
    jumps, moved, before = [], False, None
    for phase, (part, at) in enumerate(zip(program.parts, program.intervals(), strict=True)):
        task, (states, ts, *_) = part.task, found[phase]
        system, arrivals = task.system, _arrivals(states, at)
        # Jumps between phases with the same coordinates are told by the coordinate.
        same = before is not None and before[0].coordinate_names() == system.coordinate_names()
        if before is not None and not same and _are_apart(*before, system, states.q[0]):
            jumps.append(ts[0])
        for k in range(1, task.intervals + 1):
            if distance(system, arrivals[k - 1, : system.nq], states.q[k]) > APART:
                jumps.append(ts[k])
                if k < task.intervals or not isinstance(task.end, State):
                    states, moved = _replaced(states, k, arrivals[k - 1]), True
        found[phase] = found[phase]._replace(states=states)
        if task.periodic and distance(system, states.q[-1] - full_turns(system, states), states.q[0]) > APART:
            jumps.append(ts[-1])
        before = system, states.q[-1]
    return (_JUMP.format(jumps[0]) if jumps else ""), moved


def _are_apart(system: AbstractSystem, q: Any, other_system: AbstractSystem, other: Any) -> bool:
    """Whether the coordinates that two systems share by name are on different branches."""
    places, others = system.coordinate_names(), other_system.coordinate_names()
    shared = np.array(other)
    for name in places.keys() & others.keys():
        shared[others[name]] = np.asarray(q)[places[name]]
    return distance(other_system, shared, other) > APART


def _each_phase(program, answer, guesses, log, errors):
    zs, of_bounds = program.variables(answer.z), program.variables(answer.of_bounds)
    multipliers, alone = program.rows(answer.multipliers), len(guesses) == 1
    return [
        Solution(part, answer._replace(z=z, multipliers=own, of_bounds=bounds), guess, log, error, alone)
        for part, z, own, bounds, guess, error in zip(
            program.parts, zs, multipliers, of_bounds, guesses, errors, strict=True
        )
    ]


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
    program: Program, z: np.ndarray, steps: Sequence[int], tol: float, most: Sequence[int]
) -> tuple[list[int], list[float]]:
    """The numbers of steps in an interval that make the errors of its end small, and the largest errors then, relative
    to typical changes, by comparison with twice as many; `most` at most. One of each for each phase.
    """
    each = zip(program.parts, program.variables(z), steps, most, strict=True)
    pairs = [_enough(part, own, count, limit, tol) for part, own, count, limit in each]
    return [count for count, _ in pairs], [error for _, error in pairs]


def _enough(part: Transcription, z: np.ndarray, steps: int, most: int, tol: float) -> tuple[int, float]:
    term, nodes = part.problem.terms[0], part.nodes
    inputs, indices = term.at(z), nodes.charts[1][1:]
    coarse, error = term.block.linearised(inputs, steps)[0], np.inf
    while steps <= most:
        fine = term.block.linearised(inputs, 2 * steps)[0]
        differences = np.take_along_axis(fine - coarse, indices, 1) / nodes.scales[1:]
        error = float(np.max(np.abs(differences))) if np.all(np.isfinite(differences)) else np.inf
        if error <= max(tol, _LEAST_ERROR):
            break
        steps, coarse = 2 * steps, fine
    term.block.steps = min(steps, most)
    return term.block.steps, error


def _check_start(program: Program) -> None:
    last = program.problem.last
    if last is not None and last.finite:
        return
    for part, at in zip(program.parts, program.intervals(), strict=True):
        numbers = np.concatenate([at.outputs[0], at.jacobians[0].reshape(len(at.outputs[0]), -1)], axis=1)
        bad = ~np.all(np.isfinite(numbers), axis=1)
        if bad.any():
            k, ts = int(np.argmax(bad)), part.read(part.start).ts
            raise ValueError(
                f"plan: interval {k}, from t = {ts[k]:.4g} to {ts[k + 1]:.4g} s, cannot be integrated with the guess: "
                "the mechanism locks up on the way, a spring is stiff, or a force is not finite. Take more intervals, "
                "or a guess= nearer to a motion."
            )
    raise ValueError("plan: a bound along the way, an end or the objective is not finite with the guess.")


def _check_ends(part: Transcription) -> None:
    """Refuse equations at an end that depend on each other."""
    problem = part.problem
    for where in ("start", "end"):
        rows = part.rows_of.get(where, np.zeros(0, int))
        equal = rows[problem.row_low[rows - 1] == problem.row_high[rows - 1]]
        if equal.size:
            own = problem.jacobian(problem.at(part.start))[equal].toarray() * problem.scale
            if np.linalg.matrix_rank(own, tol=1e-8) < equal.size:
                names = ", ".join(problem.names[k - 1].partition(" at node")[0] for k in equal)
                raise ValueError(
                    f"plan: the conditions of the {where} depend on each other: {names}. The machine has "
                    f"{part.places.x.shape[1]} independent coordinates and rates there; leave the others out."
                )


def _control_scales(part: Transcription, at: Evaluated) -> list[np.ndarray]:
    """Changes of controls that change the end of their interval as much as typical changes, over all intervals."""
    task, nodes, term = part.task, part.nodes, part.problem.terms[0]
    indices = nodes.charts[1][1:]
    jacobian = np.take_along_axis(at.jacobians[0], indices[:, :, None], 1) / nodes.scales[1:, :, None]
    effect = np.zeros(term.offset.size // task.intervals)
    effect[list(term.block.active)] = np.abs(jacobian).max(axis=(0, 1))
    # Below this only rounding errors are left: a force that a constraint bears has no effect.
    begin, out, least = nodes.coordinates.shape[1] + 2, [], _NO_EFFECT * float(np.max(effect, initial=0.0))
    for control in task.controls:
        own = effect[begin : begin + control.size * control.course.local].reshape(control.course.local, -1)[0]
        begin += control.size * control.course.local
        out.append(np.where(own > least, 1.0 / (np.where(own > least, own, 1.0) * task.intervals), 1.0))
    return out
