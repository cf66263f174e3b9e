"""The integration of a motion as one compiled program, whose mesh resolves derivatives where they are taken."""

import dataclasses
import functools
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._compat import with_values
from .._results import RESULTS
from .._types import State
from ..contact_events import FoundEvents
from ..formulations import AbstractFormulation
from ..linalg.failure import nan_where
from ..linalg.jitted import jitted
from ..linalg.members import vmap_states
from ..manifold import (
    AbstractManifold,
    after_jumps,
    contact_guards,
    counted_components,
    default_manifold,
    natural_units,
    next_number,
    project,
    state_blocks,
)
from ..manifold.diagnosis import diagnose_friction
from ..solvers import (
    NO_STATE,
    AbstractMultistep,
    MeshAdjoint,
    RunningScales,
    TangentControl,
    events_found,
    intended_step,
    with_counted,
    with_tangents,
)
from ..solvers.gaps import GapSolver
from ..states.consistency import is_consistent
from ..system import AbstractSystem
from ..system.inputs import inputs_ended
from ..system.instant import Instant
from ..system.parameters import with_parameters
from ..trajectory import Trajectory
from .arguments import MOST_ROWS, adapts, default_controller, kept_steps, with_restarts
from .compiling import tracing_begins
from .loop import Loop
from .moving_times import at_frozen_start, at_moving_times, saved_times
from .outcome import Flags, Outcome, first_of, has_failed

# What saves states as they are.
_STATES = diffrax.SubSaveAt(t1=True).fn
# The least change of a parameter whose effect is watched, of one that is next to zero, in its unit.
_LEAST_CHANGE = 1e-4


class Problem(NamedTuple):
    """A motion to be computed, with checked arguments.

    **Fields:** `system` and `state` at the start; `formulation` and `manifold`, None for those that suit the
    `solver`; `controller`, None for that of `rtol` and `atol`, and atol None for running scales, with steps of `dtmax`
    at most, None for any; `times`: t0, t1, dt0; `saveat`; `adjoint`, None for derivatives on the mesh; `event`;
    `limit`: the largest number of steps, and `room`: that which the program has room for; `max_events`: the largest
    number of events of contacts; `progress_meter`; times of `restarts`, and of `stops`, which no step passes, or None;
    `changes`: values of parameters with changes whose tangent is watched, by name, None for all that are
    differentiated, and empty for no tangent; whether states are `interpolated`; whether anything is `traced`; by which
    leaves of the system and the state derivatives are taken (`differentiated`), empty where that is not known; whether
    the start, and the end or a saved time, are `moving`.
    """

    system: AbstractSystem
    state: State
    formulation: AbstractFormulation | None
    manifold: AbstractManifold | None
    solver: diffrax.AbstractSolver
    controller: Any
    rtol: Any
    atol: Any
    dtmax: Any
    times: dict[str, Any]
    saveat: diffrax.SaveAt
    adjoint: Any
    event: Any
    limit: Any
    max_events: int
    room: int
    progress_meter: Any
    restarts: Any
    stops: Any
    changes: dict[str, tuple[Any, Any]] | None
    interpolated: bool
    traced: bool
    differentiated: tuple[bool, ...]
    moving: tuple[bool, bool]

    @property
    def policy(self) -> AbstractManifold:
        given = self.manifold
        return default_manifold(self.system, self.solver, self.formulation) if given is None else given

    @property
    def method(self) -> AbstractFormulation:
        given = self.formulation
        return self.policy.default_formulation(self.system) if given is None else given

    def check_impulses(self) -> None:
        """Raise a `ValueError` where the velocities after an impulse would not be known."""
        system, policy = self.system, self.policy
        jumps = self.restarts is not None and system.velocity_rows > 0
        if not jumps and system.contacts is None:
            return
        if not (policy.takes_impulses and system.positive_definite_mass):
            what = "jumps, or inputs that jump, a constrained system" if jumps else "contacts a system"
            raise ValueError(
                f"With {what} needs manifold=Partition() or Projection(), and a mass matrix that has an inverse; got "
                f"{type(policy).__name__}() and positive_definite_mass = {system.positive_definite_mass}."
            )

    @property
    def projects_steps(self) -> bool:
        """Whether states return to constraints after the steps of a method that does not know of them."""
        return self.system.velocity_rows > 0 and not isinstance(self.solver, AbstractMultistep)

    @property
    def watches_gaps(self) -> bool:
        """Whether steps pass over no force that acts in a gap; those of a fixed length may."""
        return self.system.has_gaps and adapts(self.controller)

    def assembled(self, system: AbstractSystem) -> tuple[Any, Any]:
        """The term of a system, and the solver, prepared for it."""
        term, prepared = self.policy.prepare(system.prepared(), self.method, self.solver, self.rtol)
        if self.watches_gaps and not isinstance(prepared, AbstractMultistep):
            prepared = GapSolver(prepared)
        return term, prepared

    def options(self, start: State) -> dict[str, Any]:
        """Those of `diffrax.diffeqsolve` from a start."""
        controller, absolute = self.controller, self.rtol / 100 if self.atol is None else self.atol
        if controller is None:
            scales = running_scales(self.system, self.state, self.times) if self.atol is None else None
            controller = default_controller(self.solver, self.rtol, absolute, scales, self.dtmax)
        controller = with_counted(controller, counted_components(self.system))
        return self.times | {
            "y0": start,
            "saveat": self.saveat,
            "stepsize_controller": with_restarts(
                controller,
                self.restarts,
                self.stops,
                None if self.system.contacts is None else self.max_events,
                self.watches_gaps,
            ),
            "event": self.event,
            "max_steps": self.room,
            "progress_meter": self.progress_meter,
        }


