"""From a system and a state to a motion."""

import warnings
from collections.abc import Mapping
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import ArrayLike

from ._results import RESULTS
from ._types import Scalar, State, VectorLike
from .formulations import AbstractFormulation
from .formulations.friction import coupled_most
from .linalg.arrays import as_array, is_traced
from .linalg.failure import not_a_number_where
from .manifold import AbstractManifold, default_manifold, find_jump
from .manifold.diagnosis import diagnose_friction
from .parts.names import unknown
from .solvers import AbstractMultistep, Adams, Hermite, MultistepController
from .solvers._one_step import OneStepController, with_tangents
from .solvers._scales import RunningScales
from .solvers._tangent import TangentControl
from .states.consistency import consistent, contradiction
from .system import AbstractSystem
from .system.arguments import check_kind, real_array
from .system.parameters import parameters, with_parameters
from .trajectory import Trajectory

# Reverse mode keeps this many steps, fewer where they do not fit in this many bytes, and recomputes beyond.
_CHECKPOINTS = 4096
_CHECKPOINT_BYTES = 2**28

_KINDS: dict[str, tuple[type, str]] = {
    "solver": (diffrax.AbstractSolver, "jaxmb.solvers.Adams() or diffrax.Tsit5()"),
    "formulation": (AbstractFormulation, "jaxmb.formulations.Multipliers()"),
    "manifold": (AbstractManifold, "jaxmb.manifold.Partition()"),
    "stepsize_controller": (diffrax.AbstractStepSizeController, "jaxmb.solvers.MultistepController(rtol, atol)"),
    "adjoint": (diffrax.AbstractAdjoint, "diffrax.ForwardMode()"),
    "event": (diffrax.Event, "diffrax.Event(function)"),
    "progress_meter": (diffrax.AbstractProgressMeter, "diffrax.TqdmProgressMeter()"),
}


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
    rtol: Scalar = 1e-8,
    atol: ArrayLike | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
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
        error of the result, relative to the largest coordinates and velocities, is then mostly below `rtol`; up to ten
        times `rtol` over many periods or where neighbouring motions part quickly, and about the same as that of
        `diffrax.Dopri8()`; `error=True` estimates it. Near rounding the part grows, up to all of it: steps are not
        asked for less than 4e-14 (`Adams`) or 1e-12 (`Hermite`). `atol` defaults to one hundredth of `rtol`, times the
        largest coordinate (in units of the machine's size, or radians) and the largest velocity so far, so that the
        units do not matter and slow or small motions are as accurate as others. A number is in SI units; it may be a
        vector of one for each coordinate and velocity, (nq + nu,): where stiff springs vibrate too little to matter in
        positions, a coarser one for velocities saves most of the steps (`stiff_four_bar` to a position error of 1e-6:
        93 steps of `Hermite` with 1e-3 m/s and rad/s instead of 1989).

    **Other arguments, rarely needed:**

    - `solver`: default `Adams()`; for stiff motions `Hermite()`; any diffrax Runge–Kutta solver. `"auto"` is
        `Adams`, which also detects whether stability instead of accuracy limits its steps: `stats["stiff"]`, and in how
        many steps, `stats["stiff_steps"]`; a warning then advises `Hermite`. With `"switch"` a motion that is detected
        to be stiff is simulated again from `t0` with `Hermite`; not under `jit`, `vmap` or `grad`.
    - `formulation`: how accelerations are solved for. Default `Partitioned()` with a `Partition`; otherwise
        `Multipliers()`, which needs no search for pivots, or `NullSpace()` where the mass matrix is singular.
    - `manifold`: how the state stays on the constraints. Default `Partition()` for `Adams` and `Hermite`, and
        `Projection()` for other solvers; a system without constraints needs neither. For `Adams` on a planar scene
        with 30 or more constraint rows whose joints form a chain the default is `Projection()` as well, whose cost
        grows with the number of joints and not with its cube.
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
        Without any, a warning tells of a jump or kink of a driver, except under `jit`, `vmap` or a derivative.
    - `event`, `max_steps`, `throw`, `progress_meter`: as in `diffrax.diffeqsolve`.

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
    `{"kick.strength": 1.0}` adds the effect of this change to the tangent. A controller of the user's is treated in the
    same way if it is, or wraps, a `MultistepController` or a `diffrax.PIDController`; others choose the same steps with
    and without derivatives, and so does `diffrax.diffeqsolve` when it is called directly.
    """
    check_kind("system", system, AbstractSystem, "a compiled system", "scene.compile() makes one of a jaxmb.Scene")
    state = _checked_state(system, state)
    # Numbers become arrays, so that other tolerances and times do not compile anew.
    relative, absolute = _tolerances(rtol, atol, state)
    options = _times(t0, t1, dt0, state.q.dtype)
    if not isinstance(max_steps, int | np.integer) or max_steps < 1:
        raise ValueError(f"max_steps must be an integer of at least 1, got {max_steps!r}.")
    choice = solver
    solver = _named(solver, state) if isinstance(solver, str) else Adams() if solver is None else solver
    given = (solver, formulation, manifold, stepsize_controller, adjoint, event, progress_meter)
    for (name, (kind, example)), value in zip(_KINDS.items(), given, strict=True):
        if value is not None:
            check_kind(name, value, kind, f"an object such as {example}", "leave it out for the default")
    if error:
        _check_error_estimate(saveat, stepsize_controller, event)
    if stepsize_controller is None:
        scales = _running_scales(system, state, options) if atol is None else None
        if isinstance(solver, AbstractMultistep):
            stepsize_controller = MultistepController(relative, absolute, scales=scales)
        else:
            stepsize_controller = OneStepController.around(diffrax.PIDController(relative, absolute), scales)
    if jumps is not None:
        adaptive: Any = stepsize_controller
        stepsize_controller = diffrax.ClipStepSizeController(adaptive, jump_ts=_jump_times(jumps))
    if adjoint is None:
        size = 16 * state.q.dtype.itemsize * (system.nq + system.nu)
        kept = min(max_steps, _CHECKPOINTS, max(_CHECKPOINT_BYTES // size, 64))
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=kept)
    saved = _save_at(saveat, options["t0"], options["t1"])
    interpolated = event is not None or (saved.subs is not None and saved.subs.ts is not None)
    options |= {
        "y0": state,
        "saveat": _with_end(saved),
        "stepsize_controller": stepsize_controller,
        "adjoint": adjoint,
        "event": event,
        "max_steps": max_steps,
        "progress_meter": diffrax.NoProgressMeter() if progress_meter is None else progress_meter,
    }

    changes = {} if direction is None else _changes(system, direction)
    valid = system.parameters_in_range()

    def motion(solver):
        policy = default_manifold(system, solver, formulation) if manifold is None else manifold
        jumping = jumps is not None and system.velocity_rows > 0
        if jumping and not (policy.takes_impulses and system.positive_definite_mass):
            raise ValueError(
                "With jumps, a constrained system needs manifold=Partition() or Projection(), and a mass matrix that "
                f"has an inverse; got {type(policy).__name__}() and positive_definite_mass = "
                f"{system.positive_definite_mass}."
            )
        method = policy.default_formulation(system) if formulation is None else formulation
        term, prepared = policy.prepare(system, method, solver, relative)
        start = consistent(system, options["t0"], state) if policy.restores else state
        along = None
        if direction is not None:
            moved = lambda step: with_parameters(system, {k: at + step * x for k, (at, x) in changes.items()})
            changed = lambda step: policy.prepare(moved(step), method, solver, relative)[0]
            along = eqx.filter_jvp(changed, (0.0,), (1.0,))[1]
        own = options | {"y0": start}
        try:
            return _integrate(system, method, policy, term, prepared, own, interpolated, along, valid)
        except TypeError as error:
            if "custom_vjp" not in str(error):
                raise
            raise TypeError(
                "The default adjoint serves reverse mode only: for jvp, jacfwd and linearize call "
                "simulate(..., adjoint=diffrax.ForwardMode())."
            ) from None

    used = solver
    trajectory, failed, end, coupling = motion(solver)
    if choice == "switch" and trajectory.stats["stiff"]:
        found = {name: trajectory.stats[name] for name in ("stiff", "stiff_steps")}
        used = Hermite()
        trajectory, failed, end, coupling = motion(used)
        trajectory = eqx.tree_at(lambda trajectory: trajectory.stats, trajectory, trajectory.stats | found)
    if choice == "auto" and not isinstance(trajectory.stats["stiff"], Tracer) and trajectory.stats["stiff"]:
        warnings.warn(
            f"The motion is stiff: in {trajectory.stats['stiff_steps']} of {trajectory.stats['num_steps']} steps of "
            "Adams' method stability was the limit. simulate(..., solver=jaxmb.solvers.Hermite()) takes longer ones.",
            stacklevel=2,
        )
    prescribed = system.acceleration_rows > 0 and not system.drift_free
    if jumps is None and prescribed and not is_traced((system, end, options["t0"], options["t1"])):
        _warn_of_jumps(system, end[1].q, options["t0"], options["t1"])
    if throw and not isinstance(failed, Tracer) and failed:
        reason = _about_friction(system, coupling) if np.any(coupling) else None
        raise RuntimeError(reason or _reason(system, trajectory.result, options["t1"], *lax.stop_gradient(end)))
    if is_traced((failed, trajectory.ys)):
        # A derivative would be that of the part before the failure. The error goes with the value, and not with a
        # derivative that is taken alone.
        motion_of = lambda trajectory: [trajectory.ys, trajectory.interpolation]
        spoiled = not_a_number_where(failed, motion_of(trajectory), (system, state, options, formulation, manifold))
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


def _check_error_estimate(saveat, stepsize_controller, event) -> None:
    """Refuse runs whose times a second run would not share."""
    if stepsize_controller is not None:
        raise ValueError(
            "error=True repeats the run at tighter tolerances: give rtol and atol, no stepsize_controller."
        )
    steps = isinstance(saveat, diffrax.SaveAt) and saveat.subs is not None and saveat.subs.steps
    if event is not None or steps:
        what = "an event" if event is not None else "SaveAt(steps=True)"
        raise ValueError(
            f"error=True compares two runs at the same times, which {what} does not have; give saveat=times."
        )


def _changes(system: AbstractSystem, direction: Mapping[str, VectorLike]) -> dict[str, tuple[Any, Any]]:
    """Values of parameters and their changes, by name."""
    known = parameters(system)
    if not isinstance(direction, Mapping):
        raise ValueError(f"direction must be a dictionary of parameters by name, got {direction!r}.")
    for name in direction:
        if name not in known:
            raise unknown("parameter", name, known)
    array = lambda name, x: real_array(f"direction[{name!r}]", x, known[name].dtype, (known[name].shape,))
    return {name: (known[name], array(name, x)) for name, x in direction.items()}


@eqx.filter_jit
def _integrate(system, formulation, manifold, term, solver, options, interpolated, direction, valid):
    start, first = options["y0"], options["saveat"].subs[0]
    finite = jnp.all(jnp.isfinite(start.q)) & jnp.all(jnp.isfinite(start.u)) & valid
    # From nowhere there is no step to take: the interval is empty, with every time that is asked for in it.
    at_once, times = lambda times: jnp.where(finite, times, options["t0"]), first.ts
    options = options | {"t1": at_once(options["t1"])}
    if times is not None:
        options["saveat"] = eqx.tree_at(lambda saveat: saveat.subs[0].ts, options["saveat"], at_once(times))
    solution: Any = _solve(term, solver, options, _tangent_control(system, options, direction))
    ts, saved = solution.ts[0], solution.ys[0]
    if times is not None:
        ts = jnp.where(finite, ts, jnp.inf)
    correction = manifold.correction(interpolated)
    # `SaveAt(fn=...)` may save something else than states.
    are_states = jax.tree.structure(saved) == jax.tree.structure(options["y0"])
    if are_states and correction is not None:
        saved = _corrected(system, ts, saved, correction)
    end = solution.ts[1][-1], jax.tree.map(lambda y: y[-1], solution.ys[1])
    result = RESULTS.promote(solution.result)
    result = RESULTS.where(finite, result, RESULTS.assembly_failed)
    if valid is not True:
        result = RESULTS.where(valid, result, RESULTS.invalid_parameters)
    stuck = _failed(result) & finite
    result = manifold.diagnose(system, *end, solution.solver_state, result, stuck)
    coupling = None
    if system.friction_parts:
        result, coupling = diagnose_friction(system, formulation, *end, result, stuck)
    stats = dict(solution.stats)
    if isinstance(solver, AbstractMultistep):
        stats |= solver.statistics(solution.solver_state, solution.controller_state, stats)
    trajectory = Trajectory(
        system=system,
        formulation=formulation,
        ts=ts,
        ys=saved,
        stats=stats | manifold.statistics(solution.solver_state),
        result=result,
        interpolation=solution.interpolation,
        event_mask=solution.event_mask,
    )
    return trajectory, _failed(result), end, coupling


@eqx.filter_custom_jvp
def _solve(term, solver, options, control):
    """The solution, whose mesh resolves the motion; where it is differentiated, a tangent as well."""
    del control
    return diffrax.diffeqsolve(term, solver, throw=False, **options)


@_solve.def_jvp
def _solve_jvp(primals, tangents):
    arguments, control = primals[:-1], primals[-1]

    def solve(term, solver, options):
        solver, controller, without_tangents = with_tangents(solver, options["stepsize_controller"], control)
        solution = diffrax.diffeqsolve(term, solver, throw=False, **options | {"stepsize_controller": controller})
        return eqx.tree_at(lambda s: s.solver_state, solution, replace_fn=without_tangents)

    return eqx.filter_jvp(solve, arguments, tangents[:-1])


def _tangent_control(system, options, direction) -> TangentControl:
    """What is known of the sizes of a tangent: those of the coordinates, and of the velocities in the time that the
    motion takes.
    """
    state, span = options["y0"], jnp.abs(options["t1"] - options["t0"])
    coordinates, velocities = system.coordinate_scale(), system.velocity_scale()
    rate = jnp.maximum(jnp.max(jnp.abs(state.u) / velocities, initial=0.0), 1 / jnp.where(span > 0, span, 1.0))
    units = jnp.concatenate([coordinates, velocities * rate]).astype(state.q.dtype)
    blocks = (0, system.nq), (system.nq, system.nq + system.nu)
    return lax.stop_gradient(TangentControl(units, blocks, direction))


def _running_scales(system, state, options) -> RunningScales:
    """Natural units of coordinates and velocities; where nothing moves yet, one unit in the whole time."""
    units = jnp.concatenate([system.coordinate_scale(), system.velocity_scale()]).astype(state.q.dtype)
    span = jnp.abs(options["t1"] - options["t0"])
    return lax.stop_gradient(RunningScales(units, system.nq, 1 / jnp.where(span > 0, span, 1.0)))


def _about_friction(system, coupling) -> str:
    own = system.friction_rows[coupled_most(np.asarray(coupling))]
    names = ", ".join(dict.fromkeys(repr(system.rows[k][0]) for k in own))
    return (
        f"The friction of {names} came to a singular configuration: its force changes the reaction that it depends on "
        "so much that there is no solution, or more than one (Painlevé's paradox). A smaller coefficient or a "
        "compliant contact has one. With `throw=False` the motion up to there is kept."
    )


def _failed(result) -> Any:
    return ~((result == RESULTS.successful) | (result == RESULTS.event_occurred))


def _warn_of_jumps(system, q, t0, t1) -> None:
    t, row, found = find_jump(system, q, t0, t1)
    if found:
        # The rows of ψ, then those of A.
        name = (*system.rows[: system.velocity_rows], *system.rows)[int(row)][0]
        warnings.warn(
            f"The motion that {name!r} prescribes has a jump or a kink at t = {float(t):.6g}, which an integration "
            f"passes without an impulse or in many steps; simulate(..., jumps=[{float(t):.6g}]) restarts there.",
            stacklevel=3,
        )


def _reason(system, result, t1, t, y) -> str:
    """Why a simulation ended at a state, in one line, with what is not finite there or just beyond."""
    text = RESULTS[result]
    if is_traced((system, t, y)) or not np.all(np.isfinite(np.concatenate([y.q, y.u]))):
        return text
    if result == RESULTS.inconsistent_constraints:
        return contradiction(system, t, y)
    rates = system.rates(t, y.q, y.u)
    for ahead in np.append(0.0, np.logspace(-12, -3, 10)) * (np.clip(t1, t - 1.0, t + 1.0) - t):
        wrong = system.not_finite(t + ahead, y.q + ahead * rates, y.u)
        if wrong:
            return f"{text.rstrip('.')}: at t = {float(t + ahead):.6g} {' and '.join(wrong)} is not finite."
    return text


def _corrected(system, ts, saved, correction):
    """Saved states, returned to the constraints; entries after the end of a run stay as they are."""
    finite = jnp.isfinite(ts)
    first = lambda y: jnp.where(jnp.isfinite(y[:1]), y[:1], 1.0)
    inside = jax.tree.map(lambda y: jnp.where(finite[:, None], y, lax.stop_gradient(first(y))), saved)
    corrected = jax.vmap(lambda t, y: correction(system, t, y))(jnp.where(finite, ts, 0.0), inside)
    return jax.tree.map(lambda new, old: jnp.where(finite[:, None], new, old), corrected, saved)


def _named(name: str, state: State) -> Adams:
    if name not in ("auto", "switch"):
        raise ValueError(f"solver must be an object, or one of the words 'auto' and 'switch'; got {name!r}.")
    if name == "switch" and is_traced(state):
        raise ValueError(
            "solver='switch' looks at a motion before it decides, which it cannot under jit, vmap or grad. Simulate "
            "once with solver='auto', outside, and then choose Adams() or Hermite()."
        )
    return Adams(stiffness="count" if name == "auto" else "stop")


def _tolerances(rtol: Any, atol: Any, state: State) -> tuple[Any, Any]:
    dtype = state.q.dtype
    least = 10 * float(jnp.finfo(dtype).eps)
    relative = real_array("rtol", rtol, dtype)
    absolute = None if atol is None else real_array("atol", atol, dtype, ((), (state.q.size + state.u.size,)))
    for name, value in (("rtol", relative), ("atol", absolute)):
        if value is not None and not is_traced(value) and (np.any(value < 0) or np.any(value >= 1)):
            raise ValueError(f"{name} must be between 0 and 1, got {value}.")
    if not is_traced(relative) and relative < least:
        if dtype != jnp.float32:
            raise ValueError(f"rtol={rtol:g} is below what double precision can do; use at least {least:.1e}.")
        warnings.warn(
            f"rtol={rtol:g} is below what single precision can do; {least:.1e} is used instead. Switch double "
            'precision on before anything else: import jax; jax.config.update("jax_enable_x64", True).',
            stacklevel=3,
        )
        relative = as_array(least, dtype)
    return relative, relative / 100 if absolute is None else absolute


def _save_at(saveat: Any, start: Any, end: Any) -> diffrax.SaveAt:
    if saveat is None:
        return diffrax.SaveAt(t1=True)
    if isinstance(saveat, diffrax.SaveAt):
        if not isinstance(saveat.subs, diffrax.SubSaveAt) and saveat.subs is not None:
            raise ValueError("simulate saves one series; use SaveAt without subs, or diffrax.diffeqsolve directly.")
        if saveat.subs is not None and saveat.subs.ts is not None:
            _check_saved_times(saveat.subs.ts, start, end)
        return saveat
    return diffrax.SaveAt(ts=jax.device_put(_check_saved_times(saveat, start, end)))


def _check_saved_times(times: Any, start: Any, end: Any) -> Any:
    ts = real_array("saveat", times, jnp.result_type(float), None)
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"saveat must be a vector of times or a diffrax.SaveAt, got shape {ts.shape}.")
    if is_traced((ts, start, end)):
        return ts
    if not (min(start, end) <= ts.min() and ts.max() <= max(start, end)):
        raise ValueError(
            f"saveat must lie between t0 = {start:g} and t1 = {end:g}, got times from {ts.min():g} to {ts.max():g}."
        )
    if np.any(np.diff(ts) * (1 if start <= end else -1) < 0):
        raise ValueError(f"saveat must run from t0 to t1 without turning back, got {ts}.")
    return ts


def _jump_times(jumps: Any) -> Any:
    times = real_array("jumps", jumps, jnp.result_type(float), None)
    if times.ndim != 1 or times.shape[0] == 0 or not (is_traced(times) or np.all(np.isfinite(times))):
        raise ValueError(f"jumps must be a vector of finite times, got {jumps!r}; leave it out if there are none.")
    return jnp.asarray(times)


def _with_end(saveat: diffrax.SaveAt) -> diffrax.SaveAt:
    """The user's series and, for statistics and diagnosis, the end state."""
    first = saveat.subs if saveat.subs is not None else diffrax.SubSaveAt(t1=True)
    return diffrax.SaveAt(
        subs=(first, diffrax.SubSaveAt(t1=True)), dense=saveat.dense, solver_state=True, controller_state=True
    )


def _checked_state(system: AbstractSystem, state: Any) -> State:
    cure = "jaxmb.assemble(system) makes one, and so does jaxmb.State(q, u)"
    # A concrete class: a state is nothing but its two fields.
    check_kind("state", state, State, "a jaxmb.State", cure)
    for name, value, size in (("q", state.q, system.nq), ("u", state.u, system.nu)):
        if np.result_type(getattr(value, "dtype", type(value))).kind not in "fiub":
            raise ValueError(f"state.{name} must be an array of real numbers, got {value!r}; {cure}.")
        if np.shape(value) != (size,):
            raise ValueError(
                f"The state must have {system.nq} coordinates and {system.nu} velocities, got state.{name} of shape "
                f"{np.shape(value)}."
            )
    return jax.tree.map(lambda x: jnp.asarray(x, dtype=jnp.result_type(float)), state)


def _times(t0: Any, t1: Any, dt0: Any, dtype: Any) -> dict[str, Any]:
    start, end = real_array("t0", t0, dtype), real_array("t1", t1, dtype)
    if not is_traced(start) and not np.isfinite(start):
        raise ValueError(f"t0 must be finite, got {t0}.")
    if dt0 is None:
        return {"t0": start, "t1": end, "dt0": None}
    step = real_array("dt0", dt0, dtype)
    if not is_traced((start, end, step)) and not (np.isfinite(step) and step * (1 if end >= start else -1) > 0):
        raise ValueError(
            f"dt0 must be a finite step from t0 = {t0} towards t1 = {t1}, got {dt0}; leave it out for the default."
        )
    return {"t0": start, "t1": end, "dt0": step}
