"""The configuration and the velocities that are closest to a guess among those that satisfy the constraints.

The configuration minimises `½ Σ ((q − q_guess)/scale)²` subject to `Φ(t, q) = 0`, with some coordinates held; the
velocities minimise `½ Σ ((u − u_guess)/scale)²` subject to `ψ(t, q, u) = 0`, with some rates held. Derivatives are
those of the minimisers, by the implicit function theorem.

If the system has an order of elimination and very many rows, no dense matrix is formed; see `closest_sparse`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Scalar
from ..linalg.elimination import full_pivot
from ..linalg.newton import newton, root, solve_linear
from ..system import AbstractEquation
from .closest_sparse import sparse_configuration, sparse_velocities

# From this number of rows on, the closest states of systems with an order of elimination are found by blocks.
MANY_ROWS = 300

# Largest number of Gauss–Newton steps to the constraints.
_ITERATIONS = 100
# Each of them must reduce the squares of the residuals to less than this share.
_PROGRESS = 0.999

# Newton's method on the optimality conditions, started near their solution: size of its last step, and largest number
# of steps.
_REFINED = 1e-10
_REFINEMENTS = 16


def eliminates_by_blocks(system: AbstractEquation) -> bool:
    """Whether closest states are found without dense matrices."""
    only_positions = system.velocity_rows == system.position_rows
    return system.elimination is not None and only_positions and system.position_rows >= MANY_ROWS


@eqx.filter_jit
def closest_configuration(
    system: AbstractEquation, t: Scalar, guess: Float[Array, "nq"], held: tuple[bool, ...], rank: int
) -> tuple[Float[Array, "nq"], Bool[Array, ""]]:
    """The configuration closest to the guess with some coordinates held; and whether every residual is at rounding
    level.

    `rank`: of the rows in the columns that are not held.
    """
    if system.coordinate_rows == 0:
        return guess, jnp.array(True)
    fixed = np.array(held)
    without = system.held_velocities(fixed)
    if eliminates_by_blocks(system) and without is not None:
        return sparse_configuration(system, t, guess, fixed, without, tolerance(guess.dtype))
    scale = jnp.where(fixed, 0.0, system.coordinate_scale())
    start = lax.stop_gradient(guess)
    frozen = lax.stop_gradient(system)
    q, jacobian = lax.stop_gradient(meet_constraints(frozen, lax.stop_gradient(t), start, scale))
    ok = residual_size(frozen, t, q, jacobian) <= tolerance(q.dtype)

    # Newton's method on the optimality conditions of the independent rows makes the minimiser exact.
    pivots = full_pivot(jacobian, scale=scale)
    ok = ok & (pivots.rank == rank)
    rows = pivots.order.rows[:rank]
    square = jnp.where(fixed, 1.0, scale) ** 2

    # Where there is no minimiser, the equations are replaced by ones with a solution, so that their derivatives stay
    # finite.
    closed = ok

    def optimality(z):
        q, multipliers = z[: system.nq], z[system.nq :]
        residual, pull = jax.vjp(lambda q: system.coordinate_residual(t, q)[rows], q)
        (gradient,) = pull(multipliers)
        balance = (q - guess) / square + jnp.where(fixed, 0.0, gradient)
        return jnp.concatenate([jnp.where(closed, balance, q - guess), jnp.where(closed, residual, multipliers)])

    selected = (jacobian * scale[None, :])[rows]
    multipliers = jnp.linalg.solve(
        selected @ selected.T, selected @ jnp.where(fixed, 0.0, (start - q) / jnp.sqrt(square))
    )
    nearby = jnp.concatenate([jnp.where(closed, q, start), jnp.where(closed, multipliers, 0.0)])
    refined = root(optimality, nearby, _refine)[: system.nq]
    ok = ok & jnp.all(jnp.isfinite(refined)) & (residual_size(frozen, t, refined, jacobian) <= tolerance(q.dtype))
    return jnp.where(ok, refined, q), ok


def _refine(residual, x):
    def correct(x):
        value, push = jax.linearize(residual, x)
        step = solve_linear(push, value)
        return x - step, jnp.max(jnp.abs(step) / (1.0 + jnp.abs(x)))

    return newton(correct, lambda _, size: size > _REFINED, x, most=_REFINEMENTS, dtype=x.dtype)[0]


@eqx.filter_jit
def closest_velocities(
    system: AbstractEquation, t: Scalar, q: Float[Array, "nq"], guess: Float[Array, "nu"], held: tuple[bool, ...]
) -> tuple[Float[Array, "nu"], Bool[Array, ""]]:
    """The velocities closest to the guess with some rates held; and whether every residual is at rounding level.

    More rates may be held than there are degrees of freedom, as long as they agree with each other.
    """
    if system.velocity_rows == 0:
        return guess, jnp.array(True)
    fixed = np.array(held)
    if eliminates_by_blocks(system):
        return sparse_velocities(system, t, q, guess, fixed)
    scale = jnp.where(fixed, 0.0, system.velocity_scale())
    u, rank, ok = guess, system.velocity_rank, jnp.array(True)
    jacobian = system.velocity_jacobian(t, q, u)
    for step in range(1 if system.linear else 8):
        jacobian = jacobian if step == 0 else system.velocity_jacobian(t, q, u)
        pivots = full_pivot(jacobian, scale=scale)
        if not fixed.any():
            ok = ok & (pivots.rank == rank)
        rows = pivots.order.rows[:rank]
        # Rows without a pivot have no free column: only the held rates can satisfy them.
        bound = jnp.arange(rank) >= pivots.rank
        selected = jnp.where(bound[:, None], 0.0, jacobian[rows] * scale[None, :])
        gram = selected @ selected.T + jnp.diag(bound.astype(u.dtype))
        u = u - scale * (selected.T @ jnp.linalg.solve(gram, system.velocity_residual(t, q, u)[rows]))
    residual = system.velocity_residual(t, q, u)
    size = 1.0 + jnp.max(jnp.abs(jacobian) @ jnp.abs(u))
    return u, ok & (jnp.max(jnp.abs(residual)) <= 1e2 * tolerance(u.dtype) * size)


def meet_constraints(
    system: AbstractEquation, t: Scalar, start: Float[Array, "nq"], scale: Float[Array, "nq"]
) -> tuple[Float[Array, "nq"], Float[Array, "m nq"]]:
    """Gauss–Newton from a guess to the constraints, along scaled gradients, with step halving; without derivative.

    Implied rows are allowed: the normal equations are regularised at rounding level.

    **Returns:** the configuration, and the Jacobian of its last correction.
    """

    def squares(q):
        return jnp.sum(system.coordinate_residual(t, q) ** 2)

    def correct(at):
        q, _ = at
        residual = system.coordinate_residual(t, q)
        jacobian = system.coordinate_jacobian(t, q)
        scaled = jacobian * scale[None, :]
        gram = scaled @ scaled.T
        shift = 1e-13 * jnp.max(jnp.diag(gram)) + jnp.finfo(q.dtype).tiny
        step = -scale * (scaled.T @ jnp.linalg.solve(gram + shift * jnp.eye(gram.shape[0], dtype=q.dtype), residual))
        # Rotations by more than about a radian leave the region where the linearisation is valid.
        longest = jnp.max(jnp.where(scale > 0, jnp.abs(step) / jnp.where(scale > 0, scale, 1.0), 0.0))
        step = step * jnp.minimum(1.0, 1.0 / jnp.where(longest > 0, longest, 1.0))
        lengths = 0.5 ** jnp.arange(8, dtype=q.dtype)
        sizes = jax.vmap(lambda a: squares(q + a * step))(lengths)
        sizes = jnp.where(jnp.isfinite(sizes), sizes, jnp.inf)
        best = jnp.argmin(sizes)
        # Where the residuals hardly decrease, they cannot vanish: in a batch all members would wait for this one.
        ahead = sizes[best] < _PROGRESS * jnp.sum(residual**2)
        return (q + lengths[best] * step, jacobian), jnp.where(ahead, jnp.max(jnp.abs(step)), 0.0)

    def far(at, size):
        q, _ = at
        return (size > 1e-2 * tolerance(q.dtype) * jnp.max(scale)) & jnp.all(jnp.isfinite(q))

    none = jnp.zeros((system.coordinate_rows, system.nq), start.dtype)
    return newton(correct, far, (start, none), most=_ITERATIONS, dtype=start.dtype)[0]


def residual_size(
    system: AbstractEquation, t: Scalar, q: Float[Array, "nq"], jacobian: Float[Array, "m nq"]
) -> Float[Array, ""]:
    """Largest constraint residual, each row scaled to unit norm of its gradient times the system's size.

    `jacobian`: that of the coordinates at this configuration or near it.
    """
    jacobian = jacobian * system.coordinate_scale()[None, :]
    norms = jnp.sqrt(jnp.sum(jacobian * jacobian, axis=1))
    floor = jnp.finfo(q.dtype).eps ** 0.75 * jnp.max(norms) + jnp.finfo(q.dtype).tiny
    return jnp.max(jnp.abs(system.coordinate_residual(t, q)) / jnp.maximum(norms, floor))


def tolerance(dtype) -> float:
    """The largest scaled residual that counts as zero: 1e-10 in double precision."""
    return float(jnp.finfo(dtype).eps) ** 0.64
