"""The motion of a system as one compiled program."""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from .._compat import with_values
from .._results import RESULTS
from .._types import State
from ..contacts.events import FoundEvents
from ..contacts.guards import contact_guards
from ..interpreted.later import Later
from ..linalg.failure import nan_where
from ..linalg.jitted import Split, jitted, shapes_of
from ..manifold.diagnosis import diagnose_friction
from ..manifold.manifold import normalize_state
from ..solvers import AbstractMultistep
from ..solvers.controller import intended_step
from ..solvers.events import NO_STATE, events_found
from ..solvers.stepping import Along, Carry, begun
from ..solvers.turning import Counted
from ..states.consistency import is_consistent
from ..states.headings import are_short
from ..system import AbstractSystem
from ..system.inputs import inputs_ended
from ..system.instant import Instant
from ..trajectory import Trajectory
from .compiling import nothing_compiles, tracing_begins
from .integrate import integrated
from .method import Method
from .outcome import Flags, Outcome, first_of, has_failed
from .room import MOST_ROWS, Room
from .saves import STATES, SavedTimes, corrected, moved, seen
from .span import Span, at_frozen_start
from .stops import Stops
from .watch import Watch


class Problem(NamedTuple):
    """A motion to be computed, with checked arguments.

    **Fields:** `system` and `state` at the start; `saveat`: the user's series and the end; `interpolated`: whether
    states are interpolated; `traced`: whether any argument is traced; `known`: whether values are concrete all the
    same, as where only a derivative is taken; `angles`: the counted angles at the start, None if none are counted;
    `carry`: what the last call of the program left, None under a trace.
    """

    system: AbstractSystem
    state: State
    span: Span
    method: Method
    saveat: Any
    interpolated: bool
    stops: Stops
    watched: Watch
    room: Room
    progress_meter: Any
    traced: bool
    known: bool
    angles: Any = None
    carry: Carry | None = None

    def options(self, y0: State, span: Span, saveat: Any) -> dict[str, Any]:
        """The options of the integration."""
        system, method = self.system, self.method
        contacts, angles = bool(system.contacts), None if self.angles is None else WrappedAngles(system)
        controller = method.controls(system, self.state, jnp.abs(self.span.t1 - self.span.t0))
        controller = self.stops.around(controller, contacts)
        return {
            "y0": y0,
            "t0": span.t0,
            "t1": span.t1,
            "dt0": span.dt0,
            "saveat": saveat,
            "stepsize_controller": controller,
            "along": Along(method.watches_gaps(system), method.headings(system), angles, self.angles),
            "event": self.stops.event,
            "progress_meter": self.progress_meter,
            # Contacts may close, or be closed, at the start.
            **({"made_jump": jnp.array(True)} if contacts else {}),
        }


class WrappedAngles(eqx.Module):
    """The angles of joints that are known up to full turns, and their rates, as a function of time and state."""

    system: AbstractSystem

    @eqx.filter_jit
    def __call__(self, t, y):
        along = jnp.ones_like(t), self.system.rates(t, y.q, y.u)
        return jax.jvp(self.system.wrapped_angles, (t, y.q), along)


class Start(NamedTuple):
    """The start of a run.

    **Fields:** the `given` state, normalised, and NaN if it violates the constraints; `y`, which follows a moving
    start; whether the state is `consistent`; whether parameters are in their range (`valid`); `finite`: whether both
    hold and all numbers of the state are finite.
    """

    given: State
    y: State
    consistent: Any
    valid: Any
    finite: Any

    @classmethod
    def of(cls, problem: Problem, term: Any) -> "Start":
        system, span, method = problem.system, problem.span, problem.method
        y, valid = problem.state, system.parameter_table.in_range() if problem.traced else True
        consistent = is_consistent(system, span.t0, y) if method.policy.restores else True
        if consistent is not True:
            y = jax.tree.map(lambda x: jnp.where(consistent, x, jnp.nan), y)
        # Only directions of Euler parameters have a meaning, and the methods integrate them with their length.
        y = normalize_state(system, span.t0, y)
        finite = functools.reduce(jnp.logical_and, [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(y)]) & valid
        given = y
        if span.moving[0]:
            guards = contact_guards(system, method.formulation, method.accuracy.at_contacts)
            if guards is not None:
                # The field includes the contacts that close or open, and the friction that slips, at the start.
                y = guards.impact(span.t0, y).after
            y = at_frozen_start(term, span.t0, y)
        return cls(given, y, consistent, valid, finite)


