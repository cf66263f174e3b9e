"""A requested motion: checked, solved, and finished."""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import numpy as np
from jax import lax

from .._arguments import check_kind
from .._compat import changed
from .._results import RESULTS
from .._types import State
from ..contacts.impact import NO_SECOND_DERIVATIVES
from ..linalg.arrays import derivatives_of, is_traced
from ..solvers import Adams, Hermite
from ..solvers.evaluation import freeze
from ..solvers.stepping import Carry
from ..states.arguments import check_precision
from ..states.consistency import consistent
from ..states.refusals import lost_rank
from ..system import AbstractSystem
from ..system.inputs import with_inputs
from ..trajectory import CONTINUATION, Trajectory
from .arguments import (
    check_error_estimate,
    check_fixed_steps,
    check_kinds,
    check_steps,
    checked_longest_step,
    checked_state,
    checked_tolerances,
    closer_tolerances,
    named_solver,
)
from .calls import carried_on, in_calls, interruption
from .captured import captured_event
from .compiling import told_of_compiling
from .method import Method
from .outcome import (
    Flags,
    Outcome,
    message_of_failure,
    warn_of_jumps,
    warn_of_parts,
    warn_of_stiffness,
    warn_of_wrong_derivative,
)
from .room import Room, kept_steps, note_long, room_of_calls, rooms_for, was_long
from .saves import STATES, checked_saveat, padded, with_end
from .solve import Problem, made_precise, solved
from .span import Span
from .stops import Stops, breaks_of, checked_jumps, turns_of
from .watch import Watch, parameter_changes

# Defaults, made once: their construction takes as long as the rest of a call.
_ADAMS, _NO_METER = Adams(), diffrax.NoProgressMeter()


class Asked(NamedTuple):
    """The arguments of `simulate`, as given by the user."""

    system: Any
    state: Any
    t1: Any
    t0: Any
    dt0: Any
    saveat: Any
    solver: Any
    formulation: Any
    manifold: Any
    rtol: Any
    atol: Any
    dtmax: Any
    stepsize_controller: Any
    inputs: Any
    jumps: Any
    event: Any
    direction: Any
    error: bool
    max_steps: int
    max_events: int
    throw: bool | None
    progress_meter: Any


# Arguments of another run of the same motion that the user does not see.
_ALONE = {"event": None, "direction": None, "error": False, "throw": False, "progress_meter": None}


# Counts of a run that a further one continues.
_COUNTS = (
    *("num_steps", "num_accepted_steps", "num_rejected_steps", "num_evaluations", "num_matrices", "newton_iterations"),
    *("charts", "orders", "past_points", "stiff_steps"),
)


class Ended(NamedTuple):
    """A run that was solved.

    **Fields:** `flags`: the flags of the `outcome` as numbers, None under a trace; `carry`: what a later run needs that
    goes on from the end, None under a trace.
    """

    problem: Problem
    trajectory: Trajectory
    outcome: Outcome
    flags: Flags | None
    carry: Any = None