def solved(problem: Problem) -> tuple[Trajectory, Outcome]:
    """The motion, and how it ended; where anything is traced, a motion that failed is NaN."""
    motion, outcome = _solved(problem)
    # Without its checks, which would take as long as those of all arguments.
    return with_values(Trajectory, {"system": problem.system, "closer": None} | motion), outcome


@jitted
def _solved(problem: Problem) -> tuple[dict[str, Any], Outcome]:
    """What the program returns: fields of the `Trajectory` but the system, which comes in already."""
    tracing_begins()
    problem.check_impulses()
    system, policy, times = problem.system, problem.policy, problem.times
    valid = system.parameters_in_range() if problem.traced else True
    term, solver = problem.assembled(system)
    consistent = is_consistent(system, times["t0"], problem.state) if policy.restores else True
    start = problem.state
    if consistent is not True:
        start = jax.tree.map(lambda x: jnp.where(consistent, x, jnp.nan), start)
    direction, changes = None, problem.changes
    if changes:
        moved = lambda step: with_parameters(system, {k: at + step * x for k, (at, x) in changes.items()})
        direction = eqx.filter_jvp(lambda step: problem.assembled(moved(step))[0], (0.0,), (1.0,))[1]
    elif problem.differentiated and changes is None:
        leaves, structure = jax.tree.flatten(system)
        used = jax.tree.unflatten(structure, problem.differentiated[: len(leaves)])
        direction = _pushed(lambda system: problem.assembled(system)[0], system, used)
    finite = functools.reduce(jnp.logical_and, [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(start)]) & valid

    # From nowhere there is no step to take: the interval is empty, with every time that is asked for in it.
    first = problem.saveat.subs[0]
    options = problem.options(start) | lax.stop_gradient(times)
    if system.contacts is not None:
        # Contacts may close, or be closed, at the start.
        options["made_jump"] = jnp.array(True)
    given = start
    if problem.moving[0]:
        guards = contact_guards(system, problem.method, policy.contact_tolerance(system, problem.rtol))
        if guards is not None:
            # The field is that of the contacts that close or open, and of the friction that slips, at the start.
            start = guards.impact(times["t0"], start).after
        options["y0"] = start = at_frozen_start(term, times["t0"], start)
    at_once, saved_at = lambda times: jnp.where(finite, times, options["t0"]), lax.stop_gradient(first.ts)
    outside: Any = False
    if problem.traced and saved_at is not None:
        ends = jnp.sort(jnp.stack([options["t0"], options["t1"]]))
        inside = jnp.clip(saved_at, *ends)
        # A time that is computed as t1 is may differ from it by rounding errors.
        rounding = 8 * jnp.finfo(ends.dtype).eps * jnp.max(jnp.abs(ends))
        sign = jnp.where(options["t0"] <= options["t1"], 1, -1)
        ordered = jnp.all(sign * jnp.diff(saved_at) >= 0)
        outside, saved_at = ~(jnp.all(jnp.abs(inside - saved_at) <= rounding) & ordered), inside
        # Without the derivatives that clipping takes from the times at the ends.
        first = eqx.tree_at(lambda first: first.ts, first, saved_at + first.ts - lax.stop_gradient(first.ts))
    options["t1"] = at_once(options["t1"])
    controller, after = options["stepsize_controller"], saved_at
    jumps = controller.jump_ts if isinstance(controller, diffrax.ClipStepSizeController) else None
    if saved_at is not None:
        if jumps is not None:
            # States that are saved at a jump are those after it, also in a run that comes to it from there.
            after = after_jumps(saved_at, jumps, options["t0"], options["t1"])
        options["saveat"] = eqx.tree_at(lambda saveat: saveat.subs[0].ts, options["saveat"], at_once(after))
    if jumps is not None:
        # A run backward starts before a jump at its start.
        before = jnp.isin(options["t0"], jumps) & (options["t1"] < options["t0"])
        options["t0"] = jnp.where(before, next_number(options["t0"], -1), options["t0"])
    correction, lost = policy.correction(problem.interpolated), None
    # A user's function is one of states on the constraints, at times that move.
    of_saved = first.fn is not _STATES and (correction is not None or any(problem.moving))
    if of_saved:
        options["saveat"] = eqx.tree_at(lambda saveat: saveat.subs[0].fn, options["saveat"], _STATES)
    control = _tangent_control(system, options, direction)
    if problem.differentiated and changes is None:
        excites = any(problem.differentiated[len(jax.tree.leaves(system)) :])
        control = dataclasses.replace(control, excites=excites)
    watched = None if changes == {} else control
    # Where it is known which of the two a run is, the other is not traced.
    solve = _solve_with_tangents if problem.differentiated else _solve_on_mesh
    solution: Any = solve((term, solver, options), watched, problem.adjoint, problem.limit, problem.projects_steps)
    ts, saved = solution.ts[0], solution.ys[0]
    if jumps is not None and first.t0:
        ts = ts.at[0].set(lax.stop_gradient(times["t0"]))
    if saved_at is not None:
        ts = jnp.where(finite, ts, jnp.inf)
    if correction is not None:
        saved, lost = _corrected(system.prepared(), options, ts, saved, correction)
    if after is not saved_at:
        ts = _replaced(ts, after, saved_at)
    if any(problem.moving):
        ts, moves = saved_times(first, ts, times["t0"], times["t1"])
        if problem.moving[1]:
            saved = at_moving_times(term, ts, moves, saved)
        if problem.moving[0] and first.t0:
            saved = jax.tree.map(lambda x, y: x.at[0].set(y), saved, given)
    if of_saved:
        saved = _of_states(first.fn, ts, saved, (times["t0"], start))

    found, events = None, events_found(solution.controller_state)
    if events is not None:
        found = FoundEvents(events.count, events.times[:-1], events.states[:-1], events.touch)
    end = solution.ts[1][-1], jax.tree.map(lambda y: y[-1], solution.ys[1])
    if found is not None and problem.event is not None:
        # The last step is cut off at the user's event, before what was found at its end.
        later = jnp.isfinite(found.times) & (found.times > end[0])
        found = found._replace(number=found.number - jnp.sum(later))
    result = RESULTS.promote(solution.result)
    reasons: list[tuple[Any, Any]] = [
        (False if valid is True else ~valid, RESULTS.invalid_parameters),
        (~finite, RESULTS.assembly_failed),
    ]
    unknown = finite
    if found is not None:
        backward, no_state = times["t1"] < times["t0"], result == RESULTS.promote(NO_STATE)
        reasons += [
            (backward, RESULTS.impacts_backward),
            (found.number > problem.max_events, RESULTS.too_many_events),
            (no_state, RESULTS.contacts_undetermined),
        ]
        unknown = finite & ~backward & ~no_state
    result = first_of(reasons, result)
    # A run without enough steps is stuck where the rest would take a thousand times as many as it had.
    ran_out, step = result == RESULTS.max_steps_reached, intended_step(solution.controller_state)
    left = jnp.abs(options["t1"] - end[0])
    creeps = True if step is None else left > 1e3 * solution.stats["num_steps"] * jnp.abs(step)
    stuck, coupling = has_failed(result) & unknown & (creeps | ~ran_out), None
    evidence = policy.evidence(solution.solver_state)
    if problem.traced:
        result, coupling = diagnosed(problem, *end, evidence, result, stuck)
    reasons = [
        (policy.violated(system.prepared(), *end), RESULTS.inconsistent_constraints),
        (has_failed(result), result),
        (False if lost is None else lost, RESULTS.newton_failed),
        (inputs_ended(system, times["t0"], times["t1"]) if problem.traced else False, RESULTS.input_ended),
        (outside, RESULTS.saved_outside),
    ]
    result = first_of(reasons, result)
    stats = dict(solution.stats) | {"max_steps": problem.limit}
    linearised = False
    if isinstance(solver, AbstractMultistep):
        stats |= solver.statistics(solution.solver_state, solution.controller_state, stats)
        linearised = problem.adjoint is None and solver.linear_steps(False) is not None
    stats |= {"linearised_steps": jnp.array(linearised)}
    stats |= policy.statistics(solution.solver_state)
    if found is not None:
        stats |= {"num_events": jnp.minimum(found.number, problem.max_events)}
    motion = saved, solution.interpolation
    failed = has_failed(result)
    if problem.traced:
        # A derivative would be that of the part before the failure. The error goes with the value, and not with a
        # derivative that is taken alone.
        inputs = system, problem.state, times, problem.formulation, problem.manifold, problem.event, first.fn
        motion = nan_where(failed, motion, inputs)
    whole, long = jnp.all(jnp.isfinite(ts)), stats["num_steps"] >= MOST_ROWS
    wrong = stats.get("wrong_derivative", False)
    flags = Flags(failed, ~jnp.asarray(consistent), stuck, whole, ran_out, long, wrong)
    outcome = Outcome(jnp.stack([jnp.asarray(flag) for flag in flags]), *end, step, coupling, evidence)
    fields = {
        "formulation": problem.method,
        "ts": ts,
        "ys": motion[0],
        "stats": stats,
        "result": result,
        "interpolation": motion[1],
        "event_mask": solution.event_mask,
        "found_events": found,
    }
    return fields, outcome