class End(NamedTuple):
    """The end of a run: time, state, the solver's result, the next step, and events of contacts or None."""

    t: Any
    y: State
    result: Any
    step: Any
    events: Any

    @classmethod
    def of(cls, solution: Any, stops: Stops, start: tuple[Any, State]) -> "End":
        """The end of a run with a `start`, its time and the state that was given."""
        t, y = solution.ts[1][-1], jax.tree.map(lambda y: y[-1], _parted(solution.ys[1])[0])
        contact_events, events = None, events_found(solution.controller_state)
        if events is not None:
            t0, given = start
            first = t0, ravel_pytree(dataclasses.replace(given, angles=None))[0]
            times = stops.moving(events.times[:-1])
            contact_events = FoundEvents(events.count, times, events.states[:-1], events.touch, first, t)
            if stops.event is not None:
                # The last step is cut off at the user's event, before the events at its end.
                later = jnp.isfinite(contact_events.times) & (contact_events.times > t)
                contact_events = contact_events._replace(number=contact_events.number - jnp.sum(later))
        return cls(t, y, RESULTS.promote(solution.result), intended_step(solution.controller_state), contact_events)


class Plan(NamedTuple):
    """What a run integrates.

    **Fields:** `term`, `solver` and `options` of the integration; its `start`; the saved times (`saves`); the `span` of
    the solver; the `correction` of saved states, None for none; whether the user's function sees states `later`.
    """

    term: Any
    solver: Any
    options: dict[str, Any]
    start: Start
    saves: SavedTimes
    span: Span
    correction: Any
    later: bool

    @classmethod
    def of(cls, problem: Problem) -> "Plan":
        system, method, stops = problem.system, problem.method, problem.stops
        method.check_impulses(system, stops.restarts is not None)
        term, solver = method.prepared(system)
        start = Start.of(problem, term)
        # From a start that is not finite no step is taken: the interval is empty, and contains every requested time.
        whole, first = problem.span.frozen(start.finite), problem.saveat.subs[0]
        saves = SavedTimes.of(first, *lax.stop_gradient(problem.span[:2]), problem.traced)
        saves, span = saves.behind_jumps(stops.restarts, whole.t0, whole.t1), whole.before_jump(stops.restarts)
        # The user's function sees states on the constraints, at moving times.
        correction = method.policy.correction(problem.interpolated)
        later = first.fn is not STATES and (correction is not None or any(problem.span.moving))
        saveat = saves.told(problem.saveat, whole.t0, start.finite, STATES if later else first.fn)
        options = problem.options(start.y, span, saveat)
        return cls(term, solver, options, start, saves, span, correction, later)


@shapes_of
def blank(problem: Problem) -> Carry:
    """The carry of a run, of a split problem, with zeros."""
    plan = Plan.of(problem)
    return Carry.of(begun(plan.term, plan.solver, max_steps=problem.room.rows, **plan.options)[1])


def solved(problem: Problem) -> tuple[Trajectory, Outcome]:
    """The motion under a trace, and how it ended; a motion that failed is NaN."""
    motion, outcome, _ = _traced(problem)
    return _trajectory(problem, motion), outcome


def call(problem: Problem, split: Split, carry: Carry, limit: Any) -> tuple[Trajectory, Outcome, Carry]:
    """One call of the program of a run: the motion until there were `limit` steps, how it ended, and what the next call
    needs.

    **Arguments:** `split` of the problem; `carry`: what the last call left.
    """
    arguments = split.arrays, carry, limit, split.static
    way, by_numpy = _called.way(*arguments)
    if by_numpy:
        nothing_compiles()
    motion, outcome, carry = way(*arguments)
    if by_numpy:
        motion["stats"]["interpreted"] = jax.device_put(np.array(True))
    return _trajectory(problem, motion), outcome, carry


