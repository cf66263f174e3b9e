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
from jaxtyping import Array, ArrayLike

from ._results import RESULTS
from ._types import Scalar, State
from .formulations import AbstractFormulation, Multipliers, NullSpace, Partitioned
from .formulations.formulation import row_levels
from .linalg.arrays import as_array, is_traced
from .linalg.elimination import full_pivot
from .manifold import AbstractManifold, Baumgarte, Partition, Projection, Unconstrained, project
from .manifold.partition import Chart
from .solvers import AbstractMultistep, Adams, AdamsState, ControllerState, Hermite, HermiteState, MultistepController
from .system import AbstractSystem
from .trajectory import Trajectory

# Reverse mode keeps this many steps, fewer where they do not fit in this many bytes, and recomputes beyond.
_CHECKPOINTS = 4096
_CHECKPOINT_BYTES = 2**28

# A smallest pivot below this at the end of a failed run means that the constraints are losing rank.
_SINGULAR_PIVOT = 1e-3


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

    - `solver`: default `Adams()`; for stiff motions `Hermite()`; any diffrax Runge–Kutta solver. With `"auto"` it is
        `Adams`, which finds out whether stability limits its steps instead of accuracy: `stats["stiff"]`, and in how
        many steps, `stats["stiff_steps"]`; a warning then advises `Hermite`. With `"switch"` a motion found stiff is
        simulated again, with `Hermite` from `t0` on; not under `jit`, `vmap` or `grad`.
    - `formulation`: how accelerations are solved for. Default `Partitioned()` where a partition is there, else
        `Multipliers()`, which needs no search for pivots, or `NullSpace()` where the mass matrix is singular.
    - `manifold`: how the state stays on the constraints. Default `Partition()` for `Adams` and `Hermite`,
        `Projection()` for others, and nothing of either for a system without constraints; for `Adams` on a planar scene
        with 30 or more constraint rows whose joints form a chain, `Projection()` as well, whose cost grows with the
        number of joints and not with its cube.
    - `dt0`: first step [s], default chosen from the motion.
    - `stepsize_controller`: instead of `rtol` and `atol`; a `MultistepController` for `Adams` and `Hermite`.
    - `adjoint`: how to differentiate. Default reverse mode, with up to 4096 steps (at most 256 MB) kept and none of
        them computed twice. For few parameters forward mode is faster and needs no memory: `jax.jacfwd` with
        `adjoint=diffrax.ForwardMode()`.
    - `event`, `max_steps`, `throw`, `progress_meter`: as in `diffrax.diffeqsolve`.

    **Returns:** a `Trajectory`.

    **Raises:** `ValueError` for tolerances out of range and combinations that cannot work; `RuntimeError`, if
    `throw`, when the integration fails: the text of its `RESULTS` says how. With `throw=False` the trajectory up to
    there is kept.

    Derivatives are those of the discrete solution with its mesh frozen; they converge with the tolerance to the true
    ones. A mesh is made for the motion it follows: from a state of rest in equilibrium it is coarse, and derivatives
    there need a bound on the step, `stepsize_controller=MultistepController(rtol, atol, dtmax=...)`.
    """
    state = jax.tree.map(lambda x: jnp.asarray(x, dtype=jnp.result_type(float)), state)
    if state.q.shape != (system.nq,) or state.u.shape != (system.nu,):
        raise ValueError(
            f"The state must have {system.nq} coordinates and {system.nu} velocities, got {state.q.shape} and "
            f"{state.u.shape}."
        )
    # Numbers become arrays, so that other tolerances and times do not compile anew.
    number = lambda x: as_array(x, state.q.dtype)
    relative: Any = number(_checked_tolerance(rtol, atol, state.q.dtype))
    absolute: Any = relative / 100 if atol is None else number(atol)
    times = number(t0), number(t1), None if dt0 is None else number(dt0)
    choice = solver
    solver = _named(solver, state) if isinstance(solver, str) else Adams() if solver is None else solver
    if stepsize_controller is None:
        controller = MultistepController if isinstance(solver, AbstractMultistep) else diffrax.PIDController
        stepsize_controller = controller(rtol=relative, atol=absolute)
    if adjoint is None:
        size = 16 * state.q.dtype.itemsize * (system.nq + system.nu)
        kept = min(max_steps, _CHECKPOINTS, max(_CHECKPOINT_BYTES // size, 64))
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=kept)
    meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter

    points = _save_at(saveat)
    interpolated = event is not None or (points.subs is not None and points.subs.ts is not None)

    def motion(solver):
        policy = _manifold(system, solver, formulation) if manifold is None else manifold
        road = _formulation(system, policy) if formulation is None else formulation
        term, prepared = policy.prepare(system, road, solver, relative)
        return _integrate(
            system,
            road,
            term,
            prepared,
            times,
            state,
            points,
            stepsize_controller,
            adjoint,
            event,
            max_steps,
            meter,
            restore=_way_back(policy, interpolated),
        )

    trajectory, failed = motion(solver)
    if choice == "switch" and trajectory.stats["stiff"]:
        found = {name: trajectory.stats[name] for name in ("stiff", "stiff_steps")}
        trajectory, failed = motion(Hermite())
        trajectory = eqx.tree_at(lambda trajectory: trajectory.stats, trajectory, trajectory.stats | found)
    if choice == "auto" and not isinstance(trajectory.stats["stiff"], Tracer) and trajectory.stats["stiff"]:
        warnings.warn(
            f"The motion is stiff: in {trajectory.stats['stiff_steps']} of {trajectory.stats['num_steps']} steps of "
            "Adams' method stability was the limit. simulate(..., solver=jaxmb.solvers.Hermite()) takes longer ones.",
            stacklevel=2,
        )
    if throw and (isinstance(failed, Tracer) or failed):
        # The error goes with the value: a gradient that is taken alone would be that of the part before the failure.
        spoiled = lambda y: y * jnp.where(failed, jnp.nan, 1.0).astype(y.dtype) if eqx.is_inexact_array(y) else y
        trajectory = eqx.tree_at(lambda trajectory: trajectory.ys, trajectory, jax.tree.map(spoiled, trajectory.ys))
        trajectory = trajectory.result.error_if(trajectory, failed)
    return trajectory.trimmed()


def _manifold(system, solver, formulation) -> AbstractManifold:
    if system.acceleration_rows == 0:
        return Unconstrained()
    if isinstance(solver, Adams) and system.elimination is not None and isinstance(formulation, Multipliers | None):
        return Projection()
    return Partition() if isinstance(solver, AbstractMultistep) else Projection()


def _formulation(system, manifold) -> AbstractFormulation:
    if isinstance(manifold, Partition):
        return Partitioned()
    return Multipliers() if system.regular else NullSpace()


@eqx.filter_jit
def _integrate(
    system, formulation, term, solver, times, state, saveat, controller, adjoint, event, max_steps, meter, *, restore
):
    t0, t1, dt0 = times
    solution: Any = diffrax.diffeqsolve(
        term,
        solver,
        t0,
        t1,
        dt0,
        state,
        saveat=_with_end(saveat),
        stepsize_controller=controller,
        adjoint=adjoint,
        event=event,
        max_steps=max_steps,
        throw=False,
        progress_meter=meter,
    )
    ts, saved = solution.ts[0], solution.ys[0]
    end = solution.ts[1][-1], jax.tree.map(lambda y: y[-1], solution.ys[1])
    if isinstance(saved, State) and restore is not None:
        saved = _restore(system, ts, saved, restore)
    result = _diagnose(system, state, end, solution)
    trajectory = Trajectory(
        system=system,
        formulation=formulation,
        ts=ts,
        ys=saved,
        stats=_statistics(solution),
        result=result,
        interpolation=solution.interpolation,
        event_mask=solution.event_mask,
    )
    return trajectory, _failed(result)


def _named(name: str, state: State) -> Adams:
    if name not in ("auto", "switch"):
        raise ValueError(f"A solver is an object, or one of the words 'auto' and 'switch'; got {name!r}.")
    if name == "switch" and is_traced(state):
        raise ValueError(
            "solver='switch' looks at a motion before it decides, which it cannot under jit, vmap or grad. Simulate "
            "once with solver='auto', outside, and then choose Adams() or Hermite()."
        )
    return Adams(stiffness="count" if name == "auto" else "stop")


def _checked_tolerance(rtol: Any, atol: Any, dtype) -> Any:
    for name, value in (("rtol", rtol), ("atol", atol)):
        if value is None or isinstance(value, Tracer):
            continue
        if not np.all(np.isfinite(value)) or np.any(np.asarray(value) < 0) or np.any(np.asarray(value) >= 1):
            raise ValueError(f"{name} must be between 0 and 1, got {value}.")
    least = 10 * float(jnp.finfo(dtype).eps)
    if isinstance(rtol, Tracer) or rtol >= least:
        return rtol
    if dtype == jnp.float32:
        warnings.warn(
            f"rtol={rtol:g} is below what single precision can do; {least:.1e} is used instead. Switch double "
            'precision on before anything else: import jax; jax.config.update("jax_enable_x64", True).',
            stacklevel=3,
        )
        return least
    raise ValueError(f"rtol={rtol:g} is below what double precision can do; use at least {least:.1e}.")


def _save_at(saveat) -> diffrax.SaveAt:
    if saveat is None:
        return diffrax.SaveAt(t1=True)
    if isinstance(saveat, diffrax.SaveAt):
        if not isinstance(saveat.subs, diffrax.SubSaveAt) and saveat.subs is not None:
            raise ValueError("simulate saves one series; use SaveAt without subs, or diffrax.diffeqsolve directly.")
        return saveat
    ts = as_array(saveat, jnp.result_type(float))
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"saveat must be a vector of times or a diffrax.SaveAt, got shape {ts.shape}.")
    return diffrax.SaveAt(ts=jax.device_put(ts))


def _with_end(saveat: diffrax.SaveAt) -> diffrax.SaveAt:
    """The user's series and, for statistics and diagnosis, the end state."""
    first = saveat.subs if saveat.subs is not None else diffrax.SubSaveAt(t1=True)
    return diffrax.SaveAt(
        subs=(first, diffrax.SubSaveAt(t1=True)), dense=saveat.dense, solver_state=True, controller_state=True
    )


