"""Forces of closed contacts that imply each other: the equations determine their sum, but not their shares.

As many contacts as are independent have a row of A with a force. The others are implied, and the force may be moved to
them: along each such choice the equations of motion stay as they are. All contacts stay closed as long as some choice
leaves none of them pulling.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import State
from ..linalg.complementarity import PIVOT, largest_least, least_norm, reduced
from ..linalg.elimination import solve
from ..linalg.pairs import sizes_of
from ..linalg.sums import with_entries
from ..parts.modes import CLOSED, IMPLIED
from ..system.instant import Instant
from ..system.sharing import NoSharing
from .forces import other_rows, sliding

# Shares of forces change slip if its acceleration changes by this fraction of the friction of one contact; along a
# motion it is seen at the second one.
_UNDETERMINED, _SEEN = 1e-6, 1e-3
# Slip above this multiple of the slow velocity has a known direction.
_FAST = 1e4


class Shares(NamedTuple):
    """The ways in which closed contacts can share forces.

    **Fields:** contacts that are `implied`; `instead`: the change of the force of each independent contact (row) by a
    unit force of each implied one (column); contacts that are `sharing`.
    """

    implied: Bool[Array, "n"]
    instead: Float[Array, "n n"]
    sharing: Bool[Array, "n"]

    @classmethod
    def at(cls, at: Instant) -> "Shares":
        """The shares at an instant."""
        contacts = at.system.contacts
        modes = contacts.modes(at.q)
        closed, implied = modes.closed, modes.shut & ~modes.closed
        influence = _influence(at)[: contacts.n, : contacts.n]
        instead = _instead(influence, closed, implied)
        shares = lax.stop_gradient(jnp.any(jnp.abs(instead) > PIVOT, axis=1))
        return cls(implied, instead, implied | (closed & shares))

    def largest_least(self, forces: Float[Array, "n"]) -> Float[Array, "n"]:
        """The forces of contacts; of those that share, the largest least force that all of them can have."""
        given = self.sharing & ~self.implied
        forces_given = jnp.where(given, forces, 0.0)
        # In units in which the method has its bound.
        size = lax.stop_gradient(jnp.max(jnp.abs(forces_given)))
        size = jnp.where(size > 0, size, 1.0)
        least = size * largest_least(forces_given / size, self.instead, given, self.implied)
        return jnp.where(given, least, forces)

    def least(self, forces: Float[Array, "n"]) -> Float[Array, "n"]:
        """The forces of contacts; those that share have the least sum of squares without pulling."""
        shared = least_norm(jnp.where(self.sharing, forces, 0.0), self.instead, self.implied)
        return jnp.where(self.sharing, shared, forces)


@dataclasses.dataclass(frozen=True)
class Sharing(NoSharing):
    """Contacts that imply each other if all of them are closed."""

    def shut(self, modes, gap, near):
        # Contacts that others implied may have parted.
        return modes.shut & (modes.closed | (gap <= 0.5 * near))

    def guarded(self, at, gap, tolerance, values):
        system, contacts = at.system, at.system.contacts
        n, modes = contacts.n, contacts.modes(at.q)
        implied = modes.shut & ~modes.closed
        rates, tolerance = at.contact_motion.rates[n:], tolerance.in_metres(system)
        speeds = sizes_of(contacts.pairs, rates)
        slips = jnp.where(_is_fast(speeds, tolerance.slow(system, at.u)), modes.slips(rates), 0.0)
        slides = sliding(at, speeds).along_gaps(at)
        change = _change(contacts, _influence(at), slides.coefficient, slips, modes.closed, implied)
        # Contacts that others imply at one pose may part, or meet, at another; and slip may come to depend on shares.
        return jnp.where(implied, tolerance.near * (1 - change / _SEEN) - jnp.abs(gap), values)

    def reserves(self, at, multipliers, reserves):
        contacts = at.system.contacts
        shares = Shares.at(at)
        forces = contacts.at_rows(multipliers)[: contacts.n]
        least = shares.largest_least(forces)
        # Friction is at its limit where the normal forces have their least shares.
        shared = with_entries(multipliers, np.array(contacts.rows[: contacts.n]), shares.least(forces))
        bearing = at.with_(q=self.bearing(contacts, State(at.q, at.u)).q)
        return jnp.concatenate([least, reserves(bearing, shared)[contacts.n :]])

    def determined(self, laws, settled, implied, slow):
        last, struck, n = settled.answers, settled.struck, laws.contacts.n
        rate, ended = struck.rate[n:], struck.ended
        speeds = laws.sizes(rate)
        slips = jnp.where(_is_fast(speeds, slow), rate / jnp.where(ended, 1.0, speeds), 0.0)
        slips = jnp.where(ended, last.slips, slips)
        coefficient, _ = laws.sliding(jnp.where(ended, 0.0, speeds))
        change = _change(laws.contacts, laws.influence, coefficient, slips, last.closed, implied)
        return change <= _UNDETERMINED

    def multipliers(self, at, multipliers):
        contacts = at.system.contacts
        forces = contacts.at_rows(multipliers)[: contacts.n]
        shares = Shares.at(at)
        return with_entries(multipliers, np.array(contacts.rows[: contacts.n]), shares.least(forces))

    def bearing(self, contacts, ys):
        places = np.array(contacts.contact_places, int)
        modes = ys.q[..., places]
        borne = jnp.where(jnp.round(modes) == IMPLIED, CLOSED, modes)
        return dataclasses.replace(ys, q=ys.q.at[..., places].set(borne))

    def where_stuck(self, contacts):
        names = ", ".join(dict.fromkeys(map(repr, contacts.names)))
        return f" It may be the contacts and the friction {names}, of which several share a load.{self.about()}"

    def about(self):
        return (
            " Or, if they slip in different directions, the motion is undetermined: it depends on the shares of a load "
            "that contacts which imply each other leave open. Three feet determine it, and so do compliant contacts."
        )


def _influence(at):
    """The accelerations along the laws by unit forces along them."""
    rows, projector = at.contact_place.gradients, other_rows(at).projector(at.inertia)
    none = jnp.zeros(at.system.acceleration_rows, rows.dtype)
    return rows @ jax.vmap(lambda row: projector.solve(row, none)[0])(rows).T


def _is_fast(speeds, slow):
    """Whether directions of slip are known; near the end of slip they have rounding errors."""
    return jnp.max(speeds, initial=0.0) > _FAST * slow


def _change(contacts, influence, coefficient, slips, closed, implied):
    """The largest change of the acceleration of slip by shares of forces, as a fraction of that by the friction of one
    contact with a unit force.
    """
    n, m = contacts.n, contacts.m
    left = reduced(influence, jnp.concatenate([closed, jnp.zeros(m, bool)]))[n:, n:]
    moved = _instead(influence[:n, :n], closed, implied) + jnp.diag(jnp.where(implied, 1.0, 0.0))
    pushes = jnp.where(contacts.in_joints[:, None], 0.0, moved[np.array(contacts.contact_of, int)])
    change = left @ ((coefficient * slips)[:, None] * pushes)
    size = jnp.max(coefficient * jnp.diag(influence)[n:], initial=0.0)
    return jnp.max(jnp.abs(change), initial=0.0) / jnp.where(size > 0, size, 1.0)


def _instead(influence, closed, implied):
    """The change of the force of each closed contact (row) by a unit force of each implied one (column)."""
    both = closed[:, None] & closed[None, :]
    matrix = jnp.where(both, influence, jnp.eye(closed.size, dtype=influence.dtype))
    return solve(matrix, jnp.where(closed[:, None] & implied[None, :], -influence, 0.0))
