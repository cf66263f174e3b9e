"""From a system and a state to a motion."""

import collections
import contextlib
import functools
from collections.abc import Mapping
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import numpy as np
from jax import lax
from jaxtyping import ArrayLike

from .._arguments import check_kind
from .._results import RESULTS
from .._types import Scalar, State, VectorLike
from ..formulations import AbstractFormulation
from ..linalg.arrays import derivatives_of, is_traced
from ..manifold import AbstractManifold
from ..manifold.impact import NO_SECOND_DERIVATIVES
from ..parts.names import names_arguments
from ..solvers import Adams, Hermite
from ..states.arguments import check_precision
from ..states.consistency import consistent
from ..states.refusals import lost_rank
from ..system import AbstractSystem
from ..system.inputs import Signals, input_break_times, with_inputs
from ..trajectory import Trajectory
from .arguments import (
    DEFAULT_RTOL,
    captured_event,
    check_error_estimate,
    check_fixed_steps,
    check_kinds,
    check_steps,
    checked_jumps,
    checked_longest_step,
    checked_saveat,
    checked_state,
    checked_times,
    checked_tolerances,
    closer_tolerances,
    named_solver,
    padded,
    parameter_changes,
    rooms_for,
    stops_of,
    with_end,
)
from .compiling import told_of_compiling
from .moving_times import may_move
from .outcome import Flags, message_of_failure, warn_of_jumps, warn_of_stiffness, warn_of_wrong_derivative
from .solve import Problem, made_precise, solved

# Defaults, made once: their construction would take as long as the rest of a call.
_ADAMS, _NO_METER = Adams(), diffrax.NoProgressMeter()
# The structures of the last systems and solvers of which a motion in this process, with or without derivatives, took as
# many steps as derivatives keep at once: the next derivative outside of `jit` does not try with room for no more. Only
# so many are kept, since structures hold the functions of their users.
_long: collections.deque[Any] = collections.deque(maxlen=16)
_HIDDEN = (
    "A function that this simulation calls uses a value that JAX traces and cannot find, such as a global variable or "
    "an attribute of an object: make it a parameter, or let the function close over it."
)


