"""Accelerations near the constraint manifold and the way back to it, with exact derivatives.

A step asks twice. `evaluate` takes predicted coordinates close to the manifold and factors the Jacobian there: the one
elimination of the step. `restore` takes the corrected state, keeps its independent coordinates and velocities, solves
`Φ = 0` and `ψ = 0` for the dependent ones, and finds the accelerations there by one Newton correction of those that
were evaluated: no Jacobian and no elimination, a fifth of the cost. Where nothing near has been evaluated,
`restore_positions` is followed by `evaluate`.

Their derivatives do not follow the algorithm but the equations (implicit function theorem): they are cheap, independent
of the formulation, and cannot pick up a frozen iterate. The factors' own derivatives are part of the rule, so higher
derivatives are right as well.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import Scalar
from ..formulations import AbstractFormulation
from ..formulations.formulation import solve_constrained
from ..linalg.elimination import Factor, Order, factor, solve_positive
from ..system import AbstractSystem

_MAX_ITERATIONS = 12


class Split(eqx.Module):
    """A chart's index sets, and the matrix that restores positions.

    **Fields:** `velocity`: order of elimination of the velocities' Jacobian; `acceleration`: that of all rows of A,
    None where none bind accelerations only; `coordinate`: that of the coordinates' Jacobian, None where one order
    serves both; `correction` (nq × coordinate rows): approximate solution of `Φ_q δq = −Φ` along dependent columns,
    from a state of this step or of one before.
    """

    velocity: Order
    acceleration: Order | None
    coordinate: Order | None
    correction: Float[Array, "nq mq"]


class Evaluation(eqx.Module):
    """Velocities on the manifold of their coordinates, accelerations and the velocity factor."""

    u: Float[Array, "nu"]
    udot: Float[Array, "nu"]
    factor: Factor


class Restored(eqx.Module):
    """A state on the manifold and its accelerations.

    **Fields:** `q`, `u`, `udot`; `iterations` of the position Newton and `failed`, which tangents have not.
    """

    q: Float[Array, "nq"]
    u: Float[Array, "nu"]
    udot: Float[Array, "nu"]
    iterations: Int[Array, ""] | None
    failed: Bool[Array, ""] | None


def shared(system: AbstractSystem) -> bool:
    """Whether one split serves coordinates and velocities: q̇ = u, and no nonholonomic rows."""
    return system.rates_are_velocities and system.velocity_rows == system.position_rows


def coordinate_factor(system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], split: Split) -> Factor:
    """Factor of the coordinates' Jacobian in a chart."""
    order = split.velocity if split.coordinate is None else split.coordinate
    return factor(system.coordinate_jacobian(t, q), order, system.coordinate_rank)


def correct_positions(system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], split: Split) -> Float[Array, "nq"]:
    """Coordinates nearer to the manifold, by one correction with the matrix that is there."""
    if system.coordinate_rank == 0:
        return q
    return q - split.correction @ system.coordinate_residual(t, q)


# Functions with rules of their own are compiled ones around it, so that each is traced once for all its places.
@eqx.filter_jit
def evaluate(
    system: AbstractSystem,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    order: Order,
) -> Evaluation:
    """Accelerations of a constrained system at coordinates on the manifold or near it.

    **Arguments:** `u`: independent velocities exact, dependent ones a guess; `order` of elimination.
    """
    return _evaluate(system, formulation, t, q, u, order)


@eqx.filter_custom_jvp
def _evaluate(system, formulation, t, q, u, order):
    jacobian = system.jacobian(t, q, u)
    solved = factor(jacobian, order, system.velocity_rank)
    if system.linear and system.drift_free:
        u = solved.basis @ u[order.columns[system.velocity_rank :]]
    else:
        u = u - solved.correction @ system.velocity_residual(t, q, u)
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    udot, _ = formulation.solve(system.inertia(t, q, u), system.force(t, q, u), jacobian, gamma, solved)
    return Evaluation(u, udot, solved)


