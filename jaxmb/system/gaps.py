"""Gaps of the unilateral constraints of a system, also of those that are closed, with their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from .._types import Coordinates, Scalar, Velocities
from .equation import AbstractEquation, Contacts

# Modes of a contact: open; closed; closed, where others that are closed as well imply it and take the force.
OPEN, CLOSED, IMPLIED = 0, 1, 2


def contacts_of(system: AbstractEquation) -> Contacts:
    """The unilateral constraints of a system that has some."""
    assert system.contacts is not None
    return system.contacts


def modes_of(system: AbstractEquation, q: Coordinates) -> Float[Array, "contacts"]:
    """The modes of the contacts in some coordinates, whole numbers."""
    return jnp.round(q[np.array(contacts_of(system).modes)])


def are_open(system: AbstractEquation, q: Coordinates) -> Bool[Array, "contacts"]:
    """Which contacts are open; of a system without any, none is asked."""
    return jnp.zeros(0, bool) if system.contacts is None else modes_of(system, q) == OPEN


def with_modes(system: AbstractEquation, q: Coordinates, modes: ArrayLike) -> Float[Array, "nq"]:
    """The coordinates with other modes."""
    return q.at[np.array(contacts_of(system).modes)].set(modes)


def gaps(system: AbstractEquation, t: Scalar, q: Coordinates) -> Float[Array, "contacts"]:
    """The gaps [m, rad], negative where bodies are inside each other."""
    return _of_contacts(system, system.position_residual(t, with_modes(system, q, CLOSED)))


def gap_rates(system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "contacts"]:
    """The rates of the gaps."""
    return _of_contacts(system, system.velocity_residual(t, with_modes(system, q, CLOSED), u))


def gap_accelerations(
    system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities, udot: Float[Array, "nu"]
) -> Float[Array, "contacts"]:
    """The second derivatives of the gaps."""
    return _of_contacts(system, system.acceleration_residual(t, with_modes(system, q, CLOSED), u, udot))


def gap_gradients(system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "contacts nu"]:
    """Derivatives of the rates of the gaps with respect to velocities: the rows of A of contacts that are closed."""
    rates, pull = jax.vjp(lambda u: gap_rates(system, t, q, u), u)
    return jax.vmap(lambda row: pull(row)[0])(jnp.eye(rates.size, dtype=rates.dtype))


def _of_contacts(system, values):
    # Slices of rows that follow one another, so that the compiler leaves out those of other parts.
    rows = np.array(contacts_of(system).rows)
    runs = np.split(rows, 1 + np.flatnonzero(np.diff(rows) != 1))
    return jnp.concatenate([values[run[0] : run[-1] + 1] for run in runs])
