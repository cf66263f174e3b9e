"""The integration of a motion as one compiled program, whose mesh resolves derivatives where they are taken."""

import functools
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .._results import RESULTS
from ..formulations import AbstractFormulation
from ..manifold import (
    AbstractManifold,
    after_jumps,
    default_manifold,
    natural_units,
    state_blocks,
    with_internal_states,
)
from ..manifold.diagnosis import diagnose_friction
from ..solvers import AbstractMultistep, MeshAdjoint, RunningScales, TangentControl, intended_step, with_tangents
from ..states.consistency import consistent
from ..system import AbstractSystem
from ..system.parameters import with_parameters
from ..trajectory import Trajectory
from .moving_times import at_frozen_start, at_moving_times, is_moving, saved_times
from .outcome import Outcome, has_failed

# Derivatives keep the numbers of this many steps, fewer where they do not fit in this many bytes.
_MOST_ROWS, _FEWEST_ROWS, _ROW_BYTES = 2048, 64, 2**27


class Problem(NamedTuple):
    """A motion to be computed, with checked arguments.

    **Fields:** the `system`; `formulation` and `manifold`, None for those that suit the solver; `rtol`; `options` of
    `diffrax.diffeqsolve`; times of `restarts`, or None; whether states are `interpolated`; `changes`: values of
    parameters with changes whose tangent is watched, by name.
    """

    system: AbstractSystem
    formulation: AbstractFormulation | None
    manifold: AbstractManifold | None
    rtol: Any
    options: dict[str, Any]
    restarts: Any
    interpolated: bool
    changes: dict[str, tuple[Any, Any]]

    def solved(self, solver: diffrax.AbstractSolver) -> tuple[Trajectory, Outcome]:
        """The motion by a solver, and how it ended."""
        system, state = self.system, self.options["y0"]
        valid = system.parameters_in_range()
        policy = default_manifold(system, solver, self.formulation) if self.manifold is None else self.manifold
        jumping = self.restarts is not None and system.velocity_rows > 0
        if jumping and not (policy.takes_impulses and system.positive_definite_mass):
            raise ValueError(
                "With jumps, or inputs that jump, a constrained system needs manifold=Partition() or Projection(), and "
                f"a mass matrix that has an inverse; got {type(policy).__name__}() and positive_definite_mass = "
                f"{system.positive_definite_mass}."
            )
        method = policy.default_formulation(system) if self.formulation is None else self.formulation

        def assembled(system):
            term, prepared = policy.prepare(system, method, solver, self.rtol)
            return with_internal_states(term), prepared

        term, prepared = assembled(system)
        start = consistent(system, self.options["t0"], state) if policy.restores else state
        along = None
        if self.changes:
            moved = lambda step: with_parameters(system, {k: at + step * x for k, (at, x) in self.changes.items()})
            along = eqx.filter_jvp(lambda step: assembled(moved(step))[0], (0.0,), (1.0,))[1]
        options = self.options | {"y0": start}
        moving = is_moving(options)
        return integrate(system, method, policy, term, prepared, options, self.interpolated, along, valid, moving)


@eqx.filter_jit
def integrate(system, formulation, manifold, term, solver, options, interpolated, direction, valid, moving):
    start, first = options["y0"], options["saveat"].subs[0]
    finite = jnp.all(jnp.isfinite(start.q)) & jnp.all(jnp.isfinite(start.u)) & valid
    if start.z is not None:
        finite = finite & jnp.all(jnp.isfinite(start.z))
    # From nowhere there is no step to take: the interval is empty, with every time that is asked for in it.
    ends = options["t0"], options["t1"]
    options = options | lax.stop_gradient({name: options[name] for name in ("t0", "t1", "dt0")})
    if moving[0]:
        start = at_frozen_start(term, ends[0], start)
        options["y0"] = start
    at_once, times = lambda times: jnp.where(finite, times, options["t0"]), lax.stop_gradient(first.ts)
    options = options | {"t1": at_once(options["t1"])}
    controller, after = options["stepsize_controller"], times
    jumps = controller.jump_ts if isinstance(controller, diffrax.ClipStepSizeController) else None
    if times is not None:
        if jumps is not None:
            # States that are saved at a jump are those after it, also in a run that comes to it from there.
            after = after_jumps(times, jumps, options["t0"], options["t1"])
        options["saveat"] = eqx.tree_at(lambda saveat: saveat.subs[0].ts, options["saveat"], at_once(after))
    solution: Any = _solve(term, solver, options, _tangent_control(system, options, direction))
    ts, saved = solution.ts[0], solution.ys[0]
    if times is not None:
        ts = jnp.where(finite, ts, jnp.inf)
    correction, lost = manifold.correction(interpolated), None
    # `SaveAt(fn=...)` may save something else than states.
    are_states = jax.tree.structure(saved) == jax.tree.structure(options["y0"])
    if are_states and correction is not None:
        saved, lost = _corrected(system, options, ts, saved, correction)
    if after is not times:
        ts = _replaced(ts, after, times)
    if any(moving):
        ts = saved_times(first, ts, *ends)
        if are_states and moving[1]:
            saved = at_moving_times(term, ts, saved)
    end = solution.ts[1][-1], jax.tree.map(lambda y: y[-1], solution.ys[1])
    result = RESULTS.promote(solution.result)
    result = RESULTS.where(finite, result, RESULTS.assembly_failed)
    if valid is not True:
        result = RESULTS.where(valid, result, RESULTS.invalid_parameters)
    stuck = has_failed(result) & finite
    result = manifold.diagnose(system, *end, solution.solver_state, result, stuck)
    if lost is not None:
        result = RESULTS.where(lost & ~has_failed(result), RESULTS.newton_failed, result)
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
    return trajectory, Outcome(has_failed(result), *end, intended_step(solution.controller_state), coupling)


