"""The closest configuration and velocities of scenes of many bodies, without dense matrices.

With the rates `q̇ = K u` and the scales S the closest configuration satisfies

    g(q, μ) = Kᵀ S⁻² (q − q_guess) + Aᵀ μ = 0,    Φ(q) = 0.

Gauss–Newton steps lead to the constraints, and Newton's method along them to the minimiser. Its linear systems are
solved by conjugate gradients in the null space of A, with the metric `M = Kᵀ S⁻² K` as the preconditioner, which the
elimination of `A M⁻¹ Aᵀ` projects. Derivatives follow from the same equations.

Source: N. I. M. Gould, M. E. Hribar and J. Nocedal, "On the solution of equality constrained quadratic programming
problems arising in optimization", SIAM J. Sci. Comput. 23(4), 2001 (projected conjugate gradients).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Scalar
from ..linalg.inertia import DiagonalInertia
from ..linalg.jacobian import MassProjector
from ..linalg.newton import newton
from ..system import AbstractSystem
from ..system.displacement import displaced
from ..system.padded_rows import binding_velocities, position_rows, velocity_rows

# Rows are independent if every pivot of the elimination (a squared distance between rows of unit norm) exceeds this. A
# row of n four-bars with its crank held has a pivot of 0.7 / n³, and 5e-14 where 333 of them are held twice.
_INDEPENDENT = 1e-12
# Implied rows get a share of the largest entry of the diagonal as a pivot: this multiple of the largest residual, as in
# the method of Levenberg and Marquardt, and at least this power of eps, 1e-11 in double precision.
#
# Away from the constraints implied rows contradict each other in the square of the distance, and multipliers are that
# over the pivot, with errors of eps over the pivot again. Bennett's linkage from poses that are off by 1e-9 to 1e-1
# ended at residuals of 1e-12 to 1 where all pivots were 1e-13, and ends below 1e-14 with these.
_OF_RESIDUAL = 1e-3
_LEAST = 0.7
# Largest number of Gauss–Newton steps to the constraints; each must reduce the squares of the residuals to less than
# this share.
_ITERATIONS = 100
_PROGRESS = 0.999
# Newton's method along the constraints: largest number of steps and halvings of steps together, and a step that is
# small enough to be the last but one.
_STEPS = 60
_LAST = 1e-6
# Conjugate gradients: reduction of the residual, and largest number of iterations.
_REDUCTION = 1e-13
_GRADIENTS = 300


def meet_sparse(
    system: AbstractSystem, t: Scalar, start: Float[Array, "nq"], fixed: Bool[np.ndarray, "nu"]
) -> Float[Array, "nq"]:
    """The configuration to which Gauss–Newton with step halving leads from a guess, without motion along fixed
    velocities; without derivative. Implied rows are allowed: the normal equations are regularised in the measure of the
    residuals.
    """
    scale = system.velocity_scale()
    least = float(jnp.finfo(start.dtype).eps) ** _LEAST
    metric, at_rest = DiagonalInertia(jnp.where(fixed, jnp.inf, 1 / scale**2)), jnp.zeros_like(scale)

    def squares(q):
        return jnp.sum(system.position_residual(t, q) ** 2)

    def correct(q):
        residual = system.position_residual(t, q)
        jacobian = binding_velocities(system, t, q, at_rest)
        largest = largest_residual(residual, jacobian.row_norms(scale)[: system.position_rows])
        factor = jacobian.gram(metric).eliminate(jnp.clip(_OF_RESIDUAL * largest, least, _OF_RESIDUAL))
        multipliers = factor.refined(jacobian.gather_rows(position_rows(system, t, q)))
        step = -metric.solve(jacobian.transpose_product(jacobian.scatter_rows(multipliers)))
        # Rotations by more than about a radian leave the region where the linearisation is valid.
        longest = jnp.max(jnp.abs(step) / scale)
        step = step * jnp.minimum(1.0, 1.0 / jnp.where(longest > 0, longest, 1.0))
        lengths = 0.5 ** jnp.arange(8, dtype=q.dtype)
        moved = jax.vmap(lambda a: displaced(system, t, q, a * step))(lengths)
        sizes = jax.vmap(squares)(moved)
        best = jnp.argmin(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))
        before = jnp.sum(residual**2)
        step = jnp.where(sizes[best] < _PROGRESS * before, jnp.max(jnp.abs(step)), 0.0)
        return jnp.where(sizes[best] < before, moved[best], q), step

    small = float(jnp.finfo(start.dtype).eps) ** 0.75
    far = lambda q, size: (size > small * jnp.max(scale)) & jnp.all(jnp.isfinite(q))
    return newton(correct, far, system.normalize(start), most=_ITERATIONS, dtype=start.dtype)[0]


def largest_residual(residual: Float[Array, "m"], row_norms: Float[Array, "m"]) -> Float[Array, ""]:
    """The largest residual, each row scaled to unit norm of its gradient times the system's size."""
    largest = jnp.max(row_norms, initial=0.0)
    floor = jnp.finfo(residual.dtype).eps ** 0.75 * largest + jnp.finfo(residual.dtype).tiny
    return jnp.max(jnp.abs(residual) / jnp.maximum(row_norms, floor), initial=0.0)


