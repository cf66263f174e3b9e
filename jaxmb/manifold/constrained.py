"""Accelerations on the constraint manifold, and projection onto it along a chart, with exact derivatives.

A step needs both twice. `ideal_acceleration` takes predicted coordinates close to the manifold and factors the Jacobian
there: the one elimination of the step. `restore_state` takes the corrected state, keeps its independent coordinates and
velocities, solves `Φ = 0` and `ψ = 0` for the dependent ones, and finds the accelerations there by one Newton
correction of those of the prediction: it needs no Jacobian and no elimination, and costs a fifth. Where no state nearby
has been evaluated, `restore_positions` is followed by `ideal_acceleration`.

Derivatives follow from the equations by the implicit function theorem, not from the algorithm: they are cheap,
independent of the formulation, and cannot pick up a frozen iterate. The factors' own derivatives are part of the rule,
so higher derivatives are right as well.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._types import Scalar
from ..formulations import AbstractFormulation
from ..formulations.formulation import solve_constrained
from ..linalg.elimination import Factor, PivotOrder, eliminate, solve_positive
from ..linalg.jacobian import DenseJacobian
from ..linalg.newton import chord
from ..system import AbstractEquation

_MAX_ITERATIONS = 12


class ChartIndices(eqx.Module):
    """A chart's index sets, and the matrix that restores positions.

    **Fields:** `velocity`: order of elimination of the velocities' Jacobian; `acceleration`: that of all rows of A,
    None where no row binds accelerations only; `coordinate`: that of the coordinates' Jacobian, None where one order
    serves both; `right_inverse` (nq × coordinate rows): that of the coordinates' Jacobian, from a state of this step or
    of an earlier one.
    """

    velocity: PivotOrder
    acceleration: PivotOrder | None
    coordinate: PivotOrder | None
    right_inverse: Float[Array, "nq mq"]


class ConstrainedAcceleration(eqx.Module):
    """Velocities on the manifold of their coordinates, accelerations, the factor of the velocities' Jacobian, and
    whether friction `failed` to determine the accelerations; None of a system without.
    """

    u: Float[Array, "nu"]
    udot: Float[Array, "nu"]
    factor: Factor
    failed: Bool[Array, ""] | None = None


class RestoredState(eqx.Module):
    """A state on the manifold and its accelerations.

    **Fields:** `q`, `u`, `udot`; `iterations` of Newton's method for positions and whether they `failed`, None in
    tangents.
    """

    q: Float[Array, "nq"]
    u: Float[Array, "nu"]
    udot: Float[Array, "nu"]
    iterations: Int[Array, ""] | None
    failed: Bool[Array, ""] | None


def shares_split(system: AbstractEquation) -> bool:
    """Whether one split serves coordinates and velocities: q̇ = u, and no nonholonomic rows."""
    return system.rates_are_velocities and system.velocity_rows == system.position_rows


def coordinate_factor(system: AbstractEquation, t: Scalar, q: Float[Array, "nq"], split: ChartIndices) -> Factor:
    """Factor of the coordinates' Jacobian in a chart."""
    order = split.velocity if split.coordinate is None else split.coordinate
    return eliminate(system.coordinate_jacobian(t, q), order, system.coordinate_rank)


def correct_positions(
    system: AbstractEquation, t: Scalar, q: Float[Array, "nq"], split: ChartIndices
) -> Float[Array, "nq"]:
    """Coordinates nearer to the manifold, by one modified-Newton correction with the stored matrix."""
    if system.coordinate_rank == 0:
        return q
    return q - split.right_inverse @ system.coordinate_residual(t, q)


# Each function with a derivative rule is wrapped in a compiled one, so that it is traced once for all its places.
@eqx.filter_jit
def ideal_acceleration(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    order: PivotOrder,
) -> ConstrainedAcceleration:
    """Accelerations of a system with ideal constraints at coordinates on the manifold or near it.

    **Arguments:** `u`: independent velocities exact, dependent ones a guess; `order` of elimination.
    """
    return _ideal_acceleration(system, formulation, t, q, u, order)