def _trajectory(problem, motion):
    # Without the checks of `Trajectory`, which would take as long as the checks of all arguments.
    return with_values(Trajectory, {"system": problem.system, "closer": None} | motion)


@jitted
def _traced(problem: Problem):
    return _solved(problem)


@Later
@functools.partial(jax.jit, static_argnums=3)
def _called(arrays, carry, limit, static):
    problem: Problem = Split(arrays, static).whole()
    return _solved(problem._replace(room=problem.room._replace(limit=limit), carry=carry))


def _solved(problem: Problem) -> tuple[dict[str, Any], Outcome, Carry | None]:
    """The results of the program: fields of the `Trajectory` without the system, which is an argument."""
    tracing_begins()
    system, method, stops, watched = problem.system, problem.method, problem.stops, problem.watched
    direction = watched.direction(system, lambda system: method.prepared(system)[0])
    plan = Plan.of(problem)
    term, solver, start, saves, span = plan.term, plan.solver, plan.start, plan.saves, plan.span
    control = watched.control(system, start.y, jnp.abs(span.t1 - span.t0), direction)
    solution, carry = integrated(
        (term, solver, plan.options),
        control,
        problem.room,
        method.projects_steps(system),
        bool(watched.differentiated),
        problem.carry,
    )
    ts, ys, angles, lost = _states_of(problem, plan, solution)
    ts, ys = moved(saves.series, term, problem.span, start.given, ts, ys)
    function = problem.saveat.subs[0].fn
    if plan.later:
        ys = seen(function, ts, ys, (problem.span.t0, start.y))
    elif angles is not None:
        ys = dataclasses.replace(ys, angles=angles)
    end = End.of(solution, stops, (problem.span.t0, start.given))
    result, failed, stuck, ran_out, coupling = _verdict(problem, span, start, end, solution, lost, saves.outside)
    motion = ys, solution.interpolation
    if problem.traced:
        # Otherwise a derivative computed alone, which raises no error, would be of the part before the failure.
        inputs = system, problem.state, problem.span, method.formulation, method.policy, stops.event, function
        motion = nan_where(failed, motion, inputs)
    stats = _statistics(problem, solver, solution, end)
    complete, long = jnp.all(jnp.isfinite(ts)), stats["num_steps"] >= MOST_ROWS
    flags = Flags(failed, ~jnp.asarray(start.consistent), stuck, complete, ran_out, long)
    evidence = method.policy.evidence(solution.solver_state)
    turning = None if carry is None else carry.progress.turning
    reach = None if turning is None else turning.reach
    outcome = Outcome(jnp.stack([jnp.asarray(x) for x in flags]), end.t, end.y, end.step, coupling, evidence, reach)
    fields = {
        "formulation": method.formulation,
        "ts": ts,
        "ys": motion[0],
        "stats": stats,
        "result": result,
        "interpolation": motion[1],
        "event_mask": solution.event_mask,
        "found_events": end.events,
    }
    return fields, outcome, carry


def _states_of(problem, plan, solution):
    """The saved times and states of a solution, returned to the constraints; the counted angles, or None; and whether
    the return failed.
    """
    (ys, angles), lost = _parted(solution.ys[0]), False
    begins = True if problem.carry is None else problem.carry.begins
    starts = None if problem.stops.restarts is None else problem.span.t0
    ts = plan.saves.restored(solution.ts[0], starts, plan.start.finite, begins)
    if plan.correction is not None:
        ys, lost = corrected(plan.correction, problem.system.prepared(), ts, ys, (plan.span.t0, plan.start.y))
    return ts, ys, angles, lost


def _parted(saved):
    """The saved states of a series, and the counted angles beside them, or None."""
    return (saved.states, saved.angles) if isinstance(saved, Counted) else (saved, None)