def sparse_configuration(
    system: AbstractSystem,
    t: Scalar,
    guess: Float[Array, "nq"],
    held: Bool[np.ndarray, "nq"],
    fixed: Bool[np.ndarray, "nu"],
    tol: float,
) -> tuple[Float[Array, "nq"], Bool[Array, ""]]:
    """The configuration closest to a guess, with some coordinates held, and so some velocities fixed; and whether it
    was found: the residuals are at most `tol`.
    """
    where = _Held(tuple(held.tolist()), tuple(fixed.tolist()))
    return _closest(system, jnp.asarray(t, guess.dtype), guess, where, tol)


def sparse_velocities(
    system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], guess: Float[Array, "nu"], held: Bool[np.ndarray, "nu"]
) -> tuple[Float[Array, "nu"], Bool[Array, ""]]:
    """The velocities closest to a guess, with some rates held; and whether they were found."""
    # Rates that are held have an infinite mass.
    metric = DiagonalInertia(jnp.where(held, jnp.inf, 1 / system.velocity_scale() ** 2))
    here = binding_velocities(system, t, q, jnp.zeros_like(guess)).projector(metric)
    u = guess + here.cancel(velocity_rows(system, t, q, guess))
    return u, jnp.all(jnp.isfinite(u)) & (here.factor.smallest_pivot() > _INDEPENDENT)


class _Held(eqx.Module):
    coordinates: tuple[bool, ...] = eqx.field(static=True)
    velocities: tuple[bool, ...] = eqx.field(static=True)


class _Optimality(NamedTuple):
    """The equations of the closest configuration at one; `projector` in their metric."""

    projector: MassProjector
    multipliers: Float[Array, "m"]
    gradient: Float[Array, "nu"]


@eqx.filter_custom_jvp
def _closest(system, t, guess, held, tol):
    fixed = np.array(held.velocities)
    square = 1 / system.coordinate_scale() ** 2
    distance = lambda q: jnp.sum(square * (q - guess) ** 2)

    def correct(carry):
        q, step, length, _ = carry
        new = meet_sparse(system, t, displaced(system, t, q, length * step), fixed)
        norms = binding_velocities(system, t, new, jnp.zeros_like(step)).row_norms(system.velocity_scale())
        residual = largest_residual(system.position_residual(t, new), norms[: system.position_rows])
        before, after = distance(q), distance(new)
        size = length * jnp.max(jnp.abs(step) / system.velocity_scale())
        # The first step leads to the constraints, and the last ones change the distance by rounding errors only.
        better = (length == 0.0) | (after < before) | (size <= _LAST)
        go_on = lambda: (new, _newton_step(system, t, new, guess, fixed), jnp.ones_like(length), residual)
        halve = lambda: (q, step, 0.5 * length, residual)
        out = lax.cond(better, go_on, halve)
        ahead = jnp.max(jnp.abs(out[1]) / system.velocity_scale()) * out[2]
        return out, jnp.where(residual <= tol, ahead, jnp.inf)

    none = jnp.zeros(())
    far = lambda carry, ahead: (ahead > 1e-3 * tol) & jnp.all(jnp.isfinite(carry[0])) & ~(carry[3] > tol)
    start = guess, jnp.zeros(system.nu, guess.dtype), none.astype(guess.dtype), none.astype(guess.dtype)
    (q, _, length, residual), ahead = newton(correct, far, start, most=_STEPS, dtype=guess.dtype)
    at = _optimality(system, t, q, guess, fixed)
    found = jnp.all(jnp.isfinite(q)) & (residual <= tol) & (ahead <= tol) & (length > 0)
    return q, found & (at.projector.factor.smallest_pivot() > _INDEPENDENT)


@_closest.def_jvp
def _closest_jvp(primals, tangents):
    system, t, guess, held, tol = primals
    dsystem, dt, dguess, _, _ = tangents
    q, found = _closest(system, t, guess, held, tol)
    fixed = np.array(held.velocities)
    at = _optimality(system, t, q, guess, fixed)
    dguess = jnp.zeros_like(guess) if dguess is None else dguess
    moved = jnp.where(np.array(held.coordinates), dguess, 0.0)

    def equations(system, t, guess, q):
        return _gradient(system, t, q, guess, at.multipliers), position_rows(system, t, q)

    _, (gradient, unmet) = eqx.filter_jvp(equations, (system, t, guess, q), (dsystem, dt, dguess, moved))
    step = _solve(system, t, q, guess, fixed, at, -gradient, -unmet)
    along = jax.jvp(lambda u: system.rates(t, q, u), (jnp.zeros_like(step),), (step,))[1]
    return (q, found), (moved + along, None)


def _optimality(system, t, q, guess, fixed):
    metric = DiagonalInertia(jnp.where(fixed, jnp.inf, _weights(system, t, q)))
    projector = binding_velocities(system, t, q, jnp.zeros(system.nu, q.dtype)).projector(metric)
    gradient = _gradient(system, t, q, guess, jnp.zeros(system.acceleration_rows, q.dtype))
    multipliers = -projector.multipliers(projector.jacobian.product(metric.solve(gradient)))
    return _Optimality(projector, multipliers, gradient + projector.jacobian.transpose_product(multipliers))


