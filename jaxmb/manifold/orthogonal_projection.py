"""Projection of states on the constraints along the shortest way, with exact derivatives.

`ProjectorConstraints` restore a state from one close by, in the metric of the mass matrix. `project` makes the smallest
change in the scales of the coordinates; `project_in_metric` the smallest one in any metric of the velocities, by the
projector of the Jacobian's structure.

Source: E. Hairer, C. Lubich and G. Wanner, "Geometric Numerical Integration", §IV.4 (standard projection method).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._types import Coordinates, Scalar, State
from ..linalg.elimination import full_pivot, solve_positive
from ..linalg.inertia import AbstractInertia, DiagonalInertia
from ..linalg.jacobian import MassProjector
from ..linalg.newton import chord, solve_linear
from ..linalg.pushed import push
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .constraints import AbstractConstraints, RestoredState
from .manifold import normalize_state

_ITERATIONS = 8
# Corrections shrink at least by this multiple of the distance to the state of the factor, in scales of the coordinates.
# (Measured in chains of ball joints: up to 4, of accelerations 13.)
_RATE = 10.0
# The chord method of `project` may converge slowly where a step is long and no error estimate shortens it.
_CHORDS = 32
# Newton's method ends with a correction that is not measured, so the one before may be of this power of eps.
_MEASURED = 0.6
# The last measured correction of velocities that constraints are not linear in, relative to the speed, as a power of
# eps: the error that is left is of the size of its square.
_MEASURED_SPEED = 0.4
# Corrections of velocities near constraints that are not linear in them, and those that follow from farther away.
_FEW, _MORE = 3, 5


def projector_constraints(at: Instant) -> "ProjectorConstraints":
    """The constraints by their projector at an instant."""
    return ProjectorConstraints(at.q, at.structured_jacobian.projector(at.inertia))


class ProjectorConstraints(AbstractConstraints):
    """Constraints that are linear in velocities, by the `projector` at coordinates `q` in the metric of the mass
    matrix.
    """

    q: Coordinates
    projector: MassProjector

    def restore(self, at, near, tol):
        fixed, scale, at = self.projector, at.system.velocity_scale(), at.normalized()
        start = at.q
        distance = jnp.max(jnp.abs(start - self.q) / at.system.coordinate_scale())
        rate = jnp.minimum(_RATE * distance, 0.5)
        one = jnp.ones((), start.dtype)

        def move(q):
            here = at.with_(q=q)
            step = fixed.cancel(here.position_rows)
            return here.moved(step).q, _largest(step, scale)

        q, iterations, failed = chord(move, start, first=one, tol=tol, most=_ITERATIONS, rate=rate)
        at, speed = at.with_(q=q), _nonzero(_largest(at.u, scale))

        def turn(u):
            step = fixed.cancel(at.with_(u=u).velocity_residual)
            return u + step, _largest(step, scale) / speed

        # Velocities and accelerations are known to rounding errors of all that adds up to them. Both equations are
        # linear, so that corrections may be large: those of a body at rest are all that there is.
        rounding, any_size = jnp.finfo(start.dtype).eps ** 0.5, jnp.inf
        u, _, failed_u = chord(
            turn, at.u, first=one, tol=tol, most=_ITERATIONS, rate=rate, rounding=rounding, largest=any_size
        )
        here = at.with_(u=u)
        given, inertia = here.inertia.solve(here.force), here.inertia
        strength = _nonzero(_largest(given, scale) + _largest(near.udot, scale))

        def accelerate(x):
            _, multipliers = x
            free = given + inertia.solve(here.constraint_force(multipliers))
            change = -fixed.multipliers(here.acceleration_residual(free))
            # What the constraints add to free accelerations is the size that shrinks with the distance. Those of a
            # light body between heavy ones are off by much more than its acceleration changes.
            step = fixed.direction(change)
            return (free + step, multipliers + change), _largest(step, scale) / strength

        (udot, multipliers), _, failed_udot = chord(
            accelerate,
            (near.udot, near.multipliers),
            first=one,
            tol=tol,
            most=_ITERATIONS,
            rate=rate,
            rounding=100 * rounding,
            largest=any_size,
        )
        return RestoredState(q, u, udot, multipliers, iterations, failed | failed_u | failed_udot)

    def at(self, instant):
        return projector_constraints(instant)

    def multipliers(self, at, restored):
        if restored.multipliers is not None:
            return restored.multipliers
        return -self.projector.multipliers(at.acceleration_residual(at.inertia.solve(at.force)))

    def push_positions(self, at, along):
        still = jnp.zeros(at.system.nu, at.q.dtype)
        # Constraints hold for normalised coordinates.
        along = along.with_(q=push(lambda at: at.normalized().q, (at,), (along,)))
        step = self.cancel_velocities(push(lambda at: at.position_rows, (at,), (along,)))
        return push(lambda q, step: at.with_(q=q).moved(step).q, (at.q, still), (along.q, step))

    def cancel_velocities(self, residual):
        return self.projector.displacement(-residual)

    def balance(self, at, rows, forces):
        return self.projector.solve(-forces, -rows)

    def cancel_residuals(self, at, multipliers, rows, forces):
        return self.balance(at, rows, forces)[0], None


def _largest(values, scale):
    return jnp.max(jnp.abs(values) / scale)


def _nonzero(size):
    return jnp.where(size > 0, size, 1.0)


def project_normalized(system: AbstractEquation, t: Scalar, y: State) -> State:
    """`project` from coordinates that need not satisfy their own invariants, such as interpolated ones."""
    return project(system, t, normalize_state(system, t, y))


def project(system: AbstractEquation, t: Scalar, y: State) -> State:
    """The state on the constraints that a scaled orthogonal correction reaches; differentiable to every order where the
    Jacobian is one dense matrix. Where Newton's method fails the state and its derivatives are NaN.
    """
    found, failed = projected(system, t, y)
    factor = jnp.where(failed, jnp.nan, 1.0)
    return jax.tree.map(lambda x: x * factor.astype(x.dtype), found)


def projected(system: AbstractEquation, t: Scalar, y: State) -> tuple[State, Bool[Array, ""]]:
    """The state that `project` reaches, and whether Newton's method failed; a state that was not found has no meaning,
    and finite derivatives.
    """
    eps, at = jnp.finfo(y.q.dtype).eps, Instant.of(system, jnp.asarray(t, y.q.dtype), y)
    failed = jnp.array(False)
    if system.elimination is not None:
        metric_of = lambda at: DiagonalInertia(1 / at.system.velocity_scale() ** 2)
        at, _, _, failed = project_in_metric(at, metric_of, None, eps**_MEASURED)
        return at.state, failed | ~_is_finite(at)
    if system.coordinate_rank > 0:
        scale = system.coordinate_scale()
        jacobian = at.coordinate_jacobian
        rows = independent_rows(jacobian, scale, system.coordinate_rank)
        ahead = jacobian[rows] * (scale**2)[None, :]
        gram = ahead @ jacobian[rows].T
        start = at
        moved = lambda multipliers: start.with_(q=start.q - ahead.T @ multipliers)
        residual = lambda multipliers: moved(multipliers).coordinate_residual[rows]
        multipliers, failed = _multipliers(residual, gram, ahead / scale[None, :])
        at = moved(multipliers)
    if system.velocity_rank > 0:
        scale = system.velocity_scale()
        u, failed_u = project_velocities(at, DiagonalInertia(1 / scale**2))
        at, failed = at.with_(u=u), failed | failed_u
    return at.state, failed | ~_is_finite(at)


def project_velocities(at: Instant, metric: AbstractInertia) -> tuple[Float[Array, "nu"], Bool[Array, ""]]:
    """The velocities that satisfy ψ after the smallest change in a metric, and whether Newton's method failed, as it
    can where ψ is not linear in them.
    """
    system = at.system

    def corrected(u, _=None):
        here = at.with_(u=u)
        jacobian = here.binding_velocities.selected(system.velocity_rank, system.velocity_scale())
        change = jacobian.projector(metric).displacement(-here.velocity_rows)
        return u + change, change

    u, change = corrected(at.u)
    if system.linear:
        return u, jnp.array(False)
    scale, small = system.velocity_scale(), jnp.finfo(u.dtype).eps ** _MEASURED_SPEED
    for _ in range(_FEW - 1):
        u, change = corrected(u)

    def is_far(u, change):
        return ~(_largest(change, scale) <= small * _largest(u, scale))

    def go_on(u):
        # Derivatives need all corrections, and a loop whose length is not known keeps none.
        u, changes = lax.scan(corrected, u, length=_MORE)
        return u, is_far(u, changes[-1])

    far = is_far(u, change)
    return lax.cond(far, go_on, lambda u: (u, far), u)


def _is_finite(y: Instant) -> Bool[Array, ""]:
    return jnp.all(jnp.isfinite(y.q)) & jnp.all(jnp.isfinite(y.u))


def independent_rows(jacobian: Array, scale: Array, rank: int) -> Any:
    """Indices of as many independent rows as the rank."""
    return slice(None) if jacobian.shape[0] == rank else full_pivot(jacobian, scale=scale).order.rows[:rank]


def _multipliers(residual, gram: Array, unscaled: Array) -> tuple[Array, Bool[Array, ""]]:
    """The root of the residual, by the chord method from zero multipliers, and whether it failed; then they are zero.

    **Arguments:** `gram`: the derivative of the residual at zero, with the other sign; `unscaled`: the displacement of
    the coordinates that the multipliers make, in scales of the coordinates.
    """
    start = jnp.zeros(gram.shape[0], gram.dtype)
    gram, unscaled = lax.stop_gradient((gram, unscaled))
    eps = jnp.finfo(gram.dtype).eps

    def solve(residual, start):
        def correct(x):
            step = solve_positive(gram, residual(x))  # the residual falls as the multipliers grow
            return x + step, jnp.max(jnp.abs(unscaled.T @ step))

        unknown = jnp.zeros((), start.dtype)
        x, _, failed = chord(correct, start, first=unknown, tol=64 * eps, most=_CHORDS, rounding=eps**0.5)
        # The derivative at a root that was not found would not be finite. The flag is a number, since JAX gives a truth
        # value no tangent of the right type here.
        return jnp.where(failed, start, x), failed.astype(x.dtype)

    x, failed = lax.custom_root(residual, start, solve, solve_linear, has_aux=True)
    return x, lax.stop_gradient(failed) > 0


def project_in_metric(
    at: Instant, metric_of: Callable[[Instant], AbstractInertia], linearized_at: MassProjector | None, tol: Scalar
) -> tuple[Instant, MassProjector, Int[Array, ""], Bool[Array, ""]]:
    """Project a state on constraints that are linear in velocities, by the smallest displacement in a metric.

    Derivatives are exact for a state on the constraints, and off them wrong by the size of the displacement.

    **Arguments:** `metric_of(at)`: the metric at an instant; `linearized_at`: the projector at a state close by, whose
    derivatives do not count, for a chord method; None for Newton's method; `tol`: size of the last correction, relative
    to the system's size.

    **Returns:** the instant, the projector there, the number of iterations, and whether they failed.
    """
    before, fixed, tol = lax.stop_gradient((at, linearized_at, tol))
    scale = before.system.velocity_scale()

    def projector_at(q):
        here = before.with_(q=q)
        return here.binding_velocities.projector(metric_of(here))

    def correction(projector, q):
        step = projector.cancel(before.with_(q=q).position_rows)
        return step, jnp.max(jnp.abs(step) / scale)

    moved = lambda q, step: before.with_(q=q).moved(step).q
    if fixed is None:
        found, own, iterations, failed = _by_newton(projector_at, correction, moved, before, tol)
    else:

        def correct(q):
            step, size = correction(fixed, q)
            return moved(q, step), size

        first = jnp.ones((), at.q.dtype)
        found, iterations, failed = chord(correct, before.q, first=first, tol=tol, most=_ITERATIONS)
        own = projector_at(found)
    # The solution depends on the state that it was found from as one Newton correction at it does, with constant
    # matrices. What coordinates are normalised by has no part in it: constraints hold for normalised ones.
    start = at.system.normalize(at.q)
    at = at.with_(q=found + (start - lax.stop_gradient(start)))
    at = at.moved(own.displacement(-at.position_rows))
    here = at.binding_velocities.projector(metric_of(at), own.factor)
    return at.with_(u=at.u + here.displacement(-at.velocity_rows)), here, iterations, failed


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
    failed = ~(left <= tol)
    # Derivatives at a root that was not found would not be finite.
    q = jnp.where(failed, start.q, q)
    projector = jax.tree.map(lambda x: jnp.where(failed, jnp.ones((), x.dtype), x), projector)
    return q, projector, k, failed
