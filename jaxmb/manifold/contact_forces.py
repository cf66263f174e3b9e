"""Forces of contacts and dry friction at a state, and what they are compared with."""

import jax.numpy as jnp
import numpy as np

from ..formulations import accelerations
from ..linalg.elimination import solve
from ..linalg.rotations import norm
from ..system.gaps import (
    STICK,
    bound,
    contacts_of,
    counts,
    direction_gradients,
    frictions_of,
    modes_of,
)
from .contact_laws import sizes_of

# Slip in two directions, which has none at rest, ends at this multiple of it per second: errors of integration, that
# are larger than it, turn slower ones.
_SLOW = 1e4
# Forces of several contacts that stick are as small as they can be up to this fraction of them.
_YIELD = 1e-10


def largest_force(system, t, y, multipliers):
    """What forces are compared with."""
    largest = jnp.max(jnp.abs(multipliers)) + jnp.max(jnp.abs(system.force(t, y.q, y.u)))
    return largest + jnp.finfo(largest.dtype).tiny


def stick_reserve(system, t, q, u, multipliers):
    """By how much the forces [N] of friction that sticks are within their limits."""
    frictions = frictions_of(system)
    normal = norm(system.friction_reactions(t, q, u, multipliers))
    forces = multipliers[np.array(frictions.rows)]
    if len(frictions.pairs) > 1:
        # Those that are not determined are as small as they can be.
        n = counts(system)[0]
        stick = modes_of(system, q)[n:] >= STICK
        gradients = jnp.where(stick[:, None], direction_gradients(system, t, q, u)[n:], 0.0)
        gram = gradients @ gradients.T
        size = _YIELD * jnp.max(jnp.diag(gram)) + jnp.finfo(gram.dtype).tiny
        shared = solve(gram + size * jnp.eye(stick.size, dtype=gram.dtype), gram @ forces)
        forces = jnp.where(stick, shared, forces)
    return frictions.limit * normal - sizes_of(frictions.pairs, forces)


def friction_coefficients(system, t, q, u):
    """Coefficients of friction and limits of stick, as multiples of the force along the gap of a contact, which is the
    normal force where the gap grows by one metre a metre.
    """
    frictions, contacts = frictions_of(system), contacts_of(system)
    unit = np.isin(np.arange(system.acceleration_rows), contacts.rows).astype(q.dtype)
    if min(frictions.contacts) < 0 and not contacts.rows:
        return frictions.coefficient, frictions.limit
    sizes = norm(system.friction_reactions(t, bound(system, q), u, jnp.asarray(unit)))
    sizes = jnp.where(np.array(frictions.contacts) < 0, 1.0, sizes)
    return frictions.coefficient * sizes, frictions.limit * sizes


def slow_slip(system, touch, u):
    """The velocity [m/s] up to which slip in two directions has ended; `touch` [m, rad]."""
    return _SLOW * touch * (1 + jnp.max(jnp.abs(u) / system.velocity_scale()))


def contact_forces(system, formulation, t, q, u):
    """Accelerations and multipliers at a state, without a search for pivots where that is possible."""
    if not system.ideal_on_velocities:
        return accelerations(system, formulation, t, q, u)
    jacobian = system.structured_jacobian(t, q, u).selected(system.acceleration_rank, system.velocity_scale())
    return _by_projector(system, jacobian.projector(system.inertia(t, q, u)), t, q, u)


def free_acceleration(system, formulation, projector, t, q, u):
    """Accelerations and multipliers at coordinates without contacts and friction, where the projector on the other
    constraints is known.
    """
    if not system.ideal_without_friction:
        return accelerations(system, formulation, t, q, u)
    return _by_projector(system, projector, t, q, u)


def _by_projector(system, projector, t, q, u):
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    return projector.solve(system.force(t, q, u), gamma)