@eqx.filter_custom_jvp
def _ideal_acceleration(system, formulation, t, q, u, order):
    jacobian = system.jacobian(t, q, u)
    solved = eliminate(jacobian, order, system.velocity_rank)
    if system.linear and system.drift_free:
        u = solved.null_space @ u[order.columns[system.velocity_rank :]]
    else:
        u = u - solved.right_inverse @ system.velocity_residual(t, q, u)
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    jacobian = DenseJacobian(jacobian, solved)
    udot, _ = formulation.solve(system.inertia(t, q, u), system.force(t, q, u), jacobian, gamma)
    return ConstrainedAcceleration(u, udot, solved)


@eqx.filter_jit
def general_acceleration(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    split: ChartIndices,
) -> ConstrainedAcceleration:
    """The same for any constraints, ideal or not, also those that bind accelerations only. The factors are those of
    this state, and are differentiated with it.
    """

    def velocity_factor(u):
        return eliminate(system.velocity_jacobian(t, q, u), split.velocity, system.velocity_rank)

    solved = velocity_factor(u)
    u = u - solved.right_inverse @ system.velocity_residual(t, q, u)
    if not system.linear:
        solved = velocity_factor(u)
        u = u - solved.right_inverse @ system.velocity_residual(t, q, u)
    jacobian = system.jacobian(t, q, u)
    every = solved if split.acceleration is None else eliminate(jacobian, split.acceleration, system.acceleration_rank)
    out = solve_constrained(system, formulation, t, q, u, DenseJacobian(jacobian, every))
    return ConstrainedAcceleration(u, out.udot, solved, out.failed)


@eqx.filter_jit
def restore_state(
    system: AbstractEquation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    linearized_at: ConstrainedAcceleration,
    split: ChartIndices,
    tol: Scalar,
) -> RestoredState:
    """Restore a state to the manifold and find the accelerations of a constrained system there.

    They are wrong by the square of the distance to the state of `linearized_at`.

    **Arguments:** `q`, `u`: the state, independent entries exact, dependent ones a guess; `linearized_at`: the
    accelerations of a state close by at the same time; `tol`: size of the last Newton correction, relative to the
    system's size.
    """
    return _restore_state(system, t, q, u, linearized_at, split, tol)


@eqx.filter_custom_jvp
def _restore_state(system, t, q, u, linearized_at, split, tol):
    solved, udot = linearized_at.factor, linearized_at.udot
    q, iterations, failed = restore_positions(system, t, q, split, tol)
    # The factor is wrong by the distance of the two states, so the first correction leaves its square, and the second
    # its cube.
    u = u - solved.right_inverse @ system.velocity_residual(t, q, u)
    if not system.linear:
        step = solved.right_inverse @ system.velocity_residual(t, q, u)
        u = u - step
        failed = failed | ~(jnp.max(jnp.abs(step)) <= jnp.sqrt(tol) * (1.0 + jnp.max(jnp.abs(u))))
    # Residuals of the equations of motion, `A u̇ − γ` and `M u̇ − F − Aᵀ λ`.
    unbalanced = _unbalanced(system, t, q, u, udot)
    multipliers = solved.right_inverse.T @ unbalanced
    constraint_residual = system.acceleration_residual(t, q, u, udot)
    force_residual = unbalanced - system.constraint_force(t, q, u, multipliers)
    udot = udot + _solve_linear(system.inertia(t, q, u), solved, constraint_residual, force_residual)
    return RestoredState(q, u, udot, iterations, failed)


def _unbalanced(system, t, q, u, udot):
    """`M u̇ − F`, what the constraints have to balance."""
    return system.inertia(t, q, u).product(udot) - system.force(t, q, u)


def _solve_linear(inertia, solved, constraint_residual, force_residual):
    """The change of accelerations that makes these residuals vanish; that of the multipliers is eliminated."""
    particular = -(solved.right_inverse @ constraint_residual)
    reduced = solved.null_space.T @ inertia.product(solved.null_space)
    load = solved.null_space.T @ (force_residual + inertia.product(particular))
    return particular - solved.null_space @ solve_positive(reduced, load)