@dataclasses.dataclass(frozen=True)
class Run:
    """A motion with checked arguments.

    **Fields:** `asked`: the arguments, with inputs included in the system; the `problem` of the program; the `rooms`
    for steps, tried one after the other.
    """

    asked: Asked
    problem: Problem
    rooms: list[int]

    @classmethod
    def checked(cls, asked: Asked) -> "Run":
        """**Raises:** `ValueError` for arguments of the wrong type or out of range, or that cannot work together."""
        cure = "scene.compile() makes one of a jaxmb.Scene"
        check_kind("system", asked.system, AbstractSystem, "a compiled system", cure)
        check_precision("simulate", asked.system)
        system = asked.system if asked.inputs is None else with_inputs(asked.system, asked.inputs)
        state = checked_state(system, asked.state)
        asked = asked._replace(system=system, state=state, inputs=None)
        # Numbers become arrays, so that other tolerances and times do not compile again.
        rtol, atol = checked_tolerances(asked.rtol, asked.atol, state)
        span = Span.checked(asked.t0, asked.t1, asked.dt0, asked.saveat, state.q.dtype)
        method = _method(asked, rtol, atol)
        restarts = checked_jumps(asked.jumps, breaks_of(system, span.t0, span.t1))
        saves = with_end(checked_saveat(asked.saveat, span.t0, span.t1), span.t0, state)
        first = saves.subs[0]
        if asked.error:
            check_error_estimate(first.steps, asked.stepsize_controller, asked.event, rtol)
        stops = Stops(restarts, None, captured_event(asked.event, span.t0, state), asked.max_events)
        watched = Watch(parameter_changes(system, asked.direction), ())
        meter = _NO_METER if asked.progress_meter is None else asked.progress_meter
        interpolated = asked.event is not None or first.ts is not None
        room = Room(asked.max_steps, None, 0)
        angles = _counted_at_start(asked, first.fn)
        state = State(state.q, state.u, state.z)
        problem = Problem(
            system, state, span, method, saves, interpolated, stops, watched, room, meter, False, True, angles
        )
        return cls(asked, *_settled(problem, asked))

    def solved(self) -> Ended:
        """The motion, repeated with larger buffers if it took more steps than fit."""
        problem, max_steps = self.problem, self.asked.max_steps
        if not problem.traced:
            return self.in_calls()
        if not problem.known:
            return Ended(problem, *solved(problem), None)
        trajectory, outcome = solved(problem)
        for rows in self.rooms[1:]:
            # With a traced value hidden in a function, the number of steps is unknown.
            if is_traced(outcome.flags) or not Flags(*np.asarray(outcome.flags)).ran_out:
                break
            problem = problem._replace(room=problem.room.of(rows, max_steps))
            trajectory, outcome = solved(problem)
        if problem.room.rows < max_steps:
            trajectory = eqx.tree_at(lambda motion: motion.stats["max_steps"], trajectory, np.asarray(max_steps))
        if is_traced(outcome.flags):
            return Ended(problem, trajectory, outcome, None)
        return self._known(problem, trajectory, outcome, Flags(*np.asarray(outcome.flags)))._replace(flags=None)

    def in_calls(self, carry: Carry | None = None) -> Ended:
        """The motion with concrete numbers, from its start or from the `carry` of another.

        **Raises:** `KeyboardInterrupt` with the motion so far, `motion`, after Ctrl-C, unless `throw` is false.
        """
        meter, alone = self.asked.progress_meter, self.problem._replace(progress_meter=_NO_METER)
        with told_of_compiling(alone.system):
            calls = in_calls(alone, self.asked.max_steps, meter, carry)
        stats = calls.trajectory.stats | {"max_steps": np.asarray(self.asked.max_steps)}
        trajectory = changed(calls.trajectory, stats=stats)
        if calls.interrupted:
            trajectory = changed(trajectory, result=RESULTS.interrupted).trimmed()
            if self.asked.throw is not False:
                raise interruption(trajectory, calls.outcome.t)
            return Ended(alone, trajectory, calls.outcome, calls.flags._replace(whole=True))
        return self._known(alone, trajectory, calls.outcome, calls.flags)._replace(carry=calls.carry)

    def _known(self, problem, trajectory, outcome, flags):
        """A solved run whose flags are numbers."""
        if flags.stuck:
            trajectory, outcome = _diagnosed(problem, trajectory, outcome)
        if flags.long:
            note_long(problem.system, problem.method.solver)
        return Ended(problem, trajectory, outcome, flags)

    def finished(self, ended: Ended) -> Trajectory:
        """The motion for the user.

        **Raises:** `ValueError` for a start that violates the constraints; `RuntimeError` for a motion that failed,
        unless `throw` is false.
        """
        asked, stats = self.asked, ended.trajectory.stats
        if asked.solver == "switch" and stats["stiff"]:
            told = {name: stats[name] for name in ("stiff", "stiff_steps")}
            run = Run.checked(asked._replace(solver=Hermite()))
            trajectory = run.finished(run.solved())
            vars(trajectory)["stats"] = trajectory.stats | told
            return trajectory
        if asked.solver == "auto":
            warn_of_stiffness(stats)
        warn_of_wrong_derivative(stats)
        if ended.flags is None:
            trajectory = ended.trajectory.trimmed()
            if asked.throw:
                trajectory = trajectory.result.error_if(trajectory, ended.outcome.flags[0])
        else:
            trajectory = self._explained(ended)
            warn_of_parts(ended.problem.system, trajectory, ended.outcome.reach)
        if asked.error:
            closer = self._closer(ended.problem)
            trajectory = eqx.tree_at(lambda t: t.closer, trajectory, closer, is_leaf=lambda leaf: leaf is None)
        if ended.carry is not None:
            # Not a field, so that a copy with other fields does not have it.
            vars(trajectory)[CONTINUATION] = Continuation(self, ended)
        return trajectory

    def _explained(self, ended):
        """A motion with concrete numbers, and if it failed, with the precise reason."""
        problem, trajectory, outcome, flags, _ = ended
        system, span, asked = problem.system, problem.span, self.asked
        if flags.inconsistent:
            consistent(system, span.t0, problem.state)
        if not system.drift_free and system.acceleration_rows > 0:
            warn_of_jumps(system, outcome, span, problem.stops.restarts, asked.jumps)
        if flags.failed and asked.throw is not False:
            probe = self._probe(problem, outcome)
            solver, stats = problem.method.solver, trajectory.stats
            raise RuntimeError(message_of_failure(system, trajectory.result, span, outcome, stats, solver, probe))
        return trajectory if flags.whole else trajectory.trimmed()

    def _probe(self, problem, outcome):
        """The same motion continued from its end, as a function of a solver and a number of steps."""
        end = self.asked._replace(state=outcome.y, t0=outcome.t, rtol=problem.method.rtol, atol=problem.method.atol)
        if problem.method.policy.restores:
            # The user's choice for another method need not suit the method that tests for stiffness.
            end = end._replace(formulation=None, manifold=None)
        on = end._replace(**_ALONE, saveat=None, dt0=None, stepsize_controller=None)
        return lambda solver, steps: _motion(on._replace(solver=solver, max_steps=steps))

    def _closer(self, problem):
        """The same motion at tighter tolerances."""
        asked, method = self.asked, problem.method
        rtol, atol = closer_tolerances(method.solver, method.rtol, method.atol)
        closer = asked._replace(**_ALONE, solver=method.solver, rtol=rtol, atol=atol)
        if problem.traced:
            system, state = lax.stop_gradient((asked.system, asked.state))
            closer = closer._replace(system=system, state=state)
        return _motion(closer)