@eqx.filter_jit
def made_precise(problem: Problem, result: Any, outcome: Outcome) -> tuple[Any, Any]:
    """As `diagnosed`, of a run that got stuck: a program of its own, which only such runs need."""
    stuck = result != RESULTS.inconsistent_constraints
    return diagnosed(problem, outcome.t, outcome.y, outcome.evidence, result, stuck)


def diagnosed(problem: Problem, t, y, evidence, result, stuck) -> tuple[Any, Any]:
    """The result of a run that ended at a state, made precise where it got stuck, and the coupling of friction with its
    own reactions there, None without friction.
    """
    system = problem.system.prepared()
    result = problem.policy.diagnose(system, t, y, evidence, result, stuck)
    if not system.friction_parts:
        return result, None
    return diagnose_friction(Instant.of(system, t, y), problem.method, result, stuck)


@eqx.filter_custom_jvp
def _solve_on_mesh(arguments, control, adjoint, limit, projects_steps):
    """The solution, whose mesh resolves the motion; where it is differentiated, tangents as well."""
    del control, projects_steps
    term, solver, options = arguments
    return _solve_states(term, solver, options, adjoint, limit, None)


@_solve_on_mesh.def_jvp
def _solve_jvp(primals, tangents):
    arguments, control, adjoint, limit, projects_steps = primals
    if control is not None and control.direction is None:
        used = jax.tree.map(lambda x: x is not None, tangents[0][0], is_leaf=lambda x: x is None)
        direction = _pushed(lambda term: term, lax.stop_gradient(arguments[0]), used)
        excites = bool(jax.tree.leaves(tangents[0][2]["y0"]))
        control = dataclasses.replace(control, direction=direction, excites=excites)
    solve = lambda arguments: _solve_with_tangents(arguments, control, adjoint, limit, projects_steps)
    return eqx.filter_jvp(solve, (arguments,), (tangents[0],))


