"""From a system and a state to a motion."""

import warnings
from collections.abc import Mapping
from typing import Any, Literal

import diffrax
import equinox as eqx
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import ArrayLike

from .._arguments import check_kind
from .._results import RESULTS
from .._types import Scalar, State, VectorLike
from ..formulations import AbstractFormulation
from ..linalg.arrays import is_traced
from ..linalg.failure import nan_where
from ..manifold import AbstractManifold, default_manifold, with_internal_states
from ..parts.names import names_arguments
from ..solvers import AbstractMultistep, Adams, Hermite, MultistepController, OneStepController
from ..states.consistency import consistent
from ..system import AbstractSystem
from ..system.inputs import Signals, check_inputs, input_break_times, with_inputs
from ..system.parameters import with_parameters
from ..trajectory import Trajectory
from .arguments import (
    DEFAULT_RTOL,
    KINDS,
    check_error_estimate,
    checked_jumps,
    checked_saveat,
    checked_state,
    checked_times,
    checked_tolerances,
    named_solver,
    parameter_changes,
    with_end,
)
from .outcome import about_friction, about_steps, is_stiff_at_end, reason_of_failure, warn_of_jumps
from .solve import integrate, running_scales

# Reverse mode keeps this many steps, fewer where they do not fit in this many bytes, and recomputes beyond.
_CHECKPOINTS = 4096
_CHECKPOINT_BYTES = 2**28


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
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    inputs: Signals | None = None,
    jumps: ArrayLike | None = None,
    event: diffrax.Event | None = None,
    direction: Mapping[str, VectorLike] | None = None,
    error: bool = False,
    max_steps: int = 65536,
    throw: bool = True,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
) -> Trajectory:
    """Integrate the motion of a system.

    **Main arguments:**

    - `system`, `state`: a compiled scene and a consistent state of it, from `assemble`.
    - `t0`, `t1`: the interval [s]; `t1 < t0` runs backwards.
    - `saveat`: times to save at [s], or a `diffrax.SaveAt`; default only `t1`. `SaveAt(dense=True)` allows
        `Trajectory.at(t)`.
    - `rtol`, `atol`: tolerances. `Adams` and `Hermite` let a step err by a twentieth of them, as errors add up: the
        error of the result, relative to the largest coordinates and velocities, is then mostly below `rtol`; some ten
        times `rtol` over many periods, more where neighbouring motions part quickly, and about the same as that of
        `diffrax.Dopri8()`; `error=True` estimates it. Near rounding the part grows, up to all of it: steps are not
        asked for less than 4e-14 (`Adams`) or 1e-11 (`Hermite`). `atol` defaults to one hundredth of `rtol`, times the
        largest coordinate (in units of the machine's size, or radians) and the largest velocity so far, so that the
        units do not matter and slow or small motions are as accurate as others; internal states count by kinds, each
        with its largest value, at least 1e-4 of its typical size. A number is in SI units; it may be a vector of one
        for each coordinate, velocity and internal state, (nq + nu + nz,): where stiff springs vibrate too little to
        matter in positions, a coarser one for velocities saves most of the steps of `Hermite`.

    - `inputs`: parameters as functions of time, by name: `{"motor.torque": jaxmb.Series(ts, torques)}`, or a function
        of t; see `with_inputs`, which also `assemble` needs where a driver has such an input. The solver restarts where
        a held series jumps and, if constraints depend on it, at every time of a linear one.

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
    - `stepsize_controller`: instead of `rtol` and `atol`; a `MultistepController` for `Adams` and `Hermite`.
    - `adjoint`: how to differentiate. Default reverse mode, with up to 4096 steps (at most 256 MB) kept and none of
        them computed twice. For few parameters forward mode is faster and needs no memory: `jax.jacfwd` with
        `adjoint=diffrax.ForwardMode()`.
    - `direction`: parameters by name with a change of each, for runs that are differentiated; see below.
    - `error`: whether to estimate the global error of the result, `Trajectory.error`, by a second run at a tenth of the
        tolerances; both together take two to two and a half times as long as one, and nothing more to compile.
    - `jumps`: times [s] at which drivers or forces have kinks or jumps, a vector. The solver stops just before each,
        and restarts just after it; where a driver's rate jumps, with the impulse `M (u⁺ − u⁻) = Aᵀ Λ` that constraints
        then exert. A function that is evaluated at a jump should return its value after it, as a state saved there
        does. Needs `Partition()` or `Projection()`, and a mass matrix that has an inverse, if there are constraints.
        A warning tells of jumps and kinks of drivers at other times, except under `jit`, `vmap` or a derivative.
    - `event`, `max_steps`, `throw`, `progress_meter`: as in `diffrax.diffeqsolve`. Where `max_steps` is reached the
        error says how far the motion came and, of `Adams` and Runge–Kutta solvers, whether it is stiff there, for which
        some more steps are simulated; not under `jit`, `vmap` or a derivative.

    **Returns:** a `Trajectory`.

    **Raises:** `ValueError` for arguments of the wrong type or out of range, for combinations that cannot work, and for
    a state that violates the constraints (of other parameters, another system, another time), unless the manifold lets
    states drift; under a trace such a run fails instead, with `RESULTS.assembly_failed`;
    `RuntimeError`, if `throw`, when the integration fails: the text of its `RESULTS` says how. With `throw=False` the
    trajectory up to there is kept, with times and states of infinity after it. Under `jit`, `vmap` or a derivative,
    where nothing can be kept for some members of a batch only, a motion that fails is not a number as a whole, and so
    are its derivatives with respect to every input; its `ts`, `stats` and `result` say how far it came, and the other
    members are as if it were not there.

    Derivatives are those of the discrete solution with its mesh frozen; they converge with the tolerance to the true
    ones. A mesh that resolves a motion need not resolve its derivatives: those of a fast mode at rest would grow from
    step to step. So a run that is differentiated also controls the error of a tangent of the state, from a start that
    excites all modes, at ten times `rtol`; its values differ within the tolerance from those of the same run without
    derivatives. A parameter that excites a mode late, after the tangent has died away, needs its `direction`:
    `{"kick.strength": 1.0}` adds the effect of this change to the tangent. Where a force sets in almost at once, as in
    an impact, derivatives are less accurate than the motion: for a ball on a stiff floor their error is about
    5000 `rtol`. Compare them with those of a tolerance that is a hundred times tighter. A controller of the user's is
    treated in the same way if it is, or wraps, a `MultistepController` or a `diffrax.PIDController`; others choose the
    same steps with and without derivatives, and so does `diffrax.diffeqsolve` when it is called directly.
    """
    check_kind("system", system, AbstractSystem, "a compiled system", "scene.compile() makes one of a jaxmb.Scene")
    if inputs is not None:
        system = with_inputs(system, inputs)
    state = checked_state(system, state)
    # Numbers become arrays, so that other tolerances and times do not compile anew.
    relative, absolute = checked_tolerances(rtol, atol, state)
    options = checked_times(t0, t1, dt0, state.q.dtype)
    if not isinstance(max_steps, int | np.integer) or max_steps < 1:
        raise ValueError(f"max_steps must be an integer of at least 1, got {max_steps!r}.")
    choice = solver
    solver = named_solver(solver, state) if isinstance(solver, str) else Adams() if solver is None else solver
    given = (solver, formulation, manifold, stepsize_controller, adjoint, event, progress_meter)
    for (name, (kind, example)), value in zip(KINDS.items(), given, strict=True):
        if value is not None:
            check_kind(name, value, kind, f"an object such as {example}", "leave it out for the default")
    if error:
        check_error_estimate(saveat, stepsize_controller, event)
    if stepsize_controller is None:
        scales = running_scales(system, state, options) if atol is None else None
        if isinstance(solver, AbstractMultistep):
            stepsize_controller = MultistepController(relative, absolute, scales=scales)
        else:
            stepsize_controller = OneStepController.around(diffrax.PIDController(relative, absolute), scales)
    check_inputs(system, options["t0"], options["t1"])
    restarts = checked_jumps(jumps, input_break_times(system))
    if restarts is not None:
        adaptive: Any = stepsize_controller
        stepsize_controller = diffrax.ClipStepSizeController(adaptive, jump_ts=restarts)
    if adjoint is None:
        size = 16 * state.q.dtype.itemsize * (system.nq + system.nu + system.nz)
        kept = min(max_steps, _CHECKPOINTS, max(_CHECKPOINT_BYTES // size, 64))
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=kept)
    saved = checked_saveat(saveat, options["t0"], options["t1"])
    interpolated = event is not None or (saved.subs is not None and saved.subs.ts is not None)
    options |= {
        "y0": state,
        "saveat": with_end(saved),
        "stepsize_controller": stepsize_controller,
        "adjoint": adjoint,
        "event": event,
        "max_steps": max_steps,
        "progress_meter": diffrax.NoProgressMeter() if progress_meter is None else progress_meter,
    }

    changes = {} if direction is None else parameter_changes(system, direction)
    valid = system.parameters_in_range()

    def prepare(system, solver, policy, method):
        term, prepared = policy.prepare(system, method, solver, relative)
        return with_internal_states(term), prepared

    def motion(solver):
        policy = default_manifold(system, solver, formulation) if manifold is None else manifold
        jumping = restarts is not None and system.velocity_rows > 0
        if jumping and not (policy.takes_impulses and system.positive_definite_mass):
            raise ValueError(
                "With jumps, or inputs that jump, a constrained system needs manifold=Partition() or Projection(), and "
                f"a mass matrix that has an inverse; got {type(policy).__name__}() and positive_definite_mass = "
                f"{system.positive_definite_mass}."
            )
        method = policy.default_formulation(system) if formulation is None else formulation
        term, prepared = prepare(system, solver, policy, method)
        start = consistent(system, options["t0"], state) if policy.restores else state
        along = None
        if direction is not None:
            moved = lambda step: with_parameters(system, {k: at + step * x for k, (at, x) in changes.items()})
            changed = lambda step: prepare(moved(step), solver, policy, method)[0]
            along = eqx.filter_jvp(changed, (0.0,), (1.0,))[1]
        own = options | {"y0": start}
        return integrate(system, method, policy, term, prepared, own, interpolated, along, valid)

    def probe(solver, steps):
        with warnings.catch_warnings():
            # This motion's own are said already.
            warnings.simplefilter("ignore")
            return simulate(
                *lax.stop_gradient((system, outcome.y)),
                t0=outcome.t,
                t1=t1,
                solver=solver,
                formulation=formulation,
                manifold=manifold,
                rtol=relative,
                atol=None if atol is None else absolute,
                jumps=jumps,
                max_steps=steps,
                throw=False,
            )

    used = solver
    trajectory, outcome = motion(solver)
    if choice == "switch" and trajectory.stats["stiff"]:
        found = {name: trajectory.stats[name] for name in ("stiff", "stiff_steps")}
        used = Hermite()
        trajectory, outcome = motion(used)
        trajectory = eqx.tree_at(lambda trajectory: trajectory.stats, trajectory, trajectory.stats | found)
    if choice == "auto" and not isinstance(trajectory.stats["stiff"], Tracer) and trajectory.stats["stiff"]:
        warnings.warn(
            f"The motion is stiff: in {trajectory.stats['stiff_steps']} of {trajectory.stats['num_steps']} steps of "
            "Adams' method stability was the limit. simulate(..., solver=jaxmb.solvers.Hermite()) takes longer ones.",
            stacklevel=2,
        )
    prescribed = system.acceleration_rows > 0 and not system.drift_free
    if prescribed and not is_traced((system, outcome.y, options["t0"], options["t1"], restarts)):
        warn_of_jumps(system, outcome.y.q, options["t0"], options["t1"], restarts, jumps)
    failed = outcome.failed
    if throw and not isinstance(failed, Tracer) and failed:
        outcome, stats = lax.stop_gradient((outcome, trajectory.stats))
        if np.any(outcome.coupling):
            reason = about_friction(system, outcome.coupling)
        elif trajectory.result == RESULTS.max_steps_reached and not is_traced((system, outcome, options["t1"], rtol)):
            reason = about_steps(outcome, options["t1"], stats, is_stiff_at_end(probe, stats, used))
        else:
            reason = reason_of_failure(system, trajectory.result, options["t1"], outcome)
        raise RuntimeError(reason)
    if is_traced((failed, trajectory.ys)):
        # A derivative would be that of the part before the failure. The error goes with the value, and not with a
        # derivative that is taken alone.
        motion_of = lambda trajectory: [trajectory.ys, trajectory.interpolation]
        spoiled = nan_where(failed, motion_of(trajectory), (system, state, options, formulation, manifold))
        trajectory = eqx.tree_at(motion_of, trajectory, spoiled, is_leaf=lambda leaf: leaf is None)
        if throw:
            trajectory = trajectory.result.error_if(trajectory, failed)
    if error:
        closer = simulate(
            *lax.stop_gradient((system, state)),
            t0=t0,
            t1=t1,
            dt0=dt0,
            saveat=saveat,
            solver=used,
            rtol=relative / 10,
            atol=None if atol is None else absolute / 10,
            formulation=formulation,
            manifold=manifold,
            adjoint=adjoint,
            jumps=jumps,
            max_steps=max_steps,
            throw=False,
        )
        trajectory = eqx.tree_at(lambda t: t.closer, trajectory, closer, is_leaf=lambda leaf: leaf is None)
    return trajectory.trimmed()