@eqx.filter_custom_jvp
def restore_positions(
    system: AbstractEquation, t: Scalar, q: Float[Array, "nq"], split: ChartIndices, tol: float
) -> tuple[Float[Array, "nq"], Int[Array, ""] | None, Bool[Array, ""] | None]:
    """Solve `Φ = 0` for the dependent coordinates by Newton with a fixed matrix: `(q, iterations, failed)`."""
    if system.coordinate_rank == 0:
        return q, jnp.array(0), jnp.array(False)
    scale = system.coordinate_scale()

    def correct(q):
        step = split.right_inverse @ system.coordinate_residual(t, q)
        return q - step, jnp.max(jnp.abs(step) / scale)

    # Where velocities and coordinates share their factor, it is of this time, and wrong by the first correction only;
    # of an older one nothing is known.
    first = jnp.full((), 1.0 if split.coordinate is None else 0.0, q.dtype)
    return chord(correct, q, first=first, tol=tol, most=_MAX_ITERATIONS, peel=True)


# Derivatives


@_ideal_acceleration.def_jvp
def _ideal_acceleration_jvp(primals, tangents):
    system, formulation, t, q, u, order = primals
    dsystem, _, dt, dq, du, _ = tangents
    out = ideal_acceleration(system, formulation, t, q, u, order)
    solved = out.factor
    at, along = _push_velocities((system, t, q, out.u), (dsystem, dt, _dense(dq, q), _dense(du, u)), solved)
    djacobian = _push(lambda s, t, q, u: s.jacobian(t, q, u), at, along)
    pushed = solved.right_inverse @ djacobian
    dfactor = Factor(-(pushed @ solved.right_inverse), -(pushed @ solved.null_space), None)
    return out, ConstrainedAcceleration(along[3], _push_accelerations(at, along, out.udot, solved), dfactor)


@_restore_state.def_jvp
def _restore_state_jvp(primals, tangents):
    system, t, q, u, linearized_at, split, tol = primals
    dsystem, dt, dq, du, _, _, _ = tangents
    out = restore_state(system, t, q, u, linearized_at, split, tol)
    # The factor of the other state solves the equations, but only that of this state differentiates them.
    solved = eliminate(system.jacobian(t, out.q, out.u), split.velocity, system.velocity_rank)
    dq = _dense(dq, q)
    if system.coordinate_rank > 0:
        own = solved if split.coordinate is None else coordinate_factor(system, t, out.q, split)
        dq = _push_positions(system, t, out.q, own, (dsystem, dt, dq))
    at, along = _push_velocities((system, t, out.q, out.u), (dsystem, dt, dq, _dense(du, u)), solved)
    dudot = _push_accelerations(at, along, out.udot, solved)
    return out, RestoredState(dq, along[3], dudot, None, None)


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
    return along[2] - own.right_inverse @ residual


def _push_velocities(at, along, solved):
    """Point and tangent with that of the velocities on the manifold."""
    dsystem, dt, dq, du = along
    residual = _push(lambda s, t, q, u: s.velocity_residual(t, q, u), at, along)
    return at, (dsystem, dt, dq, du - solved.right_inverse @ residual)


def _push_accelerations(at, along, udot, solved):
    system, t, q, u = at
    unbalanced, of_unbalanced = eqx.filter_jvp(lambda s, t, q, u: _unbalanced(s, t, q, u, udot), at, along)
    multipliers = solved.right_inverse.T @ unbalanced
    of_acceleration = _push(lambda s, t, q, u: s.acceleration_residual(t, q, u, udot), at, along)
    of_multipliers = _push(lambda s, t, q, u: s.constraint_force(t, q, u, multipliers), at, along)
    of_force = _dense(of_unbalanced, unbalanced) - of_multipliers
    return _solve_linear(system.inertia(t, q, u), solved, of_acceleration, of_force)


def _push(fn, primals, tangents):
    return _dense(*reversed(eqx.filter_jvp(fn, primals, tangents)))


def _dense(tangent, primal):
    return jnp.zeros_like(primal) if tangent is None else tangent
