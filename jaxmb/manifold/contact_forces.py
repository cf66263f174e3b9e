"""Forces of contacts and dry friction at a state, and what they are compared with."""

import jax
import jax.numpy as jnp
import numpy as np

from ..formulations import Multipliers, accelerations
from ..linalg.elimination import solve
from ..linalg.rotations import norm
from ..linalg.sums import unchecked_take
from ..system.gaps import (
    STICK,
    bound,
    contacts_of,
    counts,
    direction_gradients,
    direction_rows,
    frictions_of,
    modes_of,
    with_modes,
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
    forces = unchecked_take(multipliers, np.array(frictions.rows))
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


def contact_forces(system, t, q, u):
    """Accelerations and multipliers at a state, without a search for pivots."""
    if not system.ideal_on_velocities:
        return accelerations(system, Multipliers(), t, q, u)
    jacobian = system.structured_jacobian(t, q, u).selected(system.acceleration_rank, system.velocity_scale())
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    return jacobian.projector(system.inertia(t, q, u)).solve(system.force(t, q, u), gamma)


def directions(system, t, q, u):
    """The rows of A of contacts that are closed, and of friction that sticks; A with the other rows that bind
    velocities, which are selected.
    """
    numbers = direction_rows(system)
    jacobian = system.structured_jacobian(t, bound(system, q), u)
    unit = np.eye(system.acceleration_rows)[list(numbers)]
    rows = jax.vmap(jacobian.transpose_product)(jnp.asarray(unit, q.dtype))
    others = tuple(k for k in range(system.velocity_rows) if k not in numbers)
    # Where contacts are open, and friction slips, their rows bind nothing but their modes.
    return rows, jacobian.of_rows(others).selected(system.velocity_rank - len(numbers), system.velocity_scale())


def free_accelerations(system, formulation, projector, t, q, u):
    """Accelerations and multipliers without contacts and friction, and the accelerations along their directions.

    **Arguments:** the `projector` on the other constraints.
    """
    residual = system.acceleration_residual(t, bound(system, q), u, jnp.zeros_like(u))
    if system.ideal_without_friction:
        udot, multipliers = projector.solve(system.force(t, q, u), -residual)
    else:
        udot, multipliers = accelerations(system, formulation, t, with_modes(system, q, 0.0), u)
    along = projector.jacobian.product(udot) + residual
    return udot, multipliers, along[np.array(direction_rows(system))]
