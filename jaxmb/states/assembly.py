"""Consistent initial states: the nearest configuration and velocities that satisfy every constraint.

The configuration minimises `½ Σ ((q − q_guess)/scale)²` subject to `Φ(t, q) = 0` and to the coordinates fixed by
name; then the velocities minimise `½ Σ ((u − u_guess)/scale)²` subject to `ψ(t, q, u) = 0` and to the rates fixed by
name. Derivatives are those of the minimisers, by the implicit function theorem.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Scalar, State, VectorLike
from ..linalg.arrays import as_array, is_traced
from ..linalg.elimination import full_pivot
from ..system import AbstractSystem
from ..system.chain import VERY_LONG, is_long
from ..system.coordinates import prescribe
from . import chain_assembly as _chain_assembly

_ITERATIONS = 100

# Smallest pivot of block elimination, the square of a distance between rows of unit norm, that counts as independent.
INDEPENDENT = 1e-5

# Newton on the optimality conditions, which start near their solution: size of its last step, and how many at most.
_REFINED = 1e-10
_REFINEMENTS = 16


def assemble(
    system: AbstractSystem,
    guess: State | None = None,
    *,
    fix: Mapping[str, VectorLike] | None = None,
    rates: Mapping[str, VectorLike] | None = None,
    t: Scalar = 0.0,
    throw: bool = True,
) -> State:
    """Find a consistent state near a guess.

    **Arguments:**

    - `system`: a compiled scene, or another system.
    - `guess`: where to start, default the poses and velocities given with the bodies.
    - `fix`: coordinates that must have these values, by name: `{"crank.angle": 0.3}`.
    - `rates`: rates that must have these values, by name: `{"crank.angle": 2.0}`; in space `"body.angular_velocity"`
        (body frame) and `"body.velocity"`; of a `LagrangianSystem` names of coordinates, or `u0`, `u1`, ….
    - `t`: the time, for driven mechanisms [s].
    - `throw`: whether a mechanism that cannot be assembled is an error. With `False` the state is NaN instead, so
        that one member of a batch does not spoil the others.

    **Returns:** a `State`, differentiable with respect to the parameters, the guess and the prescribed values.

    **Raises:** `ValueError` naming the joints with their residuals if the mechanism cannot be assembled, or the
    coordinates that cannot be fixed together. Under `jit` the same as a run-time error without the names.
    """
    guess = system.guess if guess is None else guess
    t = as_array(t, guess.q.dtype)
    u, fixed_rates = prescribe("rate", system.rate_names(), rates or {}, guess.u)
    if not is_traced(u):
        _check_finite(u, "rates")
    q, _, ok = configuration(system, guess.q, fix, t, throw)
    # At rest, where nothing asks for motion, there is nothing to compile.
    known = not is_traced((system, guess, fix, u, t))
    at_rest = known and system.drift_free and not np.any(np.asarray(u)) and not np.any(fixed_rates)
    u, ok_rates = (u, True) if at_rest else velocities(system, t, q, u, tuple(fixed_rates.tolist()))
    # Under a trace what comes of known numbers is traced as well.
    if throw and not is_traced((ok, ok_rates)):
        if not ok_rates:
            raise ValueError(_cannot_move(system, t, q, u, fixed_rates, system.rate_names()))
        return State(q, u)
    ok = ok & ok_rates
    if throw:
        q = eqx.error_if(
            q, ~ok, "The mechanism cannot be assembled; call assemble outside jit to see which joints are open."
        )
    state = State(q, u)
    return state if throw else jax.tree.map(lambda x: jnp.where(ok, x, jnp.nan), state)


def configuration(
    system: AbstractSystem, guess: Float[Array, "nq"], fix: Mapping[str, VectorLike] | None, t: Scalar, throw: bool
) -> tuple[Float[Array, "nq"], Bool[np.ndarray, "nq"], Bool[Array, ""]]:
    """The first half of `assemble`: the coordinates, a mask of those that were prescribed, and whether the constraints
    hold; an error if not, with `throw` and outside `jit`.
    """
    names = system.coordinate_names()
    q, fixed = prescribe("coordinate", names, fix or {}, guess)
    if not is_traced(q):
        _check_finite(q, "coordinates")
    q, whole = system.normalize_fixed(q, fixed)
    q, ok = positions(system, t, q, tuple(fixed.tolist()), system.coordinate_rank - whole)
    if throw and not is_traced(ok) and not ok:
        raise ValueError(_cannot_assemble(system, t, q, fixed, names))
    return q, fixed, ok


@eqx.filter_jit
def positions(
    system: AbstractSystem, t: Scalar, guess: Float[Array, "nq"], held: tuple[bool, ...], rank: int
) -> tuple[Float[Array, "nq"], Bool[Array, ""]]:
    """The configuration nearest to the guess with some coordinates held; and whether every residual is at rounding
    level.

    `rank`: of the rows in the columns that are not held.
    """
    if system.coordinate_rows == 0:
        return guess, jnp.array(True)
    fixed = np.array(held)
    if is_long(system, VERY_LONG):
        q, ok, pivot = _chain_assembly.positions(system, t, guess, fixed, tolerance(guess.dtype))
        return q, ok & (pivot > INDEPENDENT)
    scale = jnp.where(fixed, 0.0, system.coordinate_scale())
    start = lax.stop_gradient(guess)
    frozen = lax.stop_gradient(system)
    q, jacobian = lax.stop_gradient(nearest(frozen, lax.stop_gradient(t), start, scale))
    ok = residual_size(frozen, t, q, jacobian) <= tolerance(q.dtype)

    # The minimiser, exactly: Newton on the optimality conditions with the independent rows.
    pivots = full_pivot(jacobian, scale=scale)
    ok = ok & (pivots.rank == rank)
    rows = pivots.order.rows[:rank]
    square = jnp.where(fixed, 1.0, scale) ** 2

    # Where there is none, the equations are replaced by ones with a solution, so that their derivatives stay finite.
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
    refined = lax.custom_root(optimality, nearby, _newton, tangent_solve)[: system.nq]
    ok = ok & jnp.all(jnp.isfinite(refined)) & (residual_size(frozen, t, refined, jacobian) <= tolerance(q.dtype))
    return jnp.where(ok, refined, q), ok


def _newton(residual, x):
    def correct(carry):
        x, _, k = carry
        value, push = jax.linearize(residual, x)
        step = tangent_solve(push, value)
        return x - step, jnp.max(jnp.abs(step) / (1.0 + jnp.abs(x))), k + 1

    def proceed(carry):
        _, size, k = carry
        return (size > _REFINED) & (k < _REFINEMENTS)

    return lax.while_loop(proceed, correct, (x, jnp.array(jnp.inf, x.dtype), jnp.array(0)))[0]


def tangent_solve(linear, b):
    return jnp.linalg.solve(jax.vmap(linear, out_axes=1)(jnp.eye(b.size, dtype=b.dtype)), b)


@eqx.filter_jit
def velocities(
    system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], guess: Float[Array, "nu"], held: tuple[bool, ...]
) -> tuple[Float[Array, "nu"], Bool[Array, ""]]:
    """The velocities nearest to the guess with some rates held; and whether every residual is at rounding level."""
    if system.velocity_rows == 0:
        return guess, jnp.array(True)
    if is_long(system, VERY_LONG):
        u, pivot = _chain_assembly.velocities(system, t, q, guess, np.array(held))
        return u, jnp.all(jnp.isfinite(u)) & (pivot > INDEPENDENT)
    scale = jnp.where(np.array(held), 0.0, system.velocity_scale())
    u, rank, ok = guess, system.velocity_rank, jnp.array(True)
    jacobian = system.velocity_jacobian(t, q, u)
    for step in range(1 if system.linear else 8):
        jacobian = jacobian if step == 0 else system.velocity_jacobian(t, q, u)
        pivots = full_pivot(jacobian, scale=scale)
        ok = ok & (pivots.rank == rank)
        rows = pivots.order.rows[:rank]
        selected = jacobian[rows] * scale[None, :]
        # A fixed rate that leaves too few free columns makes this singular; `ok` says so.
        gram = selected @ selected.T + jnp.where(ok, 0.0, 1.0) * jnp.eye(rank, dtype=u.dtype)
        u = u - scale * (selected.T @ jnp.linalg.solve(gram, system.velocity_residual(t, q, u)[rows]))
    residual = system.velocity_residual(t, q, u)
    size = 1.0 + jnp.max(jnp.abs(jacobian) @ jnp.abs(u))
    return u, ok & (jnp.max(jnp.abs(residual)) <= 1e2 * tolerance(u.dtype) * size)


def nearest(
    system: AbstractSystem, t: Scalar, start: Float[Array, "nq"], scale: Float[Array, "nq"]
) -> tuple[Float[Array, "nq"], Float[Array, "m nq"]]:
    """Gauss–Newton from a guess to the constraints, along scaled gradients, with step halving; without derivative.

    Implied rows are allowed: the normal equations are regularised at rounding level.

    **Returns:** the configuration, and the Jacobian that its last correction was made with.
    """

    def size(q):
        return jnp.sum(system.coordinate_residual(t, q) ** 2)

    def body(carry):
        q, _, _, k = carry
        residual = system.coordinate_residual(t, q)
        jacobian = system.coordinate_jacobian(t, q)
        scaled = jacobian * scale[None, :]
        gram = scaled @ scaled.T
        shift = 1e-13 * jnp.max(jnp.diag(gram)) + jnp.finfo(q.dtype).tiny
        step = -scale * (scaled.T @ jnp.linalg.solve(gram + shift * jnp.eye(gram.shape[0], dtype=q.dtype), residual))
        # Rotations by more than about a radian leave the region where the linearisation means anything.
        longest = jnp.max(jnp.where(scale > 0, jnp.abs(step) / jnp.where(scale > 0, scale, 1.0), 0.0))
        step = step * jnp.minimum(1.0, 1.0 / jnp.where(longest > 0, longest, 1.0))
        lengths = 0.5 ** jnp.arange(8, dtype=q.dtype)
        sizes = jax.vmap(lambda a: size(q + a * step))(lengths)
        q = q + lengths[jnp.argmin(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))] * step
        return q, jacobian, jnp.max(jnp.abs(step)), k + 1

    def proceed(carry):
        q, _, step, k = carry
        return (k < _ITERATIONS) & (step > 1e-2 * tolerance(q.dtype) * jnp.max(scale)) & jnp.all(jnp.isfinite(q))

    none = jnp.zeros((system.coordinate_rows, system.nq), start.dtype)
    q, jacobian, _, _ = lax.while_loop(proceed, body, (start, none, jnp.array(jnp.inf, start.dtype), 0))
    return q, jacobian


def residual_size(
    system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], jacobian: Float[Array, "m nq"]
) -> Float[Array, ""]:
    """Largest constraint residual, each row scaled to unit norm of its gradient times the system's size.

    `jacobian`: that of the coordinates there or nearby.
    """
    jacobian = jacobian * system.coordinate_scale()[None, :]
    norms = jnp.sqrt(jnp.sum(jacobian * jacobian, axis=1))
    floor = jnp.finfo(q.dtype).eps ** 0.75 * jnp.max(norms) + jnp.finfo(q.dtype).tiny
    return jnp.max(jnp.abs(system.coordinate_residual(t, q)) / jnp.maximum(norms, floor))


def tolerance(dtype) -> float:
    """What counts as zero for a scaled residual: 1e-10 in double precision."""
    return float(jnp.finfo(dtype).eps) ** 0.64


def _check_finite(vector, what):
    if not np.all(np.isfinite(vector)):
        raise ValueError(f"The guess or the fixed {what} are not finite: {np.asarray(vector)}.")


def open_joints(system: AbstractSystem, t: Scalar, q: Float[Array, "nq"]) -> str:
    """The joints that a configuration leaves open, largest residual first, for messages."""
    residual = np.abs(np.asarray(system.position_residual(t, q)))
    worst: dict[str, float] = {}
    for (name, _), value in zip(system.rows, residual, strict=False):
        worst[name] = max(worst.get(name, 0.0), float(value))
    listed = sorted(worst.items(), key=lambda item: -item[1])
    return ", ".join(f"{name} ({value:.3g})" for name, value in listed[:8] if value > 1e-9)


def _cannot_assemble(system, t, q, fixed, names):
    text = "The mechanism cannot be assembled"
    held = [name for name, index in names.items() if len(index) == 1 and fixed[index[0]]]
    if held:
        text += f" with {', '.join(held)} fixed"
    listed = open_joints(system, t, q)
    if listed:
        return (
            f"{text}: residuals remain in {listed}. Check lengths and points, or give a better guess of the positions."
        )
    return f"{text}: these coordinates are not independent of each other. Fix fewer of them, or others."


def _cannot_move(system, t, q, u, fixed, names):
    held = [name for name, index in names.items() if len(index) == 1 and fixed[index[0]]]
    residual = np.abs(np.asarray(system.velocity_residual(t, q, u)))
    own = system.rows[: system.velocity_rows]
    rows = sorted({name for (name, _), r in zip(own, residual, strict=True) if r > 1e-9 or not np.isfinite(r)})
    return (
        f"No velocities satisfy the constraints with the rates {', '.join(held) or '(none)'} fixed: "
        f"{', '.join(rows) or 'the rates are not independent of each other'}. Fix fewer rates, or others."
    )
