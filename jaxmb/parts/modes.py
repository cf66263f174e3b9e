"""Modes of contacts and of dry friction: coordinates that select their laws.

A contact is open (0), closed (1), or closed but implied by other closed contacts, which take the force (2). Dry
friction in one direction is inactive (0), slips forwards or backwards (1, -1), sticks (2), or sticks but is implied by
other friction, which takes the force (3). Friction in two directions has two modes. Both have the same number if it is
inactive or sticks. In slip they are the components of a vector near the direction of slip: of length one, or one half
if slip has just begun from rest and is still below its tolerance.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..linalg.pairs import of_pairs, placed_pairs
from ..linalg.rotations import norm
from ..linalg.sums import with_entries

OPEN, CLOSED, IMPLIED = 0, 1, 2
FREE, FORWARD, STICK, IMPLIED_STICK = 0, 1, 2, 3
# The length of the modes when slip in two directions has just begun, and the lengths between which slip is above its
# tolerance.
BEGUN, _SEEN, _HELD = 0.5, 0.75, 1.5


def kind_of(mode: Float[Array, "..."]) -> Float[Array, "..."]:
    """The whole number of a mode, without derivative."""
    return lax.stop_gradient(jnp.round(mode))


def slip_direction(modes: Float[Array, "rows"], slip: Float[Array, "rows"]) -> Float[Array, "rows"]:
    """The unit vector against which dry friction acts, by its modes; zero where it sticks or is free.

    In two directions it is the direction of the slip, on the side of the modes: the force does not jump where slip
    passes through zero. It is the direction of the modes if slip has just begun, or is zero.
    """
    if modes.size == 1:
        return jnp.where(jnp.abs(jnp.round(modes)) == FORWARD, jnp.round(modes), 0.0)
    size, speed = norm(modes), norm(slip)
    slides = (size > _SEEN) & (size < _HELD) & (speed > 0)
    sign = jnp.where(jnp.dot(lax.stop_gradient(slip), modes) < 0, -1.0, 1.0)
    along_slip = sign * slip / jnp.where(slides, speed, 1.0)
    begun = modes / jnp.where(size > 0, size, 1.0)
    return jnp.where(slides, along_slip, jnp.where(size < _HELD, begun, 0.0))


class SlipInPlane(NamedTuple):
    """Friction in two directions: its `modes`, shape (pairs, 2), and their `size`."""

    modes: Float[Array, "pairs 2"]
    size: Float[Array, "pairs"]

    @property
    def slips(self) -> Bool[Array, "pairs"]:
        return (self.size > 0) & (self.size < _HELD)

    @property
    def begun(self) -> Bool[Array, "pairs"]:
        """Friction whose slip has begun and is still below its tolerance."""
        return (self.size > 0) & (self.size < _SEEN)

    @property
    def slides(self) -> Bool[Array, "pairs"]:
        """Friction whose slip is above its tolerance."""
        return (self.size > _SEEN) & (self.size < _HELD)


class Modes(NamedTuple):
    """The modes of a system's contacts, followed by the modes of its dry friction.

    **Fields:** `numbers`: the modes, whole numbers except for slip in two directions; `n`: the number of contacts;
    `pairs`: for each friction in two directions, the index of its first direction among all friction.
    """

    numbers: Float[Array, "laws"]
    n: int
    pairs: tuple[int, ...]

    @classmethod
    def of(cls, numbers: Float[Array, "laws"], n: int, pairs: tuple[int, ...]) -> "Modes":
        """Modes from coordinates."""
        out = cls(jnp.round(numbers), n, pairs)
        return out._replace(numbers=jnp.where(out._paired, numbers, out.numbers)) if pairs else out

    @property
    def _paired(self):
        return np.isin(np.arange(self.numbers.size), self.n + of_pairs(self.pairs))

    @property
    def of_contacts(self) -> Float[Array, "contacts"]:
        return self.numbers[: self.n]

    @property
    def of_friction(self) -> Float[Array, "frictions"]:
        return self.numbers[self.n :]

    @property
    def open(self) -> Bool[Array, "contacts"]:
        """Contacts that are open."""
        return self.of_contacts == OPEN

    @property
    def shut(self) -> Bool[Array, "contacts"]:
        """Contacts that are closed, with a force or without."""
        return self.of_contacts != OPEN

    @property
    def closed(self) -> Bool[Array, "contacts"]:
        """Contacts that are closed and have a force."""
        return self.of_contacts == CLOSED

    @property
    def sticks(self) -> Bool[Array, "frictions"]:
        """Friction that sticks and has a force."""
        return self.of_friction == STICK

    @property
    def implied_stick(self) -> Bool[Array, "frictions"]:
        """Friction that sticks while other friction implies it."""
        return self.of_friction == IMPLIED_STICK

    @property
    def held(self) -> Bool[Array, "frictions"]:
        """Friction that sticks, with a force or without."""
        return self.of_friction >= STICK

    @property
    def slides(self) -> Bool[Array, "frictions"]:
        """Friction in one direction that slips."""
        return jnp.abs(self.of_friction) == FORWARD

    @property
    def in_plane(self) -> SlipInPlane:
        """Friction in two directions."""
        modes = self.numbers[self.n + of_pairs(self.pairs)]
        return SlipInPlane(modes, norm(modes))

    def slips(self, slip: Float[Array, "frictions"]) -> Float[Array, "frictions"]:
        """The directions of slip, from its velocities; zero without slip."""
        slips = jnp.where(self.slides, self.of_friction, FREE)
        if not self.pairs:
            return slips
        both = of_pairs(self.pairs)
        return placed_pairs(self.pairs, jax.vmap(slip_direction)(self.of_friction[both], slip[both]), slips)

    @property
    def kinds(self) -> Float[Array, "laws"]:
        """The modes as whole numbers: 1 for slip in two directions."""
        if not self.pairs:
            return self.numbers
        sizes = self.in_plane.size
        kinds = jnp.where(sizes > _HELD, STICK, jnp.where(sizes > 0, FORWARD, FREE)).astype(self.numbers.dtype)
        return with_entries(self.numbers, np.flatnonzero(self._paired), jnp.repeat(kinds, 2))


def modes_of_contacts(closed: Bool[Array, "contacts"], implied: Bool[Array, "contacts"]) -> Array:
    """The modes of contacts that are `closed`, `implied` by these, or else open."""
    return jnp.where(closed, CLOSED, jnp.where(implied, IMPLIED, OPEN))


def modes_of_friction(
    sticks: Bool[Array, "frictions"],
    implied: Bool[Array, "frictions"],
    slips: Float[Array, "frictions"],
    begun: Bool[Array, "frictions"],
) -> Array:
    """The modes of friction that `sticks`, is `implied` to stick, or `slips` in a direction; in two directions slip may
    have just `begun`.
    """
    return jnp.where(sticks, STICK, jnp.where(implied, IMPLIED_STICK, jnp.where(begun, BEGUN, 1.0) * slips))