def _solve_with_tangents(arguments, control, adjoint, limit, projects_steps):
    term, solver, options = arguments
    without_tangents = lambda state: state
    if control is not None:
        if projects_steps:
            restore = lambda term, y: project(term.vector_field.system, options["t0"], y)
            control = control.on_constraints(restore, *lax.stop_gradient((term, options["y0"])))
        solver, controller, without_tangents = with_tangents(solver, options["stepsize_controller"], control)
        options = options | {"stepsize_controller": controller}
    solution = _solve_states(
        term, solver, options, adjoint, limit, MeshAdjoint(kept_steps(options["y0"]), "made_jump" in options)
    )
    return eqx.tree_at(lambda s: s.solver_state, solution, replace_fn=without_tangents)


def _solve_states(term, solver, options, adjoint, limit, derivatives):
    """The solution with states saved first, and then what the user's function makes of them."""
    function, saveat = options["saveat"].subs[0].fn, options["saveat"]
    if function is not _STATES and derivatives is not None:
        saveat = eqx.tree_at(lambda saveat: saveat.subs[0].fn, saveat, _STATES)
    if adjoint is None:
        adjoint, saveat = Loop.around(saveat, limit, derivatives)
    options = options | {"adjoint": adjoint, "saveat": saveat}
    solution: Any = diffrax.diffeqsolve(term, solver, throw=False, **options)
    if function is _STATES or derivatives is None:
        return solution
    ys = _of_states(function, solution.ts[0], solution.ys[0], (options["t0"], options["y0"]))
    return eqx.tree_at(lambda solution: solution.ys[0], solution, ys)