def _gradient(system, t, q, guess, multipliers):
    """`g`, of a configuration that the multipliers do not depend on."""
    rates = lambda u: system.rates(t, q, u)
    (pulled,) = jax.linear_transpose(rates, jnp.zeros(system.nu, q.dtype))((q - guess) / system.coordinate_scale() ** 2)
    return pulled + system.constraint_force(t, q, jnp.zeros(system.nu, q.dtype), multipliers)


def _weights(system, t, q):
    """The diagonal of `Kᵀ S⁻² K`."""
    rates = lambda u: system.rates(t, q, u)
    ones = jnp.ones(system.nu, q.dtype)
    return jax.linear_transpose(rates, ones)(rates(ones) / system.coordinate_scale() ** 2)[0]


def _newton_step(system, t, q, guess, fixed):
    at = _optimality(system, t, q, guess, fixed)
    curved = _curvature(system, t, q, guess, fixed, at.multipliers)
    return _null_space_solution(curved, at.projector, -at.gradient)


def _curvature(system, t, q, guess, fixed, multipliers):
    """How g changes with a displacement along velocities that are not fixed."""

    def along(v):
        v = jnp.where(fixed, 0.0, v)
        dq = jax.jvp(lambda u: system.rates(t, q, u), (jnp.zeros_like(v),), (v,))[1]
        change = jax.jvp(lambda q: _gradient(system, t, q, guess, multipliers), (q,), (dq,))[1]
        return jnp.where(fixed, 0.0, change)

    return along


def _solve(system, t, q, guess, fixed, at, gradient, unmet):
    """The displacement that changes g and Φ by this much: `H v + Aᵀ δμ`, `A v`."""
    projector, order = at.projector, at.projector.jacobian
    curved = _curvature(system, t, q, guess, fixed, at.multipliers)
    free = ~fixed
    independent = order.scatter_rows(order.gather_rows(jnp.ones(system.acceleration_rows, q.dtype)))

    # One vector of both: the transpose of a solution needs every part of the right-hand side to have a derivative.
    join = lambda v, multipliers: jnp.concatenate([v, multipliers])

    def matrix(x):
        v, multipliers = x[: system.nu], x[system.nu :]
        forces = jnp.where(free, order.transpose_product(independent * multipliers), v)
        rows = independent * order.product(jnp.where(free, v, 0.0))
        return join(curved(v) + forces, rows + (1 - independent) * multipliers)

    def displacement(rows):
        return projector.direction(projector.multipliers(rows))

    def constraint_multipliers(forces):
        return projector.multipliers(projector.jacobian.product(projector.metric.solve(forces)))

    def solve(_, b):
        forces, rows = b[: system.nu], b[system.nu :]
        particular = displacement(rows)
        v = particular + _null_space_solution(curved, projector, forces - curved(particular))
        # Both are refined once: the last pivots of long loops are small.
        v = v + displacement(rows - projector.jacobian.product(v))
        left = forces - curved(v)
        multipliers = constraint_multipliers(left)
        multipliers += constraint_multipliers(left - projector.jacobian.transpose_product(multipliers))
        return join(jnp.where(free, v, forces), multipliers + (1 - independent) * rows)

    right = join(jnp.where(free, gradient, 0.0), independent * unmet)
    return lax.custom_linear_solve(matrix, right, solve, symmetric=True)[: system.nu]


def _null_space_solution(curved, projector, force):
    """`v` in the null space of A with `H v + Aᵀ δμ = force`, by projected conjugate gradients. Where a direction of
    negative curvature is met, what was found until then, or that direction.
    """

    def project(force):
        # Only its part along the null space is kept of a residual: the constraint forces in it would grow beside it.
        force = force - constraint_force(force)
        towards = projector.metric.solve(force)
        return force, towards - projector.direction(projector.multipliers(projector.jacobian.product(towards)))

    def constraint_force(force):
        free = projector.metric.solve(force)
        return projector.jacobian.transpose_product(projector.multipliers(projector.jacobian.product(free)))

    force, towards = project(force)
    size = jnp.vdot(force, towards)

    def correct(carry):
        x, left, along, size, k, _ = carry
        curve = curved(along)
        curvature = jnp.vdot(along, curve)
        convex = curvature > 0
        length = jnp.where(convex, size / jnp.where(convex, curvature, 1.0), jnp.where(k == 0, 1.0, 0.0))
        x = x + length * along
        left, towards = project(left - length * curve)
        new = jnp.vdot(left, towards)
        along = towards + jnp.where(size > 0, new / jnp.where(size > 0, size, 1.0), 0.0) * along
        return x, left, along, new, k + 1, convex

    def proceed(carry):
        return (carry[3] > _REDUCTION**2 * size) & (carry[4] < _GRADIENTS) & carry[5]

    start = jnp.zeros_like(force), force, towards, size, jnp.array(0), jnp.array(True)
    return lax.while_loop(proceed, correct, start)[0]
