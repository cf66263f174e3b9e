"""From a system and a state to a motion."""

import warnings
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
from ._types import Scalar, State
from .formulations import AbstractFormulation
from .formulations.friction import coupled_most
from .linalg.arrays import as_array, is_traced
from .manifold import AbstractManifold, default_manifold
from .manifold.diagnosis import diagnose_friction
from .solvers import AbstractMultistep, Adams, Hermite, MultistepController
from .system import AbstractSystem
from .system.arguments import check_kind, real_array
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
    event: diffrax.Event | None = None,
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
    - `rtol`, `atol`: tolerances of the error of one step; `atol` defaults to `rtol` times one hundredth. It may be a
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
    - `event`, `max_steps`, `throw`, `progress_meter`: as in `diffrax.diffeqsolve`.

    **Returns:** a `Trajectory`.

    **Raises:** `ValueError` for arguments of the wrong type or out of range, and for combinations that cannot work;
    `RuntimeError`, if `throw`, when the integration fails: the text of its `RESULTS` says how. With `throw=False` the
    trajectory up to there is kept.

    Derivatives are those of the discrete solution with its mesh frozen; they converge with the tolerance to the true
    ones. A mesh is made for the motion it follows: from a state of rest in equilibrium it is coarse, and derivatives
    there need a bound on the step, `stepsize_controller=MultistepController(rtol, atol, dtmax=...)`.
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
    if stepsize_controller is None:
        controller = MultistepController if isinstance(solver, AbstractMultistep) else diffrax.PIDController
        stepsize_controller = controller(rtol=relative, atol=absolute)
    if adjoint is None:
        size = 16 * state.q.dtype.itemsize * (system.nq + system.nu)
        kept = min(max_steps, _CHECKPOINTS, max(_CHECKPOINT_BYTES // size, 64))
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=kept)
    saved = _save_at(saveat)
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

    def motion(solver):
        policy = default_manifold(system, solver, formulation) if manifold is None else manifold
        method = policy.default_formulation(system) if formulation is None else formulation
        term, prepared = policy.prepare(system, method, solver, relative)
        return _integrate(system, method, policy, term, prepared, options, interpolated)

    trajectory, failed, coupling = motion(solver)
    if choice == "switch" and trajectory.stats["stiff"]:
        found = {name: trajectory.stats[name] for name in ("stiff", "stiff_steps")}
        trajectory, failed, coupling = motion(Hermite())
        trajectory = eqx.tree_at(lambda trajectory: trajectory.stats, trajectory, trajectory.stats | found)
    if choice == "auto" and not isinstance(trajectory.stats["stiff"], Tracer) and trajectory.stats["stiff"]:
        warnings.warn(
            f"The motion is stiff: in {trajectory.stats['stiff_steps']} of {trajectory.stats['num_steps']} steps of "
            "Adams' method stability was the limit. simulate(..., solver=jaxmb.solvers.Hermite()) takes longer ones.",
            stacklevel=2,
        )
    if throw and not isinstance(failed, Tracer) and np.any(coupling):
        raise RuntimeError(_about_friction(system, coupling))
    if throw and (isinstance(failed, Tracer) or failed):
        # The error goes with the value: a gradient that is taken alone would be that of the part before the failure.
        spoiled = lambda y: y * jnp.where(failed, jnp.nan, 1.0).astype(y.dtype) if eqx.is_inexact_array(y) else y
        trajectory = eqx.tree_at(lambda trajectory: trajectory.ys, trajectory, jax.tree.map(spoiled, trajectory.ys))
        trajectory = trajectory.result.error_if(trajectory, failed)
    return trajectory.trimmed()


@eqx.filter_jit
def _integrate(system, formulation, manifold, term, solver, options, interpolated):
    solution: Any = diffrax.diffeqsolve(term, solver, throw=False, **options)
    ts, saved = solution.ts[0], solution.ys[0]
    correction = manifold.correction(interpolated)
    # `SaveAt(fn=...)` may save something else than states.
    are_states = jax.tree.structure(saved) == jax.tree.structure(options["y0"])
    if are_states and correction is not None:
        saved = _corrected(system, ts, saved, correction)
    end = solution.ts[1][-1], jax.tree.map(lambda y: y[-1], solution.ys[1])
    result = RESULTS.promote(solution.result)
    start = options["y0"]
    finite = jnp.all(jnp.isfinite(start.q)) & jnp.all(jnp.isfinite(start.u))
    stuck = _failed(result)
    result = RESULTS.where(stuck & ~finite, RESULTS.assembly_failed, result)
    result = manifold.diagnose(system, *end, solution.solver_state, result, stuck & finite)
    coupling = None
    if system.friction_parts:
        result, coupling = diagnose_friction(system, formulation, *end, result, stuck & finite)
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
    return trajectory, _failed(result), coupling


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


def _save_at(saveat) -> diffrax.SaveAt:
    if saveat is None:
        return diffrax.SaveAt(t1=True)
    if isinstance(saveat, diffrax.SaveAt):
        if not isinstance(saveat.subs, diffrax.SubSaveAt) and saveat.subs is not None:
            raise ValueError("simulate saves one series; use SaveAt without subs, or diffrax.diffeqsolve directly.")
        return saveat
    ts = real_array("saveat", saveat, jnp.result_type(float), None)
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"saveat must be a vector of times or a diffrax.SaveAt, got shape {ts.shape}.")
    return diffrax.SaveAt(ts=jax.device_put(ts))


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
