"""Accelerations on the constraint manifold, and the return to it along a chart, with exact derivatives.

A step needs both. `ideal_acceleration` takes predicted coordinates close to the manifold and factors the Jacobian
there: the one elimination of the step. `ChartConstraints` take the corrected state, keep its independent coordinates
and velocities, solve `Φ = 0` and `ψ = 0` for the dependent ones, and find the accelerations there by one Newton
correction of those of the prediction: it needs no Jacobian and no elimination, and costs a fifth. Where no state nearby
has been evaluated, `restore_positions` is followed by `ideal_acceleration`.

The factors' own derivatives are part of the rule, so higher derivatives are right as well.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._types import Coordinates, Scalar, Velocities
from ..formulations import AbstractFormulation
from ..formulations.formulation import solve_constrained
from ..linalg.elimination import Factor, PivotOrder, eliminate, solve_positive
from ..linalg.jacobian import DenseJacobian
from ..linalg.newton import chord
from ..system import AbstractEquation
from .constraints import AbstractConstraints, RestoredState, dense, push, push_accelerations, push_velocities

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

    u: Velocities
    udot: Float[Array, "nu"]
    factor: Factor
    failed: Bool[Array, ""] | None = None


def shares_split(system: AbstractEquation) -> bool:
    """Whether one split serves coordinates and velocities: q̇ = u, and no nonholonomic rows."""
    return system.rates_are_velocities and system.velocity_rows == system.position_rows


def coordinate_factor(system: AbstractEquation, t: Scalar, q: Coordinates, split: ChartIndices) -> Factor:
    """Factor of the coordinates' Jacobian in a chart."""
    order = split.velocity if split.coordinate is None else split.coordinate
    return eliminate(system.coordinate_jacobian(t, q), order, system.coordinate_rank)


def correct_positions(system: AbstractEquation, t: Scalar, q: Coordinates, split: ChartIndices) -> Float[Array, "nq"]:
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
    q: Coordinates,
    u: Velocities,
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
    jacobian = DenseJacobian(jacobian, solved, solved.rows)
    udot, _ = formulation.solve(system.inertia(t, q, u), system.force(t, q, u), jacobian, gamma)
    return ConstrainedAcceleration(u, udot, solved)


@eqx.filter_jit
def general_acceleration(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Coordinates,
    u: Velocities,
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
    out = solve_constrained(system, formulation, t, q, u, DenseJacobian(jacobian, every, every.rows))
    return ConstrainedAcceleration(u, out.udot, solved, out.failed)


@_ideal_acceleration.def_jvp
def _ideal_acceleration_jvp(primals, tangents):
    system, formulation, t, q, u, order = primals
    dsystem, _, dt, dq, du, _ = tangents
    out = ideal_acceleration(system, formulation, t, q, u, order)
    solved, at = out.factor, (system, t, q, out.u)
    here = ChartConstraints(solved, ChartIndices(order, None, None, solved.right_inverse))
    along = push_velocities(here, at, (dsystem, dt, dense(dq, q), dense(du, u)))
    pushed = solved.right_inverse @ push(lambda s, t, q, u: s.jacobian(t, q, u), at, along)
    dfactor = Factor(-(pushed @ solved.right_inverse), -(pushed @ solved.null_space), None)
    dudot = push_accelerations(here, at, along, RestoredState(q, out.u, out.udot))
    return out, ConstrainedAcceleration(along[3], dudot, dfactor)


@eqx.filter_custom_jvp
def restore_positions(
    system: AbstractEquation, t: Scalar, q: Coordinates, split: ChartIndices, tol: float
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


@restore_positions.def_jvp
def _restore_positions_jvp(primals, tangents):
    system, t, q, split, tol = primals
    dsystem, dt, dq, _, _ = tangents
    out = restore_positions(system, t, q, split, tol)
    dq = dense(dq, q)
    if system.coordinate_rank > 0:
        own = coordinate_factor(system, t, out[0], split)
        dq = _push_positions(own, (system, t, out[0]), (dsystem, dt, dq))
    return out, (dq, None, None)


def _push_positions(own, at, along):
    """Tangent of the coordinates on the manifold, from their factor there."""
    return along[2] - own.right_inverse @ push(lambda s, t, q: s.coordinate_residual(t, q), at, along)


class ChartConstraints(AbstractConstraints):
    """The constraints in a chart: independent coordinates and velocities keep their values.

    **Fields:** the `factor` of the velocities' Jacobian at a state; the `split`.
    """

    factor: Factor
    split: ChartIndices

    def restore(self, system, t, y, near, tol):
        q, iterations, failed = restore_positions(system, t, y.q, self.split, tol)
        # The factor is wrong by the distance of the two states, so the first correction leaves its square, and the
        # second its cube.
        right_inverse = self.factor.right_inverse
        u = y.u - right_inverse @ system.velocity_residual(t, q, y.u)
        if not system.linear:
            step = right_inverse @ system.velocity_residual(t, q, u)
            u = u - step
            failed = failed | ~(jnp.max(jnp.abs(step)) <= jnp.sqrt(tol) * (1.0 + jnp.max(jnp.abs(u))))
        # Residuals of the equations of motion, `A u̇ − γ` and `M u̇ − F − Aᵀ λ`. The accelerations are wrong by the
        # square of the distance.
        out = RestoredState(q, u, near.udot, None, iterations, failed)
        rows = system.acceleration_residual(t, q, u, near.udot)
        unbalanced = self._unbalanced(system, t, out)
        forces = unbalanced - system.constraint_force(t, q, u, right_inverse.T @ unbalanced)
        udot = near.udot + self.cancel_accelerations(system.inertia(t, q, u), forces, rows)
        return RestoredState(q, u, udot, None, iterations, failed)

    def at(self, system, t, q, u):
        factor = eliminate(system.jacobian(t, q, u), self.split.velocity, system.velocity_rank)
        return ChartConstraints(factor, self.split)

    def multipliers(self, system, t, restored):
        return self.factor.right_inverse.T @ self._unbalanced(system, t, restored)

    def _unbalanced(self, system, t, at):
        """`M u̇ − F`, what the constraints have to balance."""
        return system.inertia(t, at.q, at.u).product(at.udot) - system.force(t, at.q, at.u)

    def push_positions(self, at, along):
        system, t, q = at
        if system.coordinate_rank == 0:
            return along[2]
        own = self.factor if self.split.coordinate is None else coordinate_factor(system, t, q, self.split)
        return _push_positions(own, at, along)

    def cancel_velocities(self, residual):
        return -(self.factor.right_inverse @ residual)

    def cancel_accelerations(self, inertia, forces, rows):
        factor, particular = self.factor, self.cancel_velocities(rows)
        reduced = factor.null_space.T @ inertia.product(factor.null_space)
        load = factor.null_space.T @ (forces + inertia.product(particular))
        return particular - factor.null_space @ solve_positive(reduced, load)
