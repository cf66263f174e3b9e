"""Projection of states on the constraints, with exact derivatives.

`project` makes the smallest change in the scales of the coordinates; `project_in_metric` the smallest one in any metric
of the velocities, by the projector of the Jacobian's structure.

Source: E. Hairer, C. Lubich and G. Wanner, "Geometric Numerical Integration", §IV.4 (standard projection method).
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from .._types import Scalar, State
from ..linalg.elimination import full_pivot, solve_positive
from ..linalg.inertia import AbstractInertia, DiagonalInertia
from ..linalg.jacobian import MassProjector
from ..linalg.newton import chord, newton, root
from ..system import AbstractSystem
from ..system.displacement import displaced
from ..system.padded_rows import binding_velocities, position_rows, velocity_rows
from .manifold import normalize_state

_ITERATIONS = 8


def project_normalized(system: AbstractSystem, t: Scalar, y: State) -> State:
    """`project` from coordinates that need not satisfy their own invariants, such as interpolated ones."""
    return project(system, t, normalize_state(system, t, y))


def project(system: AbstractSystem, t: Scalar, y: State) -> State:
    """The state on the constraints that a scaled orthogonal correction reaches; differentiable to every order where the
    Jacobian is one dense matrix.
    """
    if system.elimination is not None:
        t, tol = jnp.asarray(t, y.q.dtype), 64 * jnp.finfo(y.q.dtype).eps
        metric_of = lambda system, t, y: DiagonalInertia(1 / system.velocity_scale() ** 2)
        return project_in_metric(system, t, y, metric_of, None, tol)[0]
    q = y.q
    if system.coordinate_rank > 0:
        t = jnp.asarray(t, q.dtype)
        square = system.coordinate_scale() ** 2
        jacobian = system.coordinate_jacobian(t, q)
        rows = independent_rows(jacobian, system.coordinate_scale(), system.coordinate_rank)
        ahead = jacobian[rows] * square[None, :]
        gram = ahead @ jacobian[rows].T
        moved = lambda multipliers: q - ahead.T @ multipliers
        residual = lambda multipliers: system.coordinate_residual(t, moved(multipliers))[rows]
        q = moved(_multipliers(residual, gram))
    u = y.u
    if system.velocity_rank > 0:
        square = system.velocity_scale() ** 2
        for _ in range(1 if system.linear else 3):
            jacobian = system.velocity_jacobian(t, q, u)
            rows = independent_rows(jacobian, system.velocity_scale(), system.velocity_rank)
            ahead = jacobian[rows] * square[None, :]
            u = u - ahead.T @ solve_positive(ahead @ jacobian[rows].T, system.velocity_residual(t, q, u)[rows])
    return dataclasses.replace(y, q=q, u=u)


def independent_rows(jacobian: Array, scale: Array, rank: int) -> Any:
    """Indices of as many independent rows as the rank."""
    return slice(None) if jacobian.shape[0] == rank else full_pivot(jacobian, scale=scale).order.rows[:rank]


def _multipliers(residual, gram: Array) -> Array:
    """The root of the residual, by the chord method from zero multipliers."""
    start = jnp.zeros(gram.shape[0], gram.dtype)
    gram = lax.stop_gradient(gram)

    def solve(residual, start):
        def correct(x):
            step = solve_positive(gram, residual(x))  # the residual falls as the multipliers grow
            return x + step, jnp.max(jnp.abs(step))

        far = lambda x, size: size > 64 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x), initial=1e-8)
        return newton(correct, far, start, most=_ITERATIONS, dtype=start.dtype)[0]

    return root(residual, start, solve)


def project_in_metric(
    system: AbstractSystem,
    t: Scalar,
    y: State,
    metric_of: Callable[[AbstractSystem, Scalar, State], AbstractInertia],
    linearized_at: MassProjector | None,
    tol: Scalar,
) -> tuple[State, MassProjector, Int[Array, ""], Bool[Array, ""]]:
    """Project a state on constraints that are linear in velocities, by the smallest displacement in a metric.

    Derivatives are exact for a state on the constraints, and off them wrong by the size of the displacement.

    **Arguments:** `metric_of(system, t, y)`: the metric at a state; `linearized_at`: the projector at a state close by,
    whose derivatives do not count, for a chord method; None for Newton's method; `tol`: size of the last correction,
    relative to the system's size.

    **Returns:** the state, the projector there, the number of iterations, and whether they failed.
    """
    fixed_system, fixed_t, before, fixed, tol = lax.stop_gradient((system, t, y, linearized_at, tol))
    scale = fixed_system.velocity_scale()

    def projector_at(q):
        metric = metric_of(fixed_system, fixed_t, State(q, before.u))
        return binding_velocities(fixed_system, fixed_t, q, before.u).projector(metric)

    def correction(projector, q):
        step = projector.cancel(position_rows(fixed_system, fixed_t, q))
        return step, jnp.max(jnp.abs(step) / scale)

    moved = lambda q, step: displaced(fixed_system, fixed_t, q, step)
    if fixed is None:
        found, own, iterations, failed = _by_newton(projector_at, correction, moved, before, tol)
    else:

        def correct(q):
            step, size = correction(fixed, q)
            return moved(q, step), size

        first = jnp.ones((), y.q.dtype)
        found, iterations, failed = chord(correct, before.q, first=first, tol=tol, most=_ITERATIONS)
        own = projector_at(found)
    # The solution depends on the state that it was found from as one Newton correction at it does, with constant
    # matrices.
    q = y.q + (found - before.q)
    none = jnp.zeros_like(y.u)
    q = displaced(system, t, q, own.solve(none, -position_rows(system, t, q))[0])
    here = binding_velocities(system, t, q, y.u).projector(metric_of(system, t, State(q, y.u)), own.factor)
    u = y.u + here.solve(none, -velocity_rows(system, t, q, y.u))[0]
    return dataclasses.replace(y, q=q, u=u), here, iterations, failed


def _by_newton(projector_at, correction, moved, start, tol):
    """Coordinates whose Newton correction is below `tol`, with the projector there, the number of iterations, and
    whether they failed. The loop starts with no correction, so that its program holds one elimination only.
    """

    def advance(carry):
        q, step, _, before, _, k = carry
        q = moved(q, step)
        projector = projector_at(q)
        step, size = correction(projector, q)
        rounded = (size < 4096 * jnp.finfo(size.dtype).eps) & (size > 0.5 * before)
        return q, step, projector, size, jnp.where(rounded, 0.0, size), k + 1

    def proceed(carry):
        _, _, _, size, left, k = carry
        return (k == 0) | ((left > tol) & (size < 1.0) & (k < _ITERATIONS))

    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(projector_at, start.q))
    far = jnp.full((), jnp.inf, start.q.dtype)
    q, _, projector, _, left, k = lax.while_loop(
        proceed, advance, (start.q, jnp.zeros_like(start.u), empty, far, far, jnp.array(0))
    )
    return q, projector, k, ~(left <= tol)