class Continuation:
    """A further run from the end of a motion.

    **Arguments:** the `run` that was `ended`.
    """

    def __init__(self, run: Run, ended: Ended):
        self.run, self.ended = run, ended

    def __reduce__(self):
        # A pickled motion is without it, since it has functions of the user.
        return type(None), ()

    def __call__(self, t1: Any, saveat: Any) -> Trajectory:
        """The motion to `t1`.

        **Raises:** `ValueError` for a motion that ended early, and for a `t1` that is not beyond its end.
        """
        _, motion, outcome, _, carry = self.ended
        if motion.result != RESULTS.successful:
            raise ValueError(f"Only a motion that came to its end can be continued. {RESULTS[motion.result]}")
        turning = carry.progress.turning
        state = changed(outcome.y, angles=None if turning is None else np.asarray(turning.angles[1]))
        asked = self.run.asked._replace(state=state, t0=np.asarray(outcome.t), t1=t1, saveat=saveat)
        run, before = Run.checked(asked._replace(dt0=None, error=False)), self.run.problem.span
        if run.problem.traced:
            raise ValueError("A motion is not continued under jit, vmap or a derivative; simulate from `motion.end`.")
        if not (before.t1 - before.t0) * (run.problem.span.t1 - run.problem.span.t0) > 0:
            raise ValueError(f"t1 must be beyond the end of the motion at {float(outcome.t):g}, got {t1}.")
        carry = carried_on(self.run.problem, run.problem, carry)
        ended = run.in_calls(carry)
        if carry is not None:
            stats = ended.trajectory.stats
            stats |= {name: stats[name] - motion.stats[name] for name in _COUNTS if name in stats}
        return run.finished(ended)


