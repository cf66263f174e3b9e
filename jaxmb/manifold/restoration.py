"""Return to the constraints and accelerations there, by the factor of a state close by.

A step of a multistep method evaluates at a prediction, and then at a corrected state beside it. Only the first of them
needs an elimination: with the factor of the prediction, Newton's method (with one matrix, the chord method) restores
positions and velocities, and corrects the accelerations and multipliers of the prediction. Each correction leaves an
error of the size of the distance between the two states, so at tolerances of 1e-6 and below the first one of each
suffices.

Derivatives follow from the equations at the state that is found, with a factor of that state, by the implicit function
theorem.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._types import Scalar, State
from ..linalg.jacobian import MassProjector
from ..linalg.newton import chord
from ..system import AbstractEquation
from ..system.residuals import displaced, position_rows

_ITERATIONS = 8
# Corrections shrink at least by this multiple of the distance to the state of the factor, in scales of the coordinates.
# (Measured in chains of ball joints: up to 4, of accelerations 13.)
_RATE = 10.0


class SolvedState(eqx.Module):
    """A state whose equations of motion are solved; constants.

    **Fields:** the coordinates `q`, the `projector` there in the metric of the mass matrix, the accelerations `udot`,
    and the `multipliers`.
    """

    q: Float[Array, "nq"]
    projector: MassProjector
    udot: Float[Array, "nu"]
    multipliers: Float[Array, "m"]


class RestoredState(eqx.Module):
    """A state on the constraints with its accelerations and multipliers.

    **Fields:** `q`, `u`, `udot`, `multipliers`; the number of `iterations` for positions and whether any iteration
    `failed`, None in tangents.
    """

    q: Float[Array, "nq"]
    u: Float[Array, "nu"]
    udot: Float[Array, "nu"]
    multipliers: Float[Array, "m"] | None
    iterations: Int[Array, ""] | None
    failed: Bool[Array, ""] | None


# Wrapped in a compiled function, so that it is traced once for all its places.
@eqx.filter_jit
def restore_near(system: AbstractEquation, t: Scalar, y: State, solved: SolvedState, tol: Scalar) -> RestoredState:
    """Project a state on constraints that are ideal and linear in velocities, and find the accelerations there.

    Derivatives are exact for a state on the constraints, and off them wrong by the size of the displacement.

    **Arguments:** `y`: a state near the constraints; `solved`: a state close by at the same time; `tol`: size of the
    corrections that are left out, relative to the system's size, its speed and its accelerations.
    """
    return _restore_near(system, t, y, solved, tol)


@eqx.filter_custom_jvp
def _restore_near(system, t, y, solved, tol):
    fixed, scale = solved.projector, system.velocity_scale()
    start = system.normalize(y.q)
    distance = jnp.max(jnp.abs(start - solved.q) / system.coordinate_scale())
    rate = jnp.minimum(_RATE * distance, 0.5)
    one = jnp.ones((), start.dtype)

    def move(q):
        step = fixed.cancel(position_rows(system, t, q))
        return displaced(system, t, q, step), _largest(step, scale)

    q, iterations, failed = chord(move, start, first=one, tol=tol, most=_ITERATIONS, rate=rate)
    speed = _nonzero(_largest(y.u, scale))

    def turn(u):
        step = fixed.cancel(system.velocity_residual(t, q, u))
        return u + step, _largest(step, scale) / speed

    # Velocities and accelerations are known to rounding errors of all that adds up to them.
    rounding = jnp.finfo(start.dtype).eps ** 0.5
    u, _, failed_u = chord(turn, y.u, first=one, tol=tol, most=_ITERATIONS, rate=rate, rounding=rounding)
    inertia, force = system.inertia(t, q, u), system.force(t, q, u)
    given = inertia.solve(force)
    strength = _nonzero(_largest(given, scale) + _largest(solved.udot, scale))

    def accelerate(x):
        _, multipliers = x
        free = given + inertia.solve(system.constraint_force(t, q, u, multipliers))
        change = -fixed.multipliers(system.acceleration_residual(t, q, u, free))
        # What the constraints add to free accelerations is the size that shrinks with the distance. Those of a light
        # body between heavy ones are off by much more than its acceleration changes.
        step = fixed.direction(change)
        return (free + step, multipliers + change), _largest(step, scale) / strength

    first = solved.udot, solved.multipliers
    (udot, multipliers), _, failed_udot = chord(
        accelerate,
        first,
        first=one,
        tol=tol,
        most=_ITERATIONS,
        rate=rate,
        rounding=100 * rounding,
        largest=jnp.inf,
    )
    return RestoredState(q, u, udot, multipliers, iterations, failed | failed_u | failed_udot)


@_restore_near.def_jvp
def _restore_near_jvp(primals, tangents):
    system, t, y, solved, tol = primals
    dsystem, dt, dy, _, _ = tangents
    out = restore_near(system, t, y, solved, tol)
    dq, du = (jnp.zeros_like(own) if tangent is None else tangent for own, tangent in ((y.q, dy.q), (y.u, dy.u)))
    q, u, udot, multipliers = out.q, out.u, out.udot, out.multipliers
    inertia = system.inertia(t, q, u)
    projector = system.structured_jacobian(t, q, u).projector(inertia)

    rows = _push(position_rows, (system, t, q), (dsystem, dt, dq))
    step, _ = projector.solve(jnp.zeros_like(u), -rows)
    dq = _push(lambda q, step: displaced(system, t, q, step), (q, jnp.zeros_like(u)), (dq, step))
    rows = _push(lambda s, t, q, u: s.velocity_residual(t, q, u), (system, t, q, u), (dsystem, dt, dq, du))
    du = du + projector.solve(jnp.zeros_like(u), -rows)[0]

    def equations(system, t, q, u):
        applied = system.force(t, q, u) + system.constraint_force(t, q, u, multipliers)
        return system.acceleration_residual(t, q, u, udot), system.inertia(t, q, u).product(udot) - applied

    rows, forces = _push(equations, (system, t, q, u), (dsystem, dt, dq, du))
    dudot, _ = projector.solve(-forces, -rows)
    return out, RestoredState(dq, du, dudot, None, None, None)


def _largest(values, scale):
    return jnp.max(jnp.abs(values) / scale)


def _nonzero(size):
    return jnp.where(size > 0, size, 1.0)


def _push(fn: Any, primals: Any, tangents: Any) -> Any:
    return eqx.filter_jvp(fn, primals, tangents)[1]