def _way_back(manifold: AbstractManifold, interpolated: bool) -> Any:
    """What saved states need: those between steps are not on the constraints, and free ones never are quite."""
    if isinstance(manifold, Baumgarte):
        # How far its states are off is what one looks for.
        return _normalized
    return _on_manifold if interpolated or isinstance(manifold, Unconstrained) else None


def _restore(system, ts, saved, back):
    """Bring states back to where they belong; entries after the end of a run stay as they are."""
    finite = jnp.isfinite(ts)
    inside = jax.tree.map(lambda y: jnp.where(finite[:, None], y, lax.stop_gradient(_first(y))), saved)
    restored = jax.vmap(lambda t, y: back(system, t, y))(jnp.where(finite, ts, 0.0), inside)
    return jax.tree.map(lambda new, old: jnp.where(finite[:, None], new, old), restored, saved)


def _first(y):
    return jnp.where(jnp.isfinite(y[:1]), y[:1], 1.0)


def _normalized(system, t, y):
    del t
    return State(system.normalize(y.q), y.u)


def _on_manifold(system, t, y):
    return project(system, t, _normalized(system, t, y))


def _diagnose(system, start, end, solution):
    """Diffrax's outcome, made precise where mechanics knows more."""
    result = RESULTS.promote(solution.result)
    finite = jnp.all(jnp.isfinite(start.q)) & jnp.all(jnp.isfinite(start.u))
    stuck = _failed(result)
    result = RESULTS.where(stuck & ~finite, RESULTS.assembly_failed, result)
    if system.velocity_rows == 0 or not isinstance(_chart(solution), Chart):
        return result
    stuck = stuck & finite
    t, y = lax.stop_gradient(end)
    system = lax.stop_gradient(system)

    def smallest_pivot():
        pivots = full_pivot(system.jacobian(t, y.q, y.u), scale=system.velocity_scale(), level=row_levels(system))
        return jnp.where(pivots.rank < system.acceleration_rank, 0.0, pivots.smallest)

    pivot = lax.cond(stuck, smallest_pivot, lambda: jnp.ones((), y.q.dtype))
    singular = stuck & ((pivot < _SINGULAR_PIVOT) | _chart(solution).singular)
    result = RESULTS.where(singular, RESULTS.singular_configuration, result)
    newton = stuck & ~singular & (solution.result == diffrax.RESULTS.dt_min_reached)
    return RESULTS.where(newton, RESULTS.newton_failed, result)


def _failed(result) -> Any:
    return ~((result == RESULTS.successful) | (result == RESULTS.event_occurred))


def _chart(solution) -> Any:
    return getattr(solution.solver_state, "chart", None)


def _statistics(solution) -> dict[str, Array]:
    stats = dict(solution.stats)
    state = solution.solver_state
    if isinstance(state, AdamsState):
        stats["num_evaluations"] = state.tally[0] + 2 * stats["num_steps"]
        stats["orders"] = state.tally[1:]
        if state.stiffness is not None:
            stats["stiff"], stats["stiff_steps"] = state.stiffness.found, state.stiffness.steps
    if isinstance(state, HermiteState):
        is_own = lambda leaf: isinstance(leaf, ControllerState)
        controllers = filter(is_own, jax.tree.leaves(solution.controller_state, is_leaf=is_own))
        work = state.work + sum(controller.wasted for controller in controllers)
        stats["num_evaluations"], stats["num_matrices"] = state.tally[0] + work[0], work[1]
        stats["points"] = state.tally[1:]
    chart = _chart(solution)
    if isinstance(chart, Chart):
        stats["newton_iterations"] = chart.newton
        stats["charts"] = chart.charts
    return stats
