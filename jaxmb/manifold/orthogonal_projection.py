"""Projection of states on the constraints along the shortest way, with exact derivatives.

`ProjectorConstraints` restore a state from a nearby one, in the metric of the mass matrix. `project` makes the smallest
change in the scales of the coordinates. `project_in_metric` makes the smallest change in any metric of the velocities,
by the projector of the Jacobian's structure.

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
# The chord method of `project` may converge slowly after a long step that no error estimate shortens.
_CHORDS = 32
# Newton's method ends with an unmeasured correction, so the previous correction may be of this power of eps.
_MEASURED = 0.6
# The last measured correction of velocities for nonlinear constraints, relative to the speed, as a power of eps: the
# remaining error is of the size of its square.
_MEASURED_SPEED = 0.4
# For constraints that are not linear in velocities: the number of corrections of velocities, and of further corrections
# from far away.
_FEW, _MORE = 3, 5


def projector_constraints(at: Instant) -> "ProjectorConstraints":
    """The constraints by their projector at an instant."""
    return ProjectorConstraints(at.q, at.structured_jacobian.projector(at.inertia))


class ProjectorConstraints(AbstractConstraints):
    """Constraints linear in velocities, by the `projector` at coordinates `q` in the metric of the mass matrix."""

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

        # Velocities and accelerations are exact to the rounding errors of their summands. Both equations are linear, so
        # corrections may be as large as the values: for a body at rest they are all that remains.
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
            # This step, the part that constraints add to free accelerations, shrinks with the distance. For a light
            # body between heavy ones its error is much larger than the change of the body's acceleration.
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
    """`project` from coordinates that need not be normalised, such as interpolated ones."""
    return project(system, t, normalize_state(system, t, y))


def project(system: AbstractEquation, t: Scalar, y: State) -> State:
    """The state on the constraints after a scaled orthogonal correction; differentiable to every order if the Jacobian
    is one dense matrix. The state and its derivatives are NaN if Newton's method fails.
    """
    projected_state, failed = projected(system, t, y)
    factor = jnp.where(failed, jnp.nan, 1.0)
    return jax.tree.map(lambda x: x * factor.astype(x.dtype), projected_state)


def projected(system: AbstractEquation, t: Scalar, y: State) -> tuple[State, Bool[Array, ""]]:
    """The state of `project`, meaningless but finite after a failure, and whether Newton's method failed."""
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
    """The velocities that satisfy ψ after the smallest change in a metric, and whether Newton's method failed. It can
    fail only if ψ is not linear in velocities.
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
        # Derivatives need all corrections, and a loop of unknown length keeps none.
        u, changes = lax.scan(corrected, u, length=_MORE)
        return u, is_far(u, changes[-1])

    far = is_far(u, change)
    return lax.cond(far, go_on, lambda u: (u, far), u)


def _is_finite(y: Instant) -> Bool[Array, ""]:
    return jnp.all(jnp.isfinite(y.q)) & jnp.all(jnp.isfinite(y.u))


def independent_rows(jacobian: Array, scale: Array, rank: int) -> Any:
    """Indices of independent rows, as many as the rank."""
    return slice(None) if jacobian.shape[0] == rank else full_pivot(jacobian, scale=scale).order.rows[:rank]


def _multipliers(residual, gram: Array, unscaled: Array) -> tuple[Array, Bool[Array, ""]]:
    """The root of the residual, by the chord method from zero multipliers, and whether it failed; then they are zero.

    **Arguments:** `gram`: minus the derivative of the residual at zero; `unscaled`: the displacement of the coordinates
    by the multipliers, in scales of the coordinates.
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
        # After a failure the derivative would not be finite. The flag is a number, since JAX gives a truth value no
        # tangent of the right type here.
        return jnp.where(failed, start, x), failed.astype(x.dtype)

    x, failed = lax.custom_root(residual, start, solve, solve_linear, has_aux=True)
    return x, lax.stop_gradient(failed) > 0


def project_in_metric(
    at: Instant, metric_of: Callable[[Instant], AbstractInertia], linearized_at: MassProjector | None, tol: Scalar
) -> tuple[Instant, MassProjector, Int[Array, ""], Bool[Array, ""]]:
    """Project a state on constraints that are linear in velocities, by the smallest displacement in a metric.

    Derivatives are exact for a state on the constraints, and otherwise wrong by the size of the displacement.

    **Arguments:** `metric_of(at)`: the metric at an instant; `linearized_at`: the projector at a nearby state, whose
    derivatives are ignored, for a chord method, or None for Newton's method; `tol`: the size of the last correction,
    relative to the system's size.

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
        projected_q, projector_there, iterations, failed = _by_newton(projector_at, correction, moved, before, tol)
    else:

        def correct(q):
            step, size = correction(fixed, q)
            return moved(q, step), size

        first = jnp.ones((), at.q.dtype)
        projected_q, iterations, failed = chord(correct, before.q, first=first, tol=tol, most=_ITERATIONS)
        projector_there = projector_at(projected_q)
    # The solution depends on the initial state like one Newton correction at the solution, with constant matrices. The
    # norm of unnormalised coordinates does not enter: constraints hold for normalised ones.
    start = at.system.normalize(at.t, at.q)
    at = at.with_(q=projected_q + (start - lax.stop_gradient(start)))
    at = at.moved(projector_there.displacement(-at.position_rows))
    here = at.binding_velocities.projector(metric_of(at), projector_there.factor)
    return at.with_(u=at.u + here.displacement(-at.velocity_rows)), here, iterations, failed


def _by_newton(projector_at, correction, moved, start, tol):
    """Coordinates whose Newton correction is below `tol`, with the projector there, the number of iterations, and
    whether they failed. The loop starts with an empty correction, so that its program contains a single elimination.
    """

    def advance(carry):
        q, step, _, before, _, k = carry
        q = moved(q, step)
        projector = projector_at(q)
        step, size = correction(projector, q)
        rounded = (size < 4096 * jnp.finfo(size.dtype).eps) & (size > 0.5 * before)
        return q, step, projector, size, jnp.where(rounded, 0.0, size), k + 1

    def proceed(carry):
        _, _, _, size, ahead, k = carry
        return (k == 0) | ((ahead > tol) & (size < 1.0) & (k < _ITERATIONS))

    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(projector_at, start.q))
    far = jnp.full((), jnp.inf, start.q.dtype)
    q, _, projector, _, ahead, k = lax.while_loop(
        proceed, advance, (start.q, jnp.zeros_like(start.u), empty, far, far, jnp.array(0))
    )
    failed = ~(ahead <= tol)
    # After a failure derivatives would not be finite.
    q = jnp.where(failed, start.q, q)
    projector = jax.tree.map(lambda x: jnp.where(failed, jnp.ones((), x.dtype), x), projector)
    return q, projector, k, failed
