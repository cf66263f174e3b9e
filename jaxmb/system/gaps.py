"""Gaps and slips of the unilateral constraints and dry friction of a system, also of those that are closed or stick,
with their derivatives.

Where contacts and friction are listed together, contacts come first. Their directions are those along which their
forces act: normal to a contact, along the slip of friction.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._types import Coordinates, Scalar, Velocities
from ..linalg.complementarity import of_pairs
from ..linalg.rotations import norm
from ..linalg.sums import unchecked_take, with_entries
from .equation import AbstractEquation, Contacts, Frictions

# Modes of a contact: open; closed; closed, where others that are closed as well imply it and take the force.
OPEN, CLOSED, IMPLIED = 0, 1, 2
# Modes of dry friction: without a force; slip along its direction, and against it; stick; stick, where others that
# stick as well imply it and take the force. Those of friction with two directions that slips are the components of a
# vector of length one, or `BEGUN` where slip has just begun.
FREE, FORWARD, BACKWARD, STICK, IMPLIED_STICK = 0, 1, -1, 2, 3
BEGUN = 0.5


def contacts_of(system: AbstractEquation) -> Contacts:
    """The unilateral constraints and dry friction of a system that has some."""
    assert system.contacts is not None
    return system.contacts


def frictions_of(system: AbstractEquation) -> Frictions:
    """The dry friction of a system that has some."""
    frictions = contacts_of(system).frictions
    assert frictions is not None
    return frictions


def counts(system: AbstractEquation) -> tuple[int, int]:
    """The numbers of contacts and of the directions of dry friction."""
    contacts = contacts_of(system)
    return len(contacts.names), 0 if contacts.frictions is None else len(contacts.frictions.names)


def names_of(system: AbstractEquation) -> tuple[str, ...]:
    """The names of contacts and friction, one for each direction."""
    contacts = contacts_of(system)
    return contacts.names + (() if contacts.frictions is None else contacts.frictions.names)


def mode_places(system: AbstractEquation) -> np.ndarray:
    """The indices in q of the modes of contacts and friction."""
    contacts = contacts_of(system)
    return np.array(contacts.modes + (() if contacts.frictions is None else contacts.frictions.modes), int)


def modes_of(system: AbstractEquation, q: Coordinates) -> Float[Array, "laws"]:
    """The modes of contacts and friction in some coordinates; whole numbers but for slip in two directions."""
    modes, own = unchecked_take(q, mode_places(system)), pairs_of(system)
    if not own.size:
        return jnp.round(modes)
    return jnp.where(np.isin(np.arange(modes.size), own), modes, jnp.round(modes))


def kinds_of(system: AbstractEquation, modes: Float[Array, "laws"]) -> Float[Array, "laws"]:
    """The modes as whole numbers: of friction that slips in two directions 1."""
    own = pairs_of(system)
    if not own.size:
        return modes
    sizes = norm(modes[own])
    kinds = jnp.where(sizes > STICK, STICK, jnp.where(sizes > 0, FORWARD, FREE)).astype(modes.dtype)
    return with_entries(modes, own.reshape(-1), jnp.repeat(kinds, 2))


def pairs_of(system: AbstractEquation) -> Int[np.ndarray, "pairs 2"]:
    """The numbers of both directions of friction with two of them, among contacts and friction."""
    frictions = contacts_of(system).frictions
    return counts(system)[0] + of_pairs(() if frictions is None else frictions.pairs)


def are_open(system: AbstractEquation, q: Coordinates) -> Bool[Array, "contacts"]:
    """Which contacts are open; of a system without any, none is asked."""
    if system.contacts is None:
        return jnp.zeros(0, bool)
    return modes_of(system, q)[: counts(system)[0]] == OPEN


def with_modes(system: AbstractEquation, q: Coordinates, modes: ArrayLike) -> Float[Array, "nq"]:
    """The coordinates with other modes."""
    places = mode_places(system)
    return with_entries(q, places, jnp.broadcast_to(jnp.asarray(modes, q.dtype), places.shape))


def gaps(system: AbstractEquation, t: Scalar, q: Coordinates) -> Float[Array, "contacts"]:
    """The gaps [m, rad], negative where bodies are inside each other."""
    rows = contacts_of(system).rows
    return _taken(system.position_residual(t, bound(system, q)), rows)


def direction_rates(system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "laws"]:
    """The rates of the gaps, and the velocities of slip."""
    return _taken(system.velocity_residual(t, bound(system, q), u), direction_rows(system))


def direction_accelerations(
    system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities, udot: Float[Array, "nu"]
) -> Float[Array, "laws"]:
    """The second derivatives of the gaps, and the derivatives of the velocities of slip."""
    return _taken(system.acceleration_residual(t, bound(system, q), u, udot), direction_rows(system))


def direction_gradients(system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "laws nu"]:
    """Derivatives of the rates with respect to velocities: the rows of A of contacts that are closed, and of friction
    that sticks.
    """
    rates, pull = jax.vjp(lambda u: direction_rates(system, t, q, u), u)
    return jax.vmap(lambda row: pull(row)[0])(jnp.eye(rates.size, dtype=rates.dtype))


def direction_rows(system: AbstractEquation) -> tuple[int, ...]:
    """The numbers of the rows of A of contacts and friction."""
    contacts = contacts_of(system)
    return contacts.rows + (() if contacts.frictions is None else contacts.frictions.rows)


def bound(system: AbstractEquation, q: Coordinates) -> Float[Array, "nq"]:
    """The coordinates with all contacts closed and all friction sticking."""
    n, m = counts(system)
    return with_modes(system, q, np.array([CLOSED] * n + [STICK] * m, float))


def _taken(values, numbers):
    # Slices of rows that follow one another, so that the compiler leaves out those of other parts.
    rows = np.array(numbers, int)
    runs = np.split(rows, 1 + np.flatnonzero(np.diff(rows) != 1)) if rows.size else []
    return jnp.concatenate([*(values[run[0] : run[-1] + 1] for run in runs), values[:0]])