@eqx.filter_jit
def evaluate_general(
    system: AbstractSystem,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    split: Split,
) -> Evaluation:
    """The same for any constraints, ideal or not, also those that bind accelerations only: from the factors of this
    very state, which are differentiated with it.
    """

    def velocity_factor(u):
        return factor(system.velocity_jacobian(t, q, u), split.velocity, system.velocity_rank)

    solved = velocity_factor(u)
    u = u - solved.correction @ system.velocity_residual(t, q, u)
    if not system.linear:
        solved = velocity_factor(u)
        u = u - solved.correction @ system.velocity_residual(t, q, u)
    jacobian = system.jacobian(t, q, u)
    every = solved if split.acceleration is None else factor(jacobian, split.acceleration, system.acceleration_rank)
    udot, _ = solve_constrained(system, formulation, t, q, u, jacobian, every)
    return Evaluation(u, udot, solved)


@eqx.filter_jit
def restore(
    system: AbstractSystem,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    near: Evaluation,
    split: Split,
    tol: Scalar,
) -> Restored:
    """Restore a state to the manifold and find the accelerations of a constrained system there.

    They are wrong by the square of the distance to the state of `near`.

    **Arguments:** `q`, `u`: the state, independent entries exact, dependent ones a guess; `near`: the evaluation of a
    state close by at the same time; `tol`: size of the last Newton correction, relative to the system's size.
    """
    return _restore(system, t, q, u, near, split, tol)


@eqx.filter_custom_jvp
def _restore(system, t, q, u, near, split, tol):
    solved, udot = near.factor, near.udot
    q, iterations, failed = restore_positions(system, t, q, split, tol)
    # Wrong by the distance of the two states, the factor leaves the square and the cube of what there was.
    u = u - solved.correction @ system.velocity_residual(t, q, u)
    if not system.linear:
        step = solved.correction @ system.velocity_residual(t, q, u)
        u = u - step
        failed = failed | ~(jnp.max(jnp.abs(step)) <= jnp.sqrt(tol) * (1.0 + jnp.max(jnp.abs(u))))
    inertia = system.inertia(t, q, u)
    multipliers = solved.correction.T @ (inertia.product(udot) - system.force(t, q, u))
    unlevel, unbalance = _equations(system, t, q, u, udot, multipliers)
    udot = udot + _solve_linear(inertia, solved, unlevel, unbalance)
    return Restored(q, u, udot, iterations, failed)


def _equations(system, t, q, u, udot, multipliers):
    """Residuals of the equations of motion: `A u̇ − γ` and `M u̇ − F − Aᵀ λ`."""
    applied = system.force(t, q, u) + system.constraint_force(t, q, u, multipliers)
    return system.acceleration_residual(t, q, u, udot), system.inertia(t, q, u).product(udot) - applied


def _solve_linear(inertia, solved, unlevel, unbalance):
    """The change of accelerations that makes these residuals vanish; that of the multipliers is eliminated."""
    particular = -(solved.correction @ unlevel)
    reduced = solved.basis.T @ inertia.product(solved.basis)
    load = solved.basis.T @ (unbalance + inertia.product(particular))
    return particular - solved.basis @ solve_positive(reduced, load)


@eqx.filter_custom_jvp
def restore_positions(
    system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], split: Split, tol: float
) -> tuple[Float[Array, "nq"], Int[Array, ""] | None, Bool[Array, ""] | None]:
    """Solve `Φ = 0` for the dependent coordinates by Newton with a fixed matrix: `(q, iterations, failed)`."""
    if system.coordinate_rank == 0:
        return q, jnp.array(0), jnp.array(False)
    scale = system.coordinate_scale()

    def correct(carry):
        q, before, _, k = carry
        step = split.correction @ system.coordinate_residual(t, q)
        size = jnp.max(jnp.abs(step) / scale)
        # Corrections shrink by a constant factor, so the next one is known: no iteration is spent on verifying it.
        # Those of the size of rounding errors stop shrinking; there is nothing left to correct.
        rate = jnp.where(size < before, size / before, 1.0)
        rounded = (size < 4096 * jnp.finfo(q.dtype).eps) & (rate > 0.5)
        return q - step, size, jnp.where(rounded, 0.0, size * rate), k + 1

    def proceed(carry):
        _, size, ahead, k = carry
        return (ahead > tol) & (size < 1.0) & (k < _MAX_ITERATIONS)

    # Where velocities and coordinates share their factor it is of this very time, and wrong by the first correction
    # only; of an older one nothing is known.
    before = jnp.full((), 1.0 if split.coordinate is None else 0.0, q.dtype)
    q, _, ahead, k = lax.while_loop(proceed, correct, correct((q, before, before, jnp.array(0))))
    return q, k, ~(ahead <= tol)