def _solve(term, solver, options, control):
    """The solution, whose mesh resolves the motion; where it is differentiated, a tangent as well."""
    return _solve_on_mesh((term, solver, options), control)


@eqx.filter_custom_jvp
def _solve_on_mesh(arguments, control):
    del control
    term, solver, options = arguments
    adjoint = diffrax.ForwardMode() if options["adjoint"] is None else options["adjoint"]
    return diffrax.diffeqsolve(term, solver, throw=False, **options | {"adjoint": adjoint})


@_solve_on_mesh.def_jvp
def _solve_jvp(primals, tangents):
    arguments, control = primals
    return eqx.filter_jvp(lambda arguments: _solve_with_tangents(arguments, control), (arguments,), (tangents[0],))


def _solve_with_tangents(arguments, control):
    term, solver, options = arguments
    solver, controller, without_tangents = with_tangents(solver, options["stepsize_controller"], control)
    options = options | {"stepsize_controller": controller}
    adjoint = MeshAdjoint(_rows(options)) if options["adjoint"] is None else options["adjoint"]
    solution = _solve_states(term, solver, **options | {"adjoint": adjoint})
    return eqx.tree_at(lambda s: s.solver_state, solution, replace_fn=without_tangents)


def _solve_states(term, solver, **options):
    """The solution with states saved first, and then what the user's function makes of them."""
    function, states = options["saveat"].subs[0].fn, diffrax.SubSaveAt(t1=True).fn
    if function is states:
        return diffrax.diffeqsolve(term, solver, throw=False, **options)
    saveat = eqx.tree_at(lambda saveat: saveat.subs[0].fn, options["saveat"], states)
    solution: Any = diffrax.diffeqsolve(term, solver, throw=False, **options | {"saveat": saveat})
    ts, finite = solution.ts[0], jnp.isfinite(solution.ts[0])

    def saved(t, y, finite):
        # Entries after the end of a run are infinite, and their derivatives zero.
        t, y = jax.tree.map(lambda x, x0: jnp.where(finite, x, x0), (t, y), (options["t0"], options["y0"]))
        return jax.tree.map(lambda x: jnp.where(finite, x, jnp.asarray(jnp.inf, x.dtype)), function(t, y, None))

    ys = jax.vmap(saved)(ts, solution.ys[0], finite)
    return eqx.tree_at(lambda solution: solution.ys[0], solution, ys)


def _rows(options) -> int:
    """The number of steps that are kept for derivatives."""
    size = 2 * sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(options["y0"]))
    return max(min(_MOST_ROWS, _ROW_BYTES // size), _FEWEST_ROWS)


def _tangent_control(system, options, direction) -> TangentControl:
    """What is known of the sizes of a tangent: those of the coordinates, and of the velocities in the time that the
    motion takes.
    """
    state, span = options["y0"], jnp.abs(options["t1"] - options["t0"])
    velocities = system.velocity_scale()
    rate = jnp.maximum(jnp.max(jnp.abs(state.u) / velocities, initial=0.0), 1 / jnp.where(span > 0, span, 1.0))
    units = natural_units(system, velocities * rate, state.q.dtype)
    sizes = tuple(block.size for block in state_blocks(system, rate))
    return lax.stop_gradient(TangentControl(units, sizes, direction))


def running_scales(system, state, options) -> RunningScales:
    """Natural units of coordinates, velocities and internal states; where nothing moves yet, one unit in the whole
    time.
    """
    span = jnp.abs(options["t1"] - options["t0"])
    units = natural_units(system, system.velocity_scale(), state.q.dtype)
    units, rate = lax.stop_gradient((units, 1 / jnp.where(span > 0, span, 1.0)))
    return RunningScales(units, state_blocks(system, rate))


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
    corrected = jax.vmap(lambda t, y: correction(system, t, y))(jnp.where(finite, ts, at_start), inside)
    is_known = lambda y: functools.reduce(
        jnp.logical_and, [jnp.all(jnp.isfinite(x), axis=1) for x in jax.tree.leaves(y)]
    )
    lost = jnp.any(is_known(inside) & ~is_known(corrected))
    return jax.tree.map(lambda new, old: jnp.where(finite[:, None], new, old), corrected, saved), lost