def _of_states(function, ts, ys, start):
    """What a user's function makes of saved states. Entries after the end of a run, whose states are infinite, are
    infinite, whole numbers zero, and have no derivatives.
    """
    never = lambda x: jnp.inf if jnp.issubdtype(x.dtype, jnp.inexact) else 0

    def saved(t, y, finite):
        t, y = jax.tree.map(lambda x, x0: jnp.where(finite, x, x0), (t, y), start)
        values = jax.tree.map(jnp.asarray, function(t, y, None))
        return jax.tree.map(lambda x: jnp.where(finite, x, jnp.asarray(never(x), x.dtype)), values)

    return jax.vmap(saved)(ts, ys, jnp.isfinite(ts))


def _tangent_control(system, options, direction) -> TangentControl:
    """What is known of the sizes of a tangent: those of the coordinates, and of the velocities in the time that the
    motion takes.
    """
    state, span = options["y0"], jnp.abs(options["t1"] - options["t0"])
    velocities = system.velocity_scale()
    rate = jnp.maximum(jnp.max(jnp.abs(state.u) / velocities, initial=0.0), 1 / jnp.where(span > 0, span, 1.0))
    units = natural_units(system, velocities * rate, state.q.dtype)
    sizes = tuple(block.size for block in state_blocks(system, rate))
    return lax.stop_gradient(TangentControl(units, sizes, direction, counted=counted_components(system)))


def _pushed(function, at, used):
    """The tangent of a function along a change of all the leaves that are `used`, of each by its own size, by one where
    it is zero, and with random signs, always the same ones; None where none is used.
    """
    random = np.random.default_rng(0)

    def change(x, is_used):
        if not (is_used and eqx.is_inexact_array(x)):
            return None
        signs = random.choice([-1.0, 1.0], x.shape) * random.uniform(0.5, 1.0, x.shape)
        # A bound may be infinite.
        finite = jnp.isfinite(x)
        size = jnp.max(jnp.where(finite, jnp.abs(x), 0.0), initial=0.0)
        size = jnp.where(size > 0, jnp.maximum(size, _LEAST_CHANGE), 1.0)
        return jnp.where(finite, size * jnp.asarray(signs, x.dtype), 0.0)

    along = jax.tree.map(change, at, used, is_leaf=lambda x: x is None)
    if not jax.tree.leaves(along):
        return None
    return lax.stop_gradient(eqx.filter_jvp(function, (at,), (along,))[1])


def running_scales(system, state, options) -> RunningScales:
    """Natural units of coordinates, velocities and internal states; what is expected of velocities where nothing moves
    yet is one unit in the whole time.
    """
    span = jnp.abs(options["t1"] - options["t0"])
    units = natural_units(system, system.velocity_scale(), state.q.dtype)
    units, rate = lax.stop_gradient((units, 1 / jnp.where(span > 0, span, 1.0)))
    return RunningScales(units, state_blocks(system, rate), counted_components(system))


def _replaced(values, old, new):
    """Values with those that are among the `old` ones, which run up or down, replaced by the `new` ones."""
    order = jnp.argsort(old)
    k = order[jnp.clip(jnp.searchsorted(old[order], values), 0, old.size - 1)]
    return jnp.where(values == old[k], new[k], values)


def _corrected(system, options, ts, saved, correction):
    """Saved states, returned to the constraints, and whether one of them could not be; entries after the end of a run
    stay as they are.
    """
    finite = jnp.isfinite(ts)
    # Elsewhere something is corrected that has no failure and no derivative.
    at_start, start = lax.stop_gradient((options["t0"], options["y0"]))
    inside = jax.tree.map(lambda y, y0: jnp.where(finite[:, None], y, y0[None]), saved, start)
    every = vmap_states(lambda t, y: correction(system, t, y), system.coordinate_rows * system.nq)
    corrected = every(jnp.where(finite, ts, at_start), inside)
    is_known = lambda y: functools.reduce(
        jnp.logical_and, [jnp.all(jnp.isfinite(x), axis=1) for x in jax.tree.leaves(y)]
    )
    lost = jnp.any(is_known(inside) & ~is_known(corrected))
    return jax.tree.map(lambda new, old: jnp.where(finite[:, None], new, old), corrected, saved), lost