# Derivatives


@_evaluate.def_jvp
def _evaluate_jvp(primals, tangents):
    system, formulation, t, q, u, order = primals
    dsystem, _, dt, dq, du, _ = tangents
    out = evaluate(system, formulation, t, q, u, order)
    solved = out.factor
    at, along = _push_velocities((system, t, q, out.u), (dsystem, dt, _dense(dq, q), _dense(du, u)), solved)
    djacobian = _push(lambda s, t, q, u: s.jacobian(t, q, u), at, along)
    pushed = solved.correction @ djacobian
    dfactor = Factor(-(pushed @ solved.correction), -(pushed @ solved.basis), None)
    return out, Evaluation(along[3], _push_accelerations(at, along, out.udot, solved), dfactor)


@_restore.def_jvp
def _restore_jvp(primals, tangents):
    system, t, q, u, near, split, tol = primals
    dsystem, dt, dq, du, _, _, _ = tangents
    out = restore(system, t, q, u, near, split, tol)
    # The factor of the other state solved the equations, but only the one of this state differentiates them.
    solved = factor(system.jacobian(t, out.q, out.u), split.velocity, system.velocity_rank)
    dq = _dense(dq, q)
    if system.coordinate_rank > 0:
        own = solved if split.coordinate is None else coordinate_factor(system, t, out.q, split)
        dq = _push_positions(system, t, out.q, own, (dsystem, dt, dq))
    at, along = _push_velocities((system, t, out.q, out.u), (dsystem, dt, dq, _dense(du, u)), solved)
    dudot = _push_accelerations(at, along, out.udot, solved)
    return out, Restored(dq, along[3], dudot, None, None)


@restore_positions.def_jvp
def _restore_positions_jvp(primals, tangents):
    system, t, q, split, tol = primals
    dsystem, dt, dq, _, _ = tangents
    out = restore_positions(system, t, q, split, tol)
    dq = _dense(dq, q)
    if system.coordinate_rank > 0:
        own = coordinate_factor(system, t, out[0], split)
        dq = _push_positions(system, t, out[0], own, (dsystem, dt, dq))
    return out, (dq, None, None)


def _push_positions(system, t, q, own, along):
    """Tangent of the coordinates on the manifold, from their factor there."""
    residual = _push(lambda s, t, q: s.coordinate_residual(t, q), (system, t, q), along)
    return along[2] - own.correction @ residual


def _push_velocities(at, along, solved):
    """Point and tangent with that of the velocities on the manifold."""
    dsystem, dt, dq, du = along
    residual = _push(lambda s, t, q, u: s.velocity_residual(t, q, u), at, along)
    return at, (dsystem, dt, dq, du - solved.correction @ residual)


def _push_accelerations(at, along, udot, solved):
    system, t, q, u = at
    inertia = system.inertia(t, q, u)
    multipliers = solved.correction.T @ (inertia.product(udot) - system.force(t, q, u))
    unlevel, unbalance = _push(lambda s, t, q, u: _equations(s, t, q, u, udot, multipliers), at, along)
    return _solve_linear(inertia, solved, unlevel, unbalance)


def _push(fn, primals, tangents):
    return eqx.filter_jvp(fn, primals, tangents)[1]


def _dense(tangent, primal):
    return jnp.zeros_like(primal) if tangent is None else tangent
