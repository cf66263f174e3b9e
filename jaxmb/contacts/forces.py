"""Forces of contacts and dry friction at a state, and their sizes of comparison."""

import jax
import jax.numpy as jnp
import numpy as np

from ..formulations import Multipliers, accelerations
from ..linalg.elimination import solve
from ..linalg.pairs import sizes_of
from ..linalg.rotations import norm

# Forces of several contacts that stick are the smallest possible up to this fraction of them.
_YIELD = 1e-10


def largest_force(system, t, y, multipliers):
    """The size to which forces are compared."""
    largest = jnp.max(jnp.abs(multipliers)) + jnp.max(jnp.abs(system.force(t, y.q, y.u)))
    largest = system.contacts.with_limits(system, t, largest)
    return largest + jnp.finfo(largest.dtype).tiny


def reserves(system, t, q, u, multipliers):
    """The forces [N] of contacts, and the reserve of sticking friction forces below their limits."""
    contacts = system.contacts
    forces, n = contacts.at_rows(multipliers), contacts.n
    if not contacts.m:
        return forces
    normal, dry = norm(system.friction_reactions(t, q, u, multipliers)), forces[n:]
    if len(contacts.pairs) > 1:
        # Undetermined forces are as small as possible.
        stick = contacts.modes(q).held
        gradients = jnp.where(stick[:, None], contacts.gradients(system, t, q, u)[n:], 0.0)
        gram = gradients @ gradients.T
        size = _YIELD * jnp.max(jnp.diag(gram)) + jnp.finfo(gram.dtype).tiny
        shared = solve(gram + size * jnp.eye(stick.size, dtype=gram.dtype), gram @ dry)
        dry = jnp.where(stick, shared, dry)
    return jnp.concatenate([forces[:n], system.contact_numbers(t).limit * normal - sizes_of(contacts.pairs, dry)])


def friction_coefficients(system, t, q, u):
    """Coefficients of friction and limits of stick, as multiples of the force along the gap of a contact. That force is
    the normal force if the gap grows by one metre a metre.
    """
    contacts, numbers = system.contacts, system.contact_numbers(t)
    if contacts.in_joints.all():
        return numbers.coefficient, numbers.limit
    unit = np.isin(np.arange(system.acceleration_rows), contacts.rows[: contacts.n]).astype(q.dtype)
    sizes = norm(system.friction_reactions(t, contacts.bound(q), u, jnp.asarray(unit)))
    sizes = jnp.where(contacts.in_joints, 1.0, sizes)
    return numbers.coefficient * sizes, numbers.limit * sizes


def contact_forces(system, t, q, u):
    """Accelerations and multipliers at a state, without a search for pivots."""
    if not system.ideal_on_velocities:
        return accelerations(system, Multipliers(), t, q, u)
    jacobian = system.structured_jacobian(t, q, u).selected(system.acceleration_rank, system.velocity_scale())
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    return jacobian.projector(system.inertia(t, q, u)).solve(system.force(t, q, u), gamma)


def directions(system, t, q, u):
    """The rows of A of contacts and friction; A with the other rows that bind velocities, selected."""
    numbers = system.contacts.rows
    jacobian = system.structured_jacobian(t, system.contacts.bound(q), u)
    unit = np.eye(system.acceleration_rows)[list(numbers)]
    rows = jax.vmap(jacobian.transpose_product)(jnp.asarray(unit, q.dtype))
    other_rows = tuple(k for k in range(system.velocity_rows) if k not in numbers)
    # The rows of open contacts and slipping friction bind only their modes.
    return rows, jacobian.of_rows(other_rows).selected(system.velocity_rank - len(numbers), system.velocity_scale())


def free_accelerations(system, formulation, projector, t, q, u):
    """Accelerations and multipliers without contacts and friction, and the accelerations along their directions.

    **Arguments:** the `projector` on the other constraints.
    """
    contacts = system.contacts
    residual = system.acceleration_residual(t, contacts.bound(q), u, jnp.zeros_like(u))
    if system.ideal_without_friction:
        udot, multipliers = projector.solve(system.force(t, q, u), -residual)
    else:
        udot, multipliers = accelerations(system, formulation, t, contacts.with_modes(q, 0.0), u)
    along = projector.jacobian.product(udot) + residual
    return udot, multipliers, contacts.at_rows(along)
