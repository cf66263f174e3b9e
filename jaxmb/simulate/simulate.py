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
from ..contacts.impact import NO_SECOND_DERIVATIVES
from ..formulations import AbstractFormulation
from ..linalg.arrays import derivatives_of, is_traced
from ..manifold import AbstractManifold
from ..parts.names import names_arguments
from ..solvers import Adams, Hermite
from ..states.arguments import check_precision
from ..states.consistency import consistent
from ..states.refusals import lost_rank
from ..system import AbstractSystem
from ..system.inputs import Signals, with_inputs
from ..trajectory import Trajectory
from .arguments import (
    DEFAULT_RTOL,
    breaks_of,
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

    The first call for a system compiles a program, which takes seconds. Later ones with other numbers, times and
    tolerances do not. `jax.jit` is not needed: it compiles the motion anew, as a part of its function.

    `jaxmb help` has more on `tolerances`, `derivatives`, `contacts`, `inputs`, `throw` (motions that
    fail) and `large-scenes`.

    **Main arguments:**

    - `system`, `state`: a compiled scene and a consistent state of it, from `assemble`.
    - `t0`, `t1`: the interval [s]; `t1 < t0` runs backwards.
    - `saveat`: times to save at [s], or a `diffrax.SaveAt`; default only `t1`. `SaveAt(dense=True)` allows
        `Trajectory.at(t)`. A function, `SaveAt(ts=times, fn=function)`, sees states on the constraints.
    - `rtol`, `atol`: tolerances of the errors of steps. The error of the result, relative to the largest coordinates
        and velocities, is mostly below `rtol`. `atol` is a number or a vector (nq + nu + nz,) in SI units; its default
        follows the motion.
    - `inputs`: parameters as functions of time [s], by name: `{"motor.torque": jaxmb.Series(ts, torques)}`, or a
        function; see `with_inputs`.

    **Other arguments, rarely needed:**

    - `solver`: default `Adams()`; for stiff motions `Hermite()`; any diffrax Runge–Kutta solver. `"auto"` is `Adams`,
        which warns of stiff motions; `"switch"` simulates these again with `Hermite`, not under a trace.
    - `formulation`: how accelerations are solved for, `Partitioned()`, `Multipliers()`, `NullSpace()`, …; default by
        the scene.
    - `manifold`: how the state stays on the constraints, `Partition()`, `Projection()` or others; default by the scene.
    - `dt0`: first step [s], default chosen from the motion. `dtmax`: longest step [s], default none.
    - `stepsize_controller`: instead of `rtol` and `atol`; a `MultistepController` for `Adams` and `Hermite`.
    - `adjoint`: how to differentiate instead, one of diffrax's.
    - `direction`: parameters by name with a change of each, whose effect steps resolve where a run is differentiated;
        default all that derivatives are taken by. `{}` leaves the steps of the motion alone.
    - `error`: whether to estimate the global error of the result, `Trajectory.error`, by a second run.
    - `jumps`: times [s] at which drivers or forces have kinks or jumps, a vector; the solver restarts there.
    - `event`, `progress_meter`: as in `diffrax.diffeqsolve`. The function of an event sees states between the ends of
        steps as they are interpolated, off the constraints by about `rtol`.
    - `max_steps`: the largest number of steps. `max_events`: that of impacts and other events of contacts.
    - `throw`: whether a motion that fails is an error. By default it is, but under `jit`, `vmap` or a derivative the
        motion is NaN instead.

    **Returns:** a `Trajectory`. With `throw=False` it has the part of the motion before a failure, and `result` says
    why it failed; under a trace it is NaN.

    **Raises:** `ValueError` for arguments of the wrong type or out of range, for combinations that cannot work, and for
    a state that violates the constraints, unless the manifold lets states drift; `RuntimeError`, unless `throw=False`,
    when the integration fails.
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
    restarts = checked_jumps(jumps, breaks_of(system, times))
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
        "changes": None if direction is None else parameter_changes(system, direction),
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
    if max(orders, default=0) > 1 and system.contacts:
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
    if backward and system.contacts:
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
