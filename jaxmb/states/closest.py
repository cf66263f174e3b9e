"""The closest configuration and the closest velocities to a guess that satisfy the constraints.

The configuration minimises `½ Σ ((q − q_guess)/scale)²` subject to `Φ(t, q) = 0`, with some coordinates held. The
velocities minimise `½ Σ ((u − u_guess)/scale)²` subject to `ψ(t, q, u) = 0`, with some rates held. Gauss–Newton steps
lead to the constraints, then Newton's method along the constraints to the minimiser. The minimisers are differentiated
by the implicit function theorem.

No dense matrix is formed for a system with an order of elimination and very many rows. With the rates `q̇ = K u` and the
scales S the closest configuration satisfies

    g(q, μ) = Kᵀ S⁻² (q − q_guess) + Aᵀ μ = 0,    Φ(q) = 0.

The linear systems of Newton's method are solved by conjugate gradients in the null space of A. The preconditioner is
the metric `M = Kᵀ S⁻² K`, projected by the elimination of `A M⁻¹ Aᵀ`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Coordinates, Scalar
from ..linalg.arrays import namespace
from ..linalg.elimination import full_pivot, solve
from ..linalg.inertia import DiagonalInertia
from ..linalg.jacobian import MassProjector
from ..linalg.jitted import jitted
from ..linalg.newton import newton, root, solve_linear
from ..linalg.pushed import filled
from ..system.equation import AbstractEquation
from ..system.instant import Instant

# From this number of rows on, closest states of systems with an order of elimination are found in blocks.
_MANY_ROWS = 300

# Largest number of Gauss–Newton steps to the constraints. Each must reduce the squared residuals by this share, a part
# of a step by this part of the share.
_ITERATIONS = 400
_PROGRESS = 0.001
# Rounding errors of residuals, in units of the machine's precision and of the terms of their linearisation.
_ROUNDING = 4.0
# Largest error of the linearisation, relative to the change of the residuals, that lets the next step be longer.
_STRAIGHT = 0.01
# Pivots of implied rows, relative to the largest entry of the diagonal.
_SHIFT = 1e-13
# In blocks these pivots are a multiple of the largest residual, as in the method of Levenberg and Marquardt. They are
# at least this power of eps, 1e-11 in double precision.
#
# Off the constraints implied rows contradict each other by the square of the distance. Multipliers are this square over
# the pivot, with errors of eps over the pivot again. (Bennett's linkage, from poses that are off by 1e-9 to 1e-1:
# residuals of 1e-12 to 1 with all pivots 1e-13, below 3e-14 with these.)
_OF_RESIDUAL = 1e-3
_LEAST = 0.7

# Newton's method on the optimality conditions, from nearby: size of the last step, and largest number of steps.
_REFINED = 1e-10
_REFINEMENTS = 16

# In blocks, rows are independent if every pivot of the elimination (a squared distance between rows of unit norm)
# exceeds this. A row of n four-bars with its crank held has a pivot of 0.7 / n³; 333 four-bars held twice have 5e-14.
_INDEPENDENT = 1e-12
# Newton's method along the constraints in blocks: largest number of steps plus halvings, and the size of steps that are
# accepted without a decrease of the distance.
_STEPS = 60
_LAST = 1e-6


def tolerance(dtype) -> float:
    """The largest scaled residual that counts as zero: 1e-10 in double precision."""
    return float(jnp.finfo(dtype).eps) ** 0.64


def independent_above(dtype) -> float:
    """The pivot or singular value, relative to the largest, below which rows depend on each other: 9e-8 in double
    precision. A search reaches a singular configuration to the root of eps only; its pivots there are a few such roots.
    """
    return float(jnp.finfo(dtype).eps) ** 0.45


def rounding_of(jacobian: Any, q: Any) -> Any:
    """The rounding errors of residuals far from the origin, from their derivatives."""
    xp = namespace(jacobian, q)
    return _ROUNDING * float(jnp.finfo(q.dtype).eps) * (xp.abs(jacobian) @ xp.abs(q))


def largest_residual(
    residual: Float[Array, "m"], row_norms: Float[Array, "m"], rounding: Any = 0.0
) -> Float[Array, ""]:
    """The largest residual beyond `rounding` errors, with each row divided by the norm of its scaled gradient."""
    xp, precision = namespace(residual, row_norms), jnp.finfo(residual.dtype)
    floor = precision.eps**0.75 * xp.max(row_norms, initial=0.0) + precision.tiny
    return xp.max(xp.maximum(xp.abs(residual) - rounding, 0.0) / xp.maximum(row_norms, floor), initial=0.0)


def residual_size(
    system: AbstractEquation, t: Scalar, q: Coordinates, jacobian: Float[Array, "m nq"]
) -> Float[Array, ""]:
    """`largest_residual` of `coordinate_residual`; `jacobian`: its Jacobian at q or near it."""
    scaled = jacobian * system.coordinate_scale()[None, :]
    sizes, rounding = jnp.sqrt(jnp.sum(scaled * scaled, axis=1)), rounding_of(jacobian, q)
    return largest_residual(system.coordinate_residual(t, q), sizes, rounding)


# Gauss–Newton steps to the constraints


def next_reach(reach: Any, before: Any, after: Any, share: Any) -> Any:
    """The largest size of the next step, in the scales of the coordinates.

    It doubles while residuals fall as their linearisation says, as along a slide, and else it is one: rotations by more
    than about a radian leave the region where the linearisation is valid.

    **Arguments:** `reach` of the last step; residuals before and after it; `share`: its part of a Newton step.
    """
    xp = namespace(before, after)
    off = xp.sum((after - (1 - share) * before) ** 2)
    return xp.where(off <= (_STRAIGHT * share) ** 2 * xp.sum(before**2), 2.0 * reach, 1.0)


def meet_constraints(
    system: AbstractEquation, t: Scalar, start: Coordinates, scale: Float[Array, "nq"]
) -> tuple[Float[Array, "nq"], Float[Array, "m nq"]]:
    """Gauss–Newton from a guess to the constraints, along scaled gradients, with step halving; without derivative.

    Implied rows are allowed: the normal equations are regularised at rounding level.

    **Returns:** the configuration, and the Jacobian of its last correction.
    """
    residual = lambda q: system.coordinate_residual(t, q)

    def correct(at):
        q, _, reach = at
        before, jacobian = residual(q), system.coordinate_jacobian(t, q)
        scaled = jacobian * scale[None, :]
        gram = scaled @ scaled.T
        shift = _SHIFT * jnp.max(jnp.diag(gram)) + jnp.finfo(q.dtype).tiny
        step = -scale * (scaled.T @ solve(gram + shift * jnp.eye(gram.shape[0], dtype=q.dtype), before))
        longest = jnp.max(jnp.where(scale > 0, jnp.abs(step) / jnp.where(scale > 0, scale, 1.0), 0.0))
        best, size, _, reach = _shortened(residual, lambda step: q + step, before, step, longest / reach, reach)
        return (best, jacobian, reach), size

    def far(at, size):
        q, *_ = at
        return (size > 1e-2 * tolerance(q.dtype) * jnp.max(scale)) & jnp.all(jnp.isfinite(q))

    none = jnp.zeros((system.coordinate_rows, system.nq), start.dtype)
    begun = start, none, jnp.ones((), start.dtype)
    return newton(correct, far, begun, most=_ITERATIONS, dtype=start.dtype)[0][:2]


def meet_in_blocks(start: Instant, fixed: Bool[np.ndarray, "nu"]) -> Float[Array, "nq"]:
    """Gauss–Newton from a guess to the constraints along velocities, without motion along fixed velocities.

    No dense matrix is formed if the system has an order of elimination. The regularisation of the normal equations is
    proportional to the residuals.

    **Arguments:** `start`: a guess at rest.
    """
    system, dtype = start.system, start.q.dtype
    scale = system.velocity_scale()
    least = float(jnp.finfo(dtype).eps) ** _LEAST
    metric = DiagonalInertia(jnp.where(fixed, jnp.inf, 1 / scale**2))
    residual = lambda q: start.with_(q=q).position_residual

    def correct(carry):
        q, reach = carry
        at = start.with_(q=q)
        before, jacobian = at.position_residual, at.binding_velocities
        largest = largest_residual(before, jacobian.row_norms(scale)[: system.position_rows])
        gram = jacobian.gram(metric, jacobian.responses(metric))
        factor = gram.eliminate(jnp.clip(_OF_RESIDUAL * largest, least, _OF_RESIDUAL))
        multipliers = factor.refined(jacobian.gather_rows(at.position_rows))
        step = -metric.solve(jacobian.transpose_product(jacobian.scatter_rows(multipliers)))
        longest = jnp.max(jnp.abs(step) / scale)
        moved = lambda step: at.moved(step).q
        best, size, better, reach = _shortened(residual, moved, before, step, longest / reach, reach)
        return (jnp.where(better, best, q), reach), size

    small = float(jnp.finfo(dtype).eps) ** 0.75
    far = lambda carry, size: (size > small * jnp.max(scale)) & jnp.all(jnp.isfinite(carry[0]))
    begun = start.normalized().q, jnp.ones((), dtype)
    return newton(correct, far, begun, most=_ITERATIONS, dtype=dtype)[0][0]


def _shortened(residual: Callable[[Array], Array], moved: Callable[[Array], Array], before, step, longest, reach):
    """The best configuration along a Gauss–Newton step, the step's size, whether it reduces the residuals, and the
    reach of the next step.

    The size is zero if the residuals hardly decrease.

    **Arguments:** residuals `before` the step; `longest`: the size of the step relative to its `reach`.
    """
    squares = jnp.sum(before**2)
    share = jnp.minimum(1.0, 1.0 / jnp.where(longest > 0, longest, 1.0))
    step = step * share
    lengths = 0.5 ** jnp.arange(8, dtype=step.dtype)
    reached = jax.vmap(lambda a: moved(a * step))(lengths)
    after = jax.vmap(residual)(reached)
    sizes = jnp.sum(after**2, axis=1)
    best = jnp.argmin(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))
    # Residuals that hardly decrease cannot vanish, and in a batch all members would wait for this search.
    size = jnp.where(sizes[best] < (1 - _PROGRESS * share) * squares, jnp.max(jnp.abs(step)), 0.0)
    return reached[best], size, sizes[best] < squares, next_reach(reach, before, after[0], share)


# Closest states


def _in_blocks(system, given):
    """`given`, by default whether closest states should be found without dense matrices."""
    only_positions = system.velocity_rows == system.position_rows
    suits = system.elimination is not None and only_positions and system.position_rows >= _MANY_ROWS
    return suits if given is None else given


@jitted
def closest_configuration(
    system: AbstractEquation,
    t: Scalar,
    guess: Coordinates,
    held: tuple[bool, ...],
    rank: int,
    in_blocks: bool | None = None,
) -> tuple[Float[Array, "nq"], Bool[Array, ""]]:
    """The configuration closest to the guess with some coordinates held, and whether residuals are at rounding level.

    **Arguments:** `rank` of the rows in the columns that are not held; `in_blocks`: whether to work without dense
    matrices, by default for very many rows.
    """
    if system.coordinate_rows == 0:
        return guess, jnp.array(True)
    fixed = np.array(held)
    without = system.held_velocities(fixed)
    if _in_blocks(system, in_blocks) and without is not None:
        return _configuration_in_blocks(system, t, guess, fixed, without)
    scale = jnp.where(fixed, 0.0, system.coordinate_scale())
    start = lax.stop_gradient(guess)
    frozen = lax.stop_gradient(system)
    q, jacobian = lax.stop_gradient(meet_constraints(frozen, lax.stop_gradient(t), start, scale))
    ok = residual_size(frozen, t, q, jacobian) <= tolerance(q.dtype)

    # Newton's method on the optimality conditions of the independent rows makes the minimiser exact.
    pivots = full_pivot(jacobian, scale=scale, tol=independent_above(q.dtype))
    ok = ok & (pivots.rank == rank)
    rows = pivots.order.rows[:rank]

    # Without a minimiser, equations with a solution replace the optimality conditions, so that derivatives stay finite.
    closed = ok

    def conditions(z):
        q, multipliers = z[: system.nq], z[system.nq :]
        independent = lambda q: system.coordinate_residual(t, q)[rows]
        balance, residual = optimality(independent, q - guess, q, multipliers, system.coordinate_scale(), fixed)
        return jnp.concatenate([jnp.where(closed, balance, q - guess), jnp.where(closed, residual, multipliers)])

    selected = (jacobian * scale[None, :])[rows]
    multipliers = solve(
        selected @ selected.T, selected @ jnp.where(fixed, 0.0, (start - q) / jnp.where(fixed, 1.0, scale))
    )
    nearby = jnp.concatenate([jnp.where(closed, q, start), jnp.where(closed, multipliers, 0.0)])
    refined = root(conditions, nearby, _refine)[: system.nq]
    ok = ok & jnp.all(jnp.isfinite(refined)) & (residual_size(frozen, t, refined, jacobian) <= tolerance(q.dtype))
    return jnp.where(ok, refined, q), ok


def optimality(
    residual: Callable[[Array], Float[Array, "m"]],
    moved: Float[Array, "n"],
    x: Float[Array, "n"],
    multipliers: Float[Array, "m"],
    scale: Float[Array, "n"],
    fixed: Bool[np.ndarray, "n"],
) -> tuple[Float[Array, "n"], Float[Array, "m"]]:
    """The conditions of the closest state x, which has `moved` from the guess: the balance of the distance's gradient
    with the forces of the multipliers, and the residual.

    **Arguments:** the `scale` of each entry of x; `fixed`: which entries keep their values.
    """
    unmet, pull = jax.vjp(residual, x)
    (gradient,) = pull(multipliers)
    return moved / jnp.where(fixed, 1.0, scale) ** 2 + jnp.where(fixed, 0.0, gradient), unmet


def _refine(residual, x):
    def correct(x):
        value, push = jax.linearize(residual, x)
        step = solve_linear(push, value)
        return x - step, jnp.max(jnp.abs(step) / (1.0 + jnp.abs(x)))

    return newton(correct, lambda _, size: size > _REFINED, x, most=_REFINEMENTS, dtype=x.dtype)[0]


@jitted
def closest_velocities(
    guess: Instant, held: tuple[bool, ...], in_blocks: bool | None = None
) -> tuple[Float[Array, "nu"], Bool[Array, ""]]:
    """The velocities closest to the guess with some rates held, and whether residuals are at rounding level.

    Held rates may outnumber the degrees of freedom if they agree with each other.
    """
    system, u = guess.system, guess.u
    if system.velocity_rows == 0:
        return u, jnp.array(True)
    fixed = np.array(held)
    if _in_blocks(system, in_blocks):
        return _velocities_in_blocks(guess, fixed)
    scale = jnp.where(fixed, 0.0, system.velocity_scale())
    at, rank, ok = guess, system.velocity_rank, jnp.array(True)
    jacobian = at.velocity_jacobian
    for _ in range(1 if system.linear else 8):
        jacobian = at.velocity_jacobian
        pivots = full_pivot(jacobian, scale=scale)
        if not fixed.any():
            ok = ok & (pivots.rank == rank)
        rows = pivots.order.rows[:rank]
        # Rows without a pivot have no free column, so only the held rates can satisfy them.
        bound = jnp.arange(rank) >= pivots.rank
        selected = jnp.where(bound[:, None], 0.0, jacobian[rows] * scale[None, :])
        gram = selected @ selected.T + jnp.diag(bound.astype(u.dtype))
        at = at.with_(u=at.u - scale * (selected.T @ solve(gram, at.velocity_residual[rows])))
    size = 1.0 + jnp.max(jnp.abs(jacobian) @ jnp.abs(at.u))
    return at.u, ok & (jnp.max(jnp.abs(at.velocity_residual)) <= 1e2 * tolerance(u.dtype) * size)


# Without dense matrices


def _configuration_in_blocks(system, t, guess, held, fixed):
    """`closest_configuration` in blocks, with some coordinates held, and so some velocities fixed."""
    where = _Held(tuple(held.tolist()), tuple(fixed.tolist()))
    at_rest = Instant(system, jnp.asarray(t, guess.dtype), guess, jnp.zeros(system.nu, guess.dtype))
    return _closest(at_rest, where, tolerance(guess.dtype))


def _velocities_in_blocks(guess, held):
    """`closest_velocities` in blocks, with some rates held."""
    # Held rates have an infinite mass.
    metric = DiagonalInertia(jnp.where(held, jnp.inf, 1 / guess.system.velocity_scale() ** 2))
    projector = guess.with_(u=jnp.zeros_like(guess.u)).binding_velocities.projector(metric)
    u = guess.u + projector.cancel(guess.velocity_rows)
    return u, jnp.all(jnp.isfinite(u)) & (projector.factor.smallest_pivot() > _INDEPENDENT)


class _Held(eqx.Module):
    coordinates: tuple[bool, ...] = eqx.field(static=True)
    velocities: tuple[bool, ...] = eqx.field(static=True)


class _Optimality(NamedTuple):
    """The optimality conditions of the closest configuration.

    **Fields:** the `projector` in the metric M; the `multipliers` μ; the `gradient` g.
    """

    projector: MassProjector
    multipliers: Float[Array, "m"]
    gradient: Float[Array, "nu"]


@eqx.filter_custom_jvp
def _closest(guess, held, tol):
    system, dtype, fixed = guess.system, guess.q.dtype, np.array(held.velocities)
    square = 1 / system.coordinate_scale() ** 2
    distance = lambda q: jnp.sum(square * (q - guess.q) ** 2)

    def correct(carry):
        q, step, length, _ = carry
        at = guess.with_(q=meet_in_blocks(guess.with_(q=q).moved(length * step), fixed))
        new, norms = at.q, at.binding_velocities.row_norms(system.velocity_scale())
        residual = largest_residual(at.position_residual, norms[: system.position_rows])
        before, after = distance(q), distance(new)
        size = length * jnp.max(jnp.abs(step) / system.velocity_scale())
        # The first step leads to the constraints; the last steps change the distance by rounding errors only.
        better = (length == 0.0) | (after < before) | (size <= _LAST)
        go_on = lambda: (new, _newton_step(at, guess.q, fixed), jnp.ones_like(length), residual)
        halve = lambda: (q, step, 0.5 * length, residual)
        out = lax.cond(better, go_on, halve)
        ahead = jnp.max(jnp.abs(out[1]) / system.velocity_scale()) * out[2]
        return out, jnp.where(residual <= tol, ahead, jnp.inf)

    none = jnp.zeros((), dtype)
    far = lambda carry, ahead: (ahead > 1e-3 * tol) & jnp.all(jnp.isfinite(carry[0])) & ~(carry[3] > tol)
    start = guess.q, jnp.zeros(system.nu, dtype), none, none
    (q, _, length, residual), ahead = newton(correct, far, start, most=_STEPS, dtype=dtype)
    projector = _optimality(guess.with_(q=q), guess.q, fixed).projector
    ok = jnp.all(jnp.isfinite(q)) & (residual <= tol) & (ahead <= tol) & (length > 0)
    return q, ok & (projector.factor.smallest_pivot() > _INDEPENDENT)


@_closest.def_jvp
def _closest_jvp(primals, tangents):
    guess, held, tol = primals
    q, ok = _closest(guess, held, tol)
    at, fixed = guess.with_(q=q), np.array(held.velocities)
    optimum = _optimality(at, guess.q, fixed)
    dguess = filled(guess.q, tangents[0].q)
    moved = jnp.where(np.array(held.coordinates), dguess, 0.0)

    def equations(at, guess):
        return _gradient(at, guess, optimum.multipliers), at.position_rows

    _, (gradient, unmet) = eqx.filter_jvp(equations, (at, guess.q), (tangents[0].with_(q=moved), dguess))
    step = _solve(at, guess.q, fixed, optimum, -gradient, -unmet)
    along = jax.jvp(lambda u: at.with_(u=u).rates, (jnp.zeros_like(step),), (step,))[1]
    return (q, ok), (moved + along, None)


def _optimality(at, guess, fixed):
    metric = DiagonalInertia(jnp.where(fixed, jnp.inf, _weights(at)))
    projector = at.binding_velocities.projector(metric)
    gradient = _gradient(at, guess, jnp.zeros(at.system.acceleration_rows, guess.dtype))
    multipliers = -projector.balancing(gradient)
    return _Optimality(projector, multipliers, gradient + projector.jacobian.transpose_product(multipliers))


def _gradient(at, guess, multipliers):
    """`g`, for constant multipliers."""
    rates, scale = lambda u: at.with_(u=u).rates, at.system.coordinate_scale()
    (pulled,) = jax.linear_transpose(rates, jnp.zeros(at.system.nu, guess.dtype))((at.q - guess) / scale**2)
    return pulled + at.constraint_force(multipliers)


def _weights(at):
    """The diagonal of `Kᵀ S⁻² K`."""
    rates = lambda u: at.with_(u=u).rates
    ones = jnp.ones(at.system.nu, at.q.dtype)
    return jax.linear_transpose(rates, ones)(rates(ones) / at.system.coordinate_scale() ** 2)[0]


def _newton_step(at, guess, fixed):
    optimum = _optimality(at, guess, fixed)
    curved = _curvature(at, guess, fixed, optimum.multipliers)
    return optimum.projector.null_space_solution(curved, -optimum.gradient)


def _curvature(at, guess, fixed, multipliers):
    """The derivative of g, as a function of displacements along free velocities."""

    def along(v):
        v = jnp.where(fixed, 0.0, v)
        dq = jax.jvp(lambda u: at.with_(u=u).rates, (jnp.zeros_like(v),), (v,))[1]
        change = jax.jvp(lambda q: _gradient(at.with_(q=q), guess, multipliers), (at.q,), (dq,))[1]
        return jnp.where(fixed, 0.0, change)

    return along


def _solve(at, guess, fixed, optimum, gradient, unmet):
    """The displacement v that changes g and Φ by given amounts: `H v + Aᵀ δμ = gradient`, `A v = unmet`."""
    projector, order, nu = optimum.projector, optimum.projector.jacobian, at.system.nu
    curved = _curvature(at, guess, fixed, optimum.multipliers)
    free = ~fixed
    independent = order.active

    # One vector of v and δμ: the transpose of a solution needs derivatives of all parts of the right-hand side.
    join = lambda v, multipliers: jnp.concatenate([v, multipliers])

    def matrix(x):
        v, multipliers = x[:nu], x[nu:]
        forces = jnp.where(free, order.transpose_product(independent * multipliers), v)
        rows = independent * order.product(jnp.where(free, v, 0.0))
        return join(curved(v) + forces, rows + (1 - independent) * multipliers)

    def displacement(rows):
        return projector.direction(projector.multipliers(rows))

    def solve(_, b):
        forces, rows = b[:nu], b[nu:]
        particular = displacement(rows)
        v = particular + projector.null_space_solution(curved, forces - curved(particular))
        # Displacement and multipliers are refined once: the last pivots of long loops are small.
        v = v + displacement(rows - projector.jacobian.product(v))
        left = forces - curved(v)
        multipliers = projector.balancing(left)
        multipliers += projector.balancing(left - projector.jacobian.transpose_product(multipliers))
        return join(jnp.where(free, v, forces), multipliers + (1 - independent) * rows)

    right = join(jnp.where(free, gradient, 0.0), independent * unmet)
    return lax.custom_linear_solve(matrix, right, solve, symmetric=True)[:nu]
