"""Forces of closed contacts that imply each other: the equations determine their sum, but not their shares.

As many contacts as are independent have a row of A with a force. The others are implied, and the force may be moved to
them: along each such choice the equations of motion stay as they are. All contacts stay closed as long as some choice
leaves none of them pulling.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Coordinates, Scalar, Velocities
from ..linalg.complementarity import PIVOT, largest_least, least_norm
from ..linalg.elimination import solve
from ..linalg.sums import with_entries
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .forces import directions


class Shares(NamedTuple):
    """The ways in which closed contacts can share forces.

    **Fields:** contacts that are `implied`; `instead`: the change of the force of each independent contact (row) by a
    unit force of each implied one (column); contacts that are `sharing`.
    """

    implied: Bool[Array, "n"]
    instead: Float[Array, "n n"]
    sharing: Bool[Array, "n"]

    @classmethod
    def at(cls, system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> "Shares":
        """The shares at a state."""
        contacts = system.contacts
        modes = contacts.modes(q)
        closed, implied = modes.closed, modes.shut & ~modes.closed
        rows, others = directions(system, t, q, u)
        rows, projector = rows[: contacts.n], others.projector(system.inertia(t, q, u))
        none = jnp.zeros(system.acceleration_rows, q.dtype)
        influence = rows @ jax.vmap(lambda row: projector.solve(row, none)[0])(rows).T
        matrix = jnp.where(closed[:, None] & closed[None, :], influence, jnp.eye(contacts.n, dtype=q.dtype))
        instead = solve(matrix, jnp.where(closed[:, None] & implied[None, :], -influence, 0.0))
        shares = lax.stop_gradient(jnp.any(jnp.abs(instead) > PIVOT, axis=1))
        return cls(implied, instead, implied | (closed & shares))

    def largest_least(self, forces: Float[Array, "n"]) -> Float[Array, "n"]:
        """The forces of contacts, in units of the largest; of those that share, the largest least force that all of
        them can have.
        """
        given = self.sharing & ~self.implied
        least = largest_least(jnp.where(given, forces, 0.0), self.instead, given, self.implied)
        return jnp.where(given, least, forces)

    def least(self, forces: Float[Array, "n"]) -> Float[Array, "n"]:
        """The forces of contacts; those that share have the least sum of squares without pulling."""
        shared = least_norm(jnp.where(self.sharing, forces, 0.0), self.instead, self.implied)
        return jnp.where(self.sharing, shared, forces)


def shared_multipliers(at: Instant, multipliers: Float[Array, "m"]) -> Float[Array, "m"]:
    """Multipliers in which implied contacts have their shares of the forces; see `ContactSet.bearing`."""
    contacts = at.system.contacts
    if contacts.n < 2:
        return multipliers
    forces = contacts.at_rows(multipliers)[: contacts.n]
    shares = Shares.at(at.system, at.t, at.q, at.u)
    return with_entries(multipliers, np.array(contacts.rows[: contacts.n]), shares.least(forces))