def _verdict(problem, interval, start, end, solution, lost, outside):
    """The result of a run by the first reason that holds; whether it failed; whether it is stuck on its way; whether it
    had too few steps; and the coupling of friction with its own reactions if that is the reason, None without friction.
    """
    system, policy, span = problem.system, problem.method.policy, problem.span
    reasons: list[tuple[Any, Any]] = [
        (False if start.valid is True else ~start.valid, RESULTS.invalid_parameters),
        (~start.finite, RESULTS.assembly_failed),
    ]
    is_usable = start.finite
    if end.events is not None:
        backward, no_state = span.t1 < span.t0, end.result == RESULTS.promote(NO_STATE)
        reasons += [
            (backward, RESULTS.impacts_backward),
            (end.events.number > problem.stops.max_events, RESULTS.too_many_events),
            (no_state, RESULTS.contacts_undetermined),
        ]
        is_usable = start.finite & ~backward & ~no_state
    result = first_of(reasons, end.result)
    # A run without enough steps is stuck if the rest would take a thousand times as many steps as it took.
    ran_out = result == RESULTS.max_steps_reached
    remaining = jnp.abs(interval.t1 - end.t)
    steps = jnp.asarray(solution.stats["num_steps"], remaining.dtype)
    creeps = True if end.step is None else remaining > 1e3 * steps * jnp.abs(end.step)
    stuck, coupling = has_failed(result) & is_usable & (creeps | ~ran_out), None
    violated = policy.violated(system.prepared(), end.t, end.y, problem.method.accuracy)
    later = [
        (lost, RESULTS.newton_failed),
        (inputs_ended(system, span.t0, span.t1) if problem.traced else False, RESULTS.input_ended),
        (outside, RESULTS.saved_outside),
    ]
    # A failure that is diagnosed stays one: a program that does not return the result needs no diagnosis.
    failed = functools.reduce(jnp.logical_or, (holds for holds, _ in later), has_failed(result) | violated)
    if not problem.known:
        evidence = policy.evidence(solution.solver_state)
        result, coupling = diagnosed(problem, end.t, end.y, evidence, result, stuck)
    reasons = [(violated, RESULTS.inconsistent_constraints), (has_failed(result), result), *later]
    return first_of(reasons, result), failed, stuck, ran_out, coupling


def _statistics(problem, solver, solution, end):
    """Counts of the integration."""
    stats = dict(solution.stats) | {"max_steps": problem.room.limit}
    linearised = False
    if isinstance(solver, AbstractMultistep):
        stats |= solver.statistics(solution.solver_state, solution.controller_state, stats)
        linearised = solver.linear_steps(False) is not None
    stats |= {"linearised_steps": jnp.array(linearised), "interpreted": jnp.array(False)}
    stats |= problem.method.policy.statistics(solution.solver_state)
    if end.events is not None:
        stats |= {"num_events": jnp.minimum(end.events.number, problem.stops.max_events)}
    return stats


@eqx.filter_jit
def made_precise(problem: Problem, result: Any, outcome: Outcome) -> tuple[Any, Any]:
    """As `diagnosed`, for a run with concrete values that got stuck: a separate program, which only such runs need."""
    stuck = result != RESULTS.inconsistent_constraints
    return diagnosed(problem, outcome.t, outcome.y, outcome.evidence, result, stuck)


def diagnosed(problem: Problem, t, y, evidence, result, stuck) -> tuple[Any, Any]:
    """The result of a run that ended at a state, made precise if it is stuck; and the coupling of friction with its own
    reactions there, None without friction.
    """
    system = problem.system.prepared()
    result = problem.method.policy.diagnose(system, t, y, evidence, result, stuck, problem.method.accuracy)
    if system.catalogue.lost_headings:
        result = RESULTS.where(stuck & jnp.any(are_short(system, t, y.q)), RESULTS.singular_configuration, result)
    if not system.friction_rows.size:
        return result, None
    return diagnose_friction(Instant.of(system, t, y), problem.method.formulation, result, stuck)
