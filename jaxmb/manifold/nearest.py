"""The way back to the constraints for chains of joints, joint by joint, with exact derivatives."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from .._types import Scalar, State
from ..system import AbstractInertia, AbstractSystem
from ..system.corrector import Corrector, corrector

_ITERATIONS = 8


def nearest(
    system: AbstractSystem, t: Scalar, y: State, metric: AbstractInertia, near: Corrector, tol: Scalar
) -> tuple[State, Corrector, Int[Array, ""], Bool[Array, ""]]:
    """The state on the constraints that the smallest displacement in the metric reaches; and the corrector there, the
    Newton iterations, and whether they failed.

    Derivatives are exact for a state on the constraints, and off them wrong by as much as it is displaced.

    `near`: a corrector at a state close by, of which only the value counts.
    """
    frozen_system, frozen_t, before, frozen_near, tol = lax.stop_gradient((system, t, y, near, tol))
    found, iterations, failed = _newton(frozen_system, frozen_t, before.q, frozen_near, tol)
    # The solution depends on where it was found from as one Newton correction at it does, whose matrices are constant.
    own = corrector(frozen_system, frozen_t, State(found, before.u), frozen_near.metric)
    q = y.q + (found - before.q)
    q = _moved(system, t, q, own.remove(_position_rows(system, t, q)))
    here = corrector(system, t, State(q, y.u), metric, own.factor)
    u = y.u + here.remove(system.velocity_residual(t, q, y.u))
    return State(q, u), here, iterations, failed


def _newton(system, t, q, near, tol):
    """Solve `Φ = 0` with a fixed factor: `(q, iterations, failed)`."""
    scale = system.velocity_scale()

    def correct(carry):
        q, before, _, k = carry
        step = near.remove(_position_rows(system, t, q))
        size = jnp.max(jnp.abs(step) / scale)
        # Corrections shrink by a constant factor, so the next one is known.
        rate = jnp.where(size < before, size / before, 1.0)
        rounded = (size < 4096 * jnp.finfo(q.dtype).eps) & (rate > 0.5)
        return _moved(system, t, q, step), size, jnp.where(rounded, 0.0, size * rate), k + 1

    def proceed(carry):
        _, size, ahead, k = carry
        return (ahead > tol) & (size < 1.0) & (k < _ITERATIONS)

    one = jnp.ones((), q.dtype)
    q, _, ahead, k = lax.while_loop(proceed, correct, correct((q, one, one, jnp.array(0))))
    return q, k, ~(ahead <= tol)


def _moved(system, t, q, step):
    return q + step if system.rates_are_velocities else system.normalize(q + system.rates(t, q, step))


def _position_rows(system, t, q):
    """Φ, and zeros for the rows that bind velocities only."""
    return jnp.pad(system.position_residual(t, q), (0, system.velocity_rows - system.position_rows))