@names_arguments
def simulate(
    system: AbstractSystem,
    state: State,
    *,
    t1: Scalar,
    t0: Scalar = 0.0,
    dt0: Scalar | None = None,
    saveat: diffrax.SaveAt | ArrayLike | None = None,
    solver: diffrax.AbstractSolver | Literal["auto", "switch"] | None = None,
    formulation: AbstractFormulation | None = None,
    manifold: AbstractManifold | None = None,
    rtol: Scalar = DEFAULT_RTOL,
    atol: ArrayLike | None = None,
    dtmax: Scalar | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    inputs: Signals | None = None,
    jumps: ArrayLike | None = None,
    event: diffrax.Event | None = None,
    direction: Mapping[str, VectorLike] | None = None,
    error: bool = False,
    max_steps: int = 65536,
    max_events: int = 1024,
    throw: bool | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> Trajectory:
    """Integrate the motion of a system.

    ```python
    state = jaxmb.assemble(system, fix={"bar.angle": 0.5})
    motion = jaxmb.simulate(system, state, t1=1.0, saveat=np.linspace(0.0, 1.0, 11))
    motion["bar"].angle, motion.energy, motion.reactions["pin"].force
    ```

    The first call for a system compiles a program, which takes seconds; later ones with other numbers, times and
    tolerances do not. `jax.jit` is not needed: it compiles the motion anew, as a part of its function.

    **Main arguments:**

    - `system`, `state`: a compiled scene and a consistent state of it, from `assemble`.
    - `t0`, `t1`: the interval [s]; `t1 < t0` runs backwards.
    - `saveat`: times to save at [s], or a `diffrax.SaveAt`; default only `t1`. `SaveAt(dense=True)` allows
        `Trajectory.at(t)`; under `jit` it takes memory for `max_steps` steps, otherwise for those of the motion. A
        function, `SaveAt(ts=times, fn=function)`, sees states on the constraints, as they are saved without it.
    - `rtol`, `atol`: tolerances. `Adams` and `Hermite` let a step err by a twentieth of them, as errors add up: the
        error of the result, relative to the largest coordinates and velocities, is then mostly below `rtol`; some ten
        times `rtol` over many periods, more where neighbouring motions part quickly, and about the same as that of
        `diffrax.Dopri8()`; `error=True` estimates it. Near rounding the part grows, up to all of it: steps are not
        asked for less than 4e-14 (`Adams`) or 1e-11 (`Hermite`). `atol` defaults to one hundredth of `rtol`, times the
        largest coordinate (in units of the machine's size, or radians) and the largest velocity so far, so that the
        units do not matter and slow or small motions are as accurate as others; while all that moved since the
        start was less than 2e-14 of that size in each step, velocities are taken for rounding errors of forces that
        balance. Internal states count by kinds, each with its largest value, at least 1e-4 of its typical size. A
        number is in SI units; it may be a vector of one for each coordinate, velocity and internal state,
        (nq + nu + nz,): where stiff springs vibrate too little to matter in positions, a coarser one for velocities
        saves most of the steps of `Hermite`.

    - `inputs`: parameters as functions of time, by name: `{"motor.torque": jaxmb.Series(ts, torques)}`, or a function
        of t; see `with_inputs`, which also `assemble` needs where a driver has such an input. The solver restarts where
        a held series jumps and, if it moves a point, an axis, a joint, a stop or the ground, or constraints depend on
        it, at every time of a linear one. No step passes a pulse of an input, however long steps are where nothing
        moves: a series is followed from value to value, a function at 513 times, and so are functions of time of
        drivers, of `Force` and of constraints, with `of_time` those of one's own parts. Shorter ones need `jumps` or
        `dtmax`, and so do those in a `LagrangianSystem`.

    **Other arguments, rarely needed:**

    - `solver`: default `Adams()`; for stiff motions `Hermite()`; any diffrax Runge–Kutta solver. `"auto"` is `Adams`,
        which also detects whether stability instead of accuracy limits its steps: `stats["stiff"]`, and in how many
        steps, `stats["stiff_steps"]`; a warning then advises `Hermite`. Counting takes some percent of a step. With
        `"switch"` a motion that is detected to be stiff is simulated again from `t0` with `Hermite`; not under `jit`,
        `vmap` or `grad`.
    - `formulation`: how accelerations are solved for. Default `Partitioned()` with a `Partition`; otherwise
        `Multipliers()`, which needs no search for pivots, or `NullSpace()` where the mass matrix is singular.
    - `manifold`: how the state stays on the constraints. Default `Partition()` for `Adams` and `Hermite`, and
        `Projection()` for other solvers; a system without constraints needs neither. For `Adams` on a scene of 30 or
        more constraint rows, 150 where some are redundant, the default is `Projection()` as well, whose cost grows
        with the number of joints and not with its cube, except that it does with the cube of the number of joints that
        rub; so it is for `Hermite` on such a scene, or one without joints, of 40 or more velocities, without friction,
        servos and internal states.
    - `dt0`: first step [s], default chosen from the motion.
    - `dtmax`: longest step [s], default none. Tolerances and everything else stay as they are.
    - `stepsize_controller`: instead of `rtol` and `atol`; a `MultistepController` for `Adams` and `Hermite`.
    - `adjoint`: how to differentiate instead, one of diffrax's. The default serves `jax.grad`, `jvp`, `jacfwd`,
        `jacrev`, `hessian`, `vmap` of them, and nested ones; it keeps some numbers of up to 2048 steps (at most
        128 MB with `Adams`, about eight times as much with solvers whose steps are differentiated as they are), and of
        longer runs finds those of each part again. With `Adams` a gradient costs about three runs, whatever the number
        of parameters; forward mode costs as much for one parameter and somewhat less than half a run for each further
        one, whatever the number of outputs.
    - `direction`: parameters by name with a change of each, for runs that are differentiated; see below.
    - `error`: whether to estimate the global error of the result, `Trajectory.error`, by a second run whose
        steps may err a hundredth as much; near rounding, and with a method of a fixed order, a tenth. Both together
        take two to two and a half times as long as one, more with a low order, and nothing more to compile.
    - `jumps`: times [s] at which drivers or forces have kinks or jumps, a vector. The solver stops just before each,
        and restarts just after it; where a driver's rate jumps, with the impulse `M (u⁺ − u⁻) = Aᵀ Λ` that constraints
        then exert, without restitution where contacts are closed, except at those whose own terrain or ends jump. A
        function that is evaluated at a jump should return its value after it, as a state saved there does. Needs
        `Partition()` or `Projection()`, and a mass matrix that has an inverse, if there are constraints. A warning
        tells of jumps and kinks of drivers at other times, except under `jit`, `vmap` or a derivative.
    - `throw`: whether a motion that fails is an error. By default it is, but under `jit`, `vmap` or a derivative the
        motion is NaN instead, with a `result` that says why; with `True` it is an error there as well, by a call of
        Python from the program, which JAX then does not keep on disk (see `jaxmb.keep_compiled`). Under
        `equinox.filter_jit` the message stands alone; `jax.jit` adds a page of JAX's own.
    - `max_events`: the largest number of impacts and other events of contacts (`Stop`, `RigidContact`, …), whose times
        and states are kept: a motion that has more of them fails.
    - `event`, `max_steps` (an integer), `progress_meter`: as in `diffrax.diffeqsolve`. The function of an event also
        sees states between the ends of steps, as they are interpolated: off the constraints by about `rtol`. Where
        `max_steps` is reached the error says how far the motion came and, of `Adams` and Runge–Kutta solvers, whether
        it is stiff there, for which some more steps are simulated; not under `jit`, `vmap` or a derivative. A
        derivative keeps at most 2048 steps. One of more steps needs a program that also finds steps again, which takes
        a fifth longer to compile. Under `jit` and `vmap` every derivative with a larger `max_steps` has it; otherwise
        one whose motion turns out to be long is computed again with it, and for the system from then on.

    **Returns:** a `Trajectory`.

    **Raises:** `ValueError` for arguments of the wrong type or out of range, for combinations that cannot work, and for
    a state that violates the constraints (of other parameters, another system, another time), unless the manifold lets
    states drift; under a trace such a run fails instead, with `RESULTS.assembly_failed`;
    `RuntimeError`, unless `throw=False`, when the integration fails: the text of its `RESULTS` says how. Without it the
    trajectory up to there is kept, with times and states of infinity after it. Under `jit`, `vmap` or a derivative,
    where nothing can be kept for some members of a batch only, a motion that fails is NaN as a whole, and so
    are its derivatives with respect to every input; its `ts`, `stats` and `result` say how far it came, and the other
    members are as if it were not there.

    Derivatives are taken on the mesh of the run, which is integrated once: steps are linear maps of tangents, and all
    modes are the same numbers. `Adams` linearises the equations once a step, at its end: that is a discretisation of
    the tangent equation of the same order as the method. Other solvers are differentiated as they step. Both converge
    with the tolerance to the true derivatives. Times have first and second derivatives as well, and no third ones:
    `t0`, `t1`, saved times, that of an event, and, with `Adams`, those of `jumps`. Second derivatives are those of
    first ones in forward mode (`jax.hessian`, or `jax.jacfwd` of `jax.grad`), of runs of which all steps are kept.

    Contacts (`Stop`, `RigidContact`, `Slack`, …) close and open, and `DryFriction` sticks and slips, at events, at
    which a step ends: `Trajectory.events` lists them. An event is found to a thousandth of `rtol`, relative to the size
    of the system; bounces that are lower than `rtol` are left out, and the contact stays closed. Dry friction in joints
    that it loads then rubs earlier than it would, by a time of the size of √`rtol` s, and velocities err by what it
    changes in that time: several hundred `rtol`, seen. Derivatives are those of a motion whose events move with the
    parameters, while their sequence stays: the time of an impact has a derivative, its number has none.
    After each event multistep methods start again with short steps: with many impacts Runge–Kutta solvers take fewer.
    Gaps and forces of contacts are looked at in the middle of each step as well as at its ends. What comes and goes
    between these is not seen, as a lone bump below a body in free flight: bound the steps there, with `dtmax=0.01`.

    Compliant contacts and stops (`DiscContact`, `JointStop`, `Tyre`, …) have no events. Their gaps are followed along
    each step, so that none closes and opens again within it unseen; a step that would hide that is tried again up to
    where the gap is most closed. So it is with a `Force` that has a `gap`, and with parts that have `gaps`. The ground
    of a `jaxmb.terrain.Surface` may rise and fall unseen where a body passes a hill within an eighth of a step.

    A mesh that resolves a motion need not resolve its derivatives: those of a fast mode at rest would grow from
    step to step, and a force whose strength is zero, as a control at the start of an optimisation, is seen by its
    derivative only. So a run that is differentiated also controls, at five times `rtol`, the errors of tangents of the
    state: where it is differentiated by the state, of one from a start that excites all modes; where by parameters, of
    the one that they cause together, each changed by its own size, or by one where it is zero. Its values differ within
    the tolerance from those of the same run without derivatives. An effect that is much smaller than that of other
    parameters is resolved relative to theirs; `direction={"kick.strength": 1.0}` watches that of this change instead.
    Where a force sets in almost at once, as in an impact, derivatives are less accurate than the motion: for a ball on
    a stiff floor their error is about 5000 `rtol`. Compare them with those of a tolerance that is a hundred times
    tighter. A controller of the user's is treated in the same way if it is, or wraps, a `MultistepController` or a
    `diffrax.PIDController`; others choose the same steps with and without derivatives, and so does
    `diffrax.diffeqsolve` when it is called directly.
    """
    check_kind("system", system, AbstractSystem, "a compiled system", "scene.compile() makes one of a jaxmb.Scene")
    check_precision("simulate", system)
    system = system if inputs is None else with_inputs(system, inputs)
    state = checked_state(system, state)
    # Numbers become arrays, so that other tolerances and times do not compile anew.
    relative, absolute = checked_tolerances(rtol, atol, state)
    times = checked_times(t0, t1, dt0, state.q.dtype)
    check_steps(max_steps)
    check_steps(max_events, "max_events")
    method = named_solver(solver) if isinstance(solver, str) else _ADAMS if solver is None else solver
    check_kinds(method, formulation, manifold, stepsize_controller, adjoint, event, progress_meter)
    check_fixed_steps(method, stepsize_controller)
    longest = checked_longest_step(dtmax, stepsize_controller, method, state.q.dtype)
    restarts = checked_jumps(jumps, input_break_times(system, times["t0"], times["t1"]))
    saved = with_end(checked_saveat(saveat, times["t0"], times["t1"]), times["t0"], state)
    first = saved.subs[0]
    if error:
        check_error_estimate(first.steps, stepsize_controller, event, relative)
    others = {
        "formulation": formulation,
        "manifold": manifold,
        "solver": method,
        "controller": stepsize_controller,
        "rtol": relative,
        "atol": absolute,
        "dtmax": longest,
        "times": times,
        "saveat": saved,
        "restarts": restarts,
        "event": captured_event(event, times["t0"], state),
        "changes": {} if direction is None else parameter_changes(system, direction),
    }
    traced = is_traced((system, state, others))
    if traced and solver == "switch":
        raise ValueError(
            "solver='switch' looks at a motion before it decides, which it cannot under jit, vmap or grad. Simulate "
            "once with solver='auto', outside, and then choose Adams() or Hermite()."
        )
    others["stops"] = stops_of(system, state, times, stepsize_controller, traced)
    if not traced and adjoint is None:
        others["saveat"] = padded(saved, times["t0"], times["t1"])
    taken = derivatives_of((system, state, others)) if traced else None
    orders = () if taken is None else taken.orders[: len(jax.tree.leaves((system, state)))]
    if max(orders, default=0) > 1 and system.contacts is not None:
        raise ValueError(NO_SECOND_DERIVATIVES)
    # Where values are known, so is after it how many steps a motion took.
    known = not traced or (taken is not None and taken.known)
    tries = traced and known and jax.tree.structure((system, method)) not in _long
    rooms = [max_steps] if adjoint is not None else rooms_for(max_steps, saved, state, traced, tries)
    problem = Problem(
        system=system,
        state=state,
        **others,
        adjoint=adjoint,
        limit=np.asarray(min(max_steps, rooms[0])),
        max_events=max_events,
        room=rooms[0],
        progress_meter=_NO_METER if progress_meter is None else progress_meter,
        interpolated=event is not None or first.ts is not None,
        traced=traced,
        differentiated=tuple(order > 0 for order in orders) if any(orders) else (),
        # As they were given: under a trace the times of a SaveAt that is made here are traced as well.
        moving=(may_move(times["t0"]), may_move((times["t1"], saveat))),
    )
    backward = not is_traced((times["t0"], times["t1"])) and times["t1"] < times["t0"]
    if backward and system.contacts is not None:
        raise ValueError(f"Impacts cannot be undone: with contacts t1 must be after t0, got {t0} and {t1}.")

    def run(problem):
        if not known:
            return *solved(problem), None
        with contextlib.nullcontext() if traced else told_of_compiling(system):
            trajectory, outcome = solved(problem)
            if is_traced(outcome.flags) and not traced:
                raise ValueError(_HIDDEN)
            for room in rooms[1:]:
                # A value that is traced and hidden in a function leaves it open whether the steps sufficed.
                if not is_traced(outcome.flags) and not Flags(*np.asarray(outcome.flags)).ran_out:
                    break
                problem = problem._replace(room=room, limit=np.asarray(min(max_steps, room)))
                trajectory, outcome = solved(problem)
            if problem.room < max_steps:
                trajectory = eqx.tree_at(lambda own: own.stats["max_steps"], trajectory, np.asarray(max_steps))
            if is_traced(outcome.flags):
                return trajectory, outcome, None
            flags = Flags(*np.asarray(outcome.flags))
            if flags.wrong_derivative:
                warn_of_wrong_derivative()
            structure = jax.tree.structure((system, problem.solver))
            if flags.long and structure not in _long:
                _long.append(structure)
            return trajectory, outcome, None if traced else flags

    trajectory, outcome, flags = run(problem)
    if solver == "switch" and trajectory.stats["stiff"]:
        found = {name: trajectory.stats[name] for name in ("stiff", "stiff_steps")}
        problem = problem._replace(solver=Hermite())
        trajectory, outcome, flags = run(problem)
        trajectory = eqx.tree_at(lambda trajectory: trajectory.stats, trajectory, trajectory.stats | found)
    if solver == "auto":
        warn_of_stiffness(trajectory.stats)
    given = {"formulation": formulation, "manifold": manifold, "dtmax": dtmax, "jumps": jumps, "max_events": max_events}
    again = functools.partial(simulate, t1=t1, **given, throw=False)
    if flags is not None:
        if flags.inconsistent:
            consistent(system, times["t0"], state)
        if flags.stuck:
            result, coupling = made_precise(problem, trajectory.result, outcome)
            if result == RESULTS.newton_failed and lost_rank(system.at(outcome.y), outcome.t, outcome.y) is not None:
                # Elimination in blocks does not tell.
                result = RESULTS.singular_configuration
            trajectory = eqx.tree_at(lambda trajectory: trajectory.result, trajectory, result)
            outcome = outcome._replace(coupling=coupling)
        if not system.drift_free and system.acceleration_rows > 0:
            warn_of_jumps(system, outcome, times, restarts, jumps)
        if flags.failed and throw is not False:
            # Other runs of the same motion.
            on = functools.partial(again, system, outcome.y, t0=outcome.t, rtol=relative)
            # What was chosen for another method need not serve the one that looks for stiffness.
            own = {"formulation": None, "manifold": None} if problem.policy.restores else {}
            probe = lambda solver, steps: on(solver=solver, max_steps=steps, atol=absolute, **own)
            text = message_of_failure(
                system, trajectory.result, times, outcome, trajectory.stats, problem.solver, probe
            )
            raise RuntimeError(text)
        if not flags.whole:
            trajectory = trajectory.trimmed()
    else:
        trajectory = trajectory.trimmed()
        if throw:
            trajectory = trajectory.result.error_if(trajectory, outcome.flags[0])
    if error:
        closer = closer_tolerances(problem.solver, relative, absolute)
        second = again(
            *(lax.stop_gradient((system, state)) if traced else (system, state)),
            t0=t0,
            dt0=dt0,
            saveat=saveat,
            solver=problem.solver,
            rtol=closer[0],
            atol=closer[1],
            adjoint=adjoint,
            max_steps=max_steps,
        )
        trajectory = eqx.tree_at(lambda t: t.closer, trajectory, second, is_leaf=lambda leaf: leaf is None)
    return trajectory