def _diagnosed(problem, trajectory, outcome):
    """A run that got stuck, with the precise reason, which has no derivative."""
    problem, end = freeze((problem, outcome))
    result, coupling = made_precise(problem, trajectory.result, end)
    if result == RESULTS.newton_failed and lost_rank(problem.system.at(end.y), end.t, end.y) is not None:
        # Elimination in blocks does not detect lost rank.
        result = RESULTS.singular_configuration
    return eqx.tree_at(lambda motion: motion.result, trajectory, result), outcome._replace(coupling=coupling)


def _motion(asked):
    run = Run.checked(asked)
    return run.finished(run.solved())


def _method(asked, rtol, atol):
    check_steps(asked.max_steps)
    check_steps(asked.max_events, "max_events")
    solver, controller = asked.solver, asked.stepsize_controller
    solver = named_solver(solver) if isinstance(solver, str) else _ADAMS if solver is None else solver
    check_kinds(solver, asked.formulation, asked.manifold, controller, asked.event, asked.progress_meter)
    check_fixed_steps(solver, controller)
    dtmax = checked_longest_step(asked.dtmax, controller, solver, asked.state.q.dtype)
    tolerances = {"controller": controller, "rtol": rtol, "atol": atol, "dtmax": dtmax}
    return Method.chosen(asked.system, solver, asked.manifold, asked.formulation, **tolerances)


def _counted_at_start(asked, seen):
    """The angles that a run counts, at its start, to within half a turn; None if it counts none. A function of saved
    states does not see them.
    """
    count = len(asked.system.wrapped_angle_names())
    if count == 0 or seen is not STATES:
        return None
    return np.zeros(count, asked.state.q.dtype) if asked.state.angles is None else asked.state.angles


def _settled(problem, asked):
    """The problem with the parts that depend on tracing, and the rooms for its steps."""
    system, state, span = problem.system, problem.state, problem.span
    traced = is_traced(problem)
    if traced and asked.solver == "switch":
        raise ValueError(
            "solver='switch' looks at a motion before it decides, which it cannot under jit, vmap or grad. Simulate "
            "once with solver='auto', outside, and then choose Adams() or Hermite()."
        )
    turns = turns_of(system, state, span.t0, span.t1, problem.method.controller)
    saves = problem.saveat
    if not traced:
        saves = padded(saves, span.t0, span.t1)
    taken = derivatives_of(problem) if traced else None
    orders = () if taken is None else taken.orders[: len(jax.tree.leaves((system, state)))]
    if max(orders, default=0) > 1 and system.contacts:
        raise ValueError(NO_SECOND_DERIVATIVES)
    # With concrete values, the number of steps and failures are known afterwards.
    known = not traced or (taken is not None and taken.known)
    tries = traced and known and not was_long(system, problem.method.solver)
    # Derivatives of a program under `jit` may be of any order.
    second = taken.levels > 1 if taken is not None and any(orders) else traced
    kept = kept_steps(state, asked.max_steps) if second else kept_steps(state)
    rooms = rooms_for(asked.max_steps, problem.saveat, state, tries) if traced else [room_of_calls(saves, state)]
    if span.is_backward() and system.contacts:
        raise ValueError(f"Impacts cannot be undone: with contacts t1 must be after t0, got {asked.t0} and {asked.t1}.")
    problem = problem._replace(
        saveat=saves,
        stops=problem.stops._replace(turns=turns),
        watched=problem.watched._replace(differentiated=tuple(order > 0 for order in orders) if any(orders) else ()),
        room=problem.room._replace(kept=kept).of(rooms[0], asked.max_steps),
        traced=traced,
        known=known,
    )
    return problem, rooms
