"""One evaluation on the constraint manifold, with exact derivatives.

Given a guess of the state and a chart, `evaluate` keeps the independent coordinates and velocities, solves `Φ = 0`
and `ψ = 0` for the dependent ones, and the equations of motion for the accelerations. Jacobian, factor and influence
matrix are computed once and shared.

Its derivative does not follow the algorithm but the equations (implicit function theorem), with the factors that are
there anyway: it is cheap, independent of the formulation, and cannot pick up a frozen iterate. The factors' own
derivatives are part of the rule, so higher derivatives are right as well.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import Scalar
from ..elimination import Factor, Order, factor, solve_positive
from ..formulations import AbstractFormulation
from ..system import AbstractSystem

_MAX_ITERATIONS = 12


class Split(eqx.Module):
    """A chart's index sets and the carried matrix of its position Newton.

    **Fields:** `velocity`: order of elimination of the velocities' Jacobian; `coordinate`: that of the coordinates'
    Jacobian, None where one split serves both; `correction` (nq × coordinate rows): approximate solution of `Φ_q δq =
    −Φ` along dependent columns, made at `time`.
    """

    velocity: Order
    coordinate: Order | None
    correction: Float[Array, "nq mq"]
    time: Float[Array, ""]

    @property
    def coordinates(self) -> Order:
        return self.velocity if self.coordinate is None else self.coordinate


class Evaluation(eqx.Module):
    """A state on the manifold and what was computed there.

    **Fields:** `q`, `u`, `udot`; the velocity `factor`; `iterations` of the position Newton and
    `failed`, which tangents have not.
    """

    q: Float[Array, "nq"]
    u: Float[Array, "nu"]
    udot: Float[Array, "nu"]
    factor: Factor
    iterations: Int[Array, ""] | None
    failed: Bool[Array, ""] | None


def shared(system: AbstractSystem) -> bool:
    """Whether one split serves coordinates and velocities: q̇ = u, and no nonholonomic rows."""
    return system.rates_are_velocities and system.velocity_rows == system.position_rows


def coordinate_factor(system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], split: Split) -> Factor:
    """Factor of the coordinates' Jacobian in a chart."""
    jacobian = system.coordinate_jacobian(t, q)
    return factor(jacobian, split.coordinates, system.coordinate_rank)


@eqx.filter_custom_jvp
def evaluate(
    system: AbstractSystem,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    split: Split,
    tol: float,
) -> Evaluation:
    """Restore a state to the manifold and evaluate the accelerations there.

    **Arguments:** `q`, `u`: the state, independent entries exact, dependent ones a guess; `tol`: size of the last
    Newton correction, relative to the system's size.
    """
    q, iterations, failed = _restore_positions(system, t, q, split, tol)
    u, jacobian, solved, slow = _restore_velocities(system, t, q, u, split, tol)
    force = system.force(t, q, u)
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    udot, _ = formulation.solve(system.inertia(t, q), force, jacobian, gamma, solved)
    failed = failed | slow | ~jnp.all(jnp.isfinite(udot))
    return Evaluation(q, u, udot, solved, iterations, failed)


def _restore_positions(system, t, q, split, tol):
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

    # A matrix of this very time is wrong by the first correction only; of an older one nothing is known.
    before = jnp.where(split.time == t, jnp.ones((), q.dtype), jnp.zeros((), q.dtype))
    q, _, ahead, k = lax.while_loop(proceed, correct, correct((q, before, before, jnp.array(0))))
    return q, k, ~(ahead <= tol)


def _restore_velocities(system, t, q, u, split, tol):
    def solve(u):
        jacobian = system.jacobian(t, q, u)
        solved = factor(jacobian, split.velocity, system.velocity_rank)
        residual = jacobian @ u if system.linear and system.homogeneous else system.velocity_residual(t, q, u)
        return u - solved.correction @ residual, jacobian, solved

    if system.linear:
        return *solve(u), jnp.array(False)

    def correct(carry):
        u, _, k = carry
        new, _, _ = solve(u)
        return new, jnp.max(jnp.abs(new - u)), k + 1

    def proceed(carry):
        u, size, k = carry
        return (size > tol * (1 + jnp.max(jnp.abs(u)))) & (k < _MAX_ITERATIONS)

    u, _, k = lax.while_loop(proceed, correct, correct((u, None, jnp.array(0))))
    _, jacobian, solved = solve(u)
    return u, jacobian, solved, k >= _MAX_ITERATIONS


@evaluate.def_jvp
def _evaluate_jvp(primals, tangents):
    system, formulation, t, q, u, split, tol = primals
    dsystem, _, dt, dq, du, _, _ = tangents
    out = evaluate(system, formulation, t, q, u, split, tol)
    dq = jnp.zeros_like(q) if dq is None else dq
    du = jnp.zeros_like(u) if du is None else du
    q, u, udot, solved = out.q, out.u, out.udot, out.factor

    if system.coordinate_rank > 0:
        exact = solved if shared(system) else coordinate_factor(system, t, q, split)
        residual = _push(lambda s, t, q: s.coordinate_residual(t, q), (system, t, q), (dsystem, dt, dq))
        dq = dq - exact.correction @ residual
    at, along = (system, t, q, u), (dsystem, dt, dq, du)
    if system.velocity_rows == 0:
        acceleration = lambda s, t, q, u: s.inertia(t, q).solve(s.force(t, q, u))
        return out, Evaluation(dq, du, _push(acceleration, at, along), _zero(out.factor), None, None)

    du = du - solved.correction @ _push(lambda s, t, q, u: s.velocity_residual(t, q, u), at, along)
    along = (dsystem, dt, dq, du)
    inertia = system.inertia(t, q)
    multipliers = solved.correction.T @ (inertia.product(udot) - system.force(t, q, u))

    def equations(s, t, q, u):
        _, pull = jax.vjp(lambda u: s.velocity_residual(t, q, u), u)
        balance = s.inertia(t, q).product(udot) - s.force(t, q, u) - pull(multipliers)[0]
        return s.acceleration_residual(t, q, u, udot), balance

    unlevel, unbalance = _push(equations, at, along)
    particular = -solved.correction @ unlevel
    reduced = solved.basis.T @ inertia.product(solved.basis)
    load = solved.basis.T @ (unbalance + inertia.product(particular))
    dudot = particular - solved.basis @ solve_positive(reduced, load)

    djacobian = _push(lambda s, t, q, u: s.jacobian(t, q, u), at, along)
    dfactor = Factor(
        -solved.correction @ djacobian @ solved.correction, -solved.correction @ (djacobian @ solved.basis), None
    )
    return out, Evaluation(dq, du, dudot, dfactor, None, None)


def _push(fn, primals, tangents):
    return eqx.filter_jvp(fn, primals, tangents)[1]


def _zero(solved):
    return Factor(jnp.zeros_like(solved.correction), jnp.zeros_like(solved.basis), None)
