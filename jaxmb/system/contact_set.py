"""The contacts and the dry friction of a system: places of their rows and modes, gaps and slips with derivatives."""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._types import Coordinates, Scalar
from ..linalg.pairs import of_pairs
from ..linalg.sums import unchecked_take, with_entries
from ..parts.modes import CLOSED, STICK, Modes
from .sharing import NoSharing


class ContactNumbers(NamedTuple):
    """The numbers of contacts and dry friction.

    **Fields:** for each contact, the coefficient of `restitution`, and in `peaks` the kink of a gap that rises and
    falls again, infinite for other gaps; for each direction of friction, the `coefficient` of slip and the `limit` of
    stick.
    """

    restitution: Float[Array, "contacts"]
    peaks: Float[Array, "contacts"]
    coefficient: Float[Array, "frictions"]
    limit: Float[Array, "frictions"]


class ContactPlace(NamedTuple):
    """Contacts and dry friction at a place, as if all contacts were closed and all friction stuck.

    **Fields:** the `gaps` [m, rad], negative where bodies are inside each other; `gradients`: the derivatives by
    velocities of the rates of gaps and of the velocities of slip, rows of A; `sizes`: for each direction of friction
    the normal force of its contact by a unit multiplier, 1 in joints.
    """

    gaps: Float[Array, "contacts"]
    gradients: Float[Array, "laws nu"]
    sizes: Float[Array, "frictions"]


class ContactMotion(NamedTuple):
    """Contacts and dry friction in motion, as if all contacts were closed and all friction stuck.

    **Fields:** the `rates` of gaps and the velocities of slip; their derivatives without accelerations, `biases`.
    """

    rates: Float[Array, "laws"]
    biases: Float[Array, "laws"]


@dataclasses.dataclass(frozen=True)
class ContactSet:
    """The unilateral constraints of a system and its dry friction; false without any.

    A unilateral constraint is a gap that stays non-negative; dry friction sticks or slips.

    Each contact has a law, and so has each direction of slip; contacts come first. A law has a row of A and a
    coordinate, its mode, see `parts.modes`. The row is `gap = 0` of a closed contact and `slip = 0` of sticking
    friction; otherwise it keeps the mode constant. So the number and the rank of rows never change. No force acts on a
    mode, which is a number of the state like any other. A law acts along its force: normal to a contact, along the slip
    of friction.

    **Fields:**

    - For each law: its name in `names`; the index of its row of A in `rows`; the index of its mode in q in `places`.
    - For each contact: whether impacts follow Poisson's law, `by_poisson`, or Newton's.
    - For each direction of friction: the index of its contact in `contact_of`, -1 in a joint; in `releases`, whether
        coefficients of slip and stick differ, so that accelerations jump as slip begins; and in `constant`, whether the
        coefficients are forces, with a normal force of one.
    - `pairs`: for friction with two directions, the index of the first among all friction; the second follows.
    - `coupled`: whether the normal forces of friction in joints depend on friction itself, without other constraints.
    - `sharing`: what is added if contacts imply each other when all are closed, see `shared_contacts`.
    """

    names: tuple[str, ...] = ()
    rows: tuple[int, ...] = ()
    places: tuple[int, ...] = ()
    by_poisson: tuple[bool, ...] = ()
    contact_of: tuple[int, ...] = ()
    releases: tuple[bool, ...] = ()
    constant: tuple[bool, ...] = ()
    pairs: tuple[int, ...] = ()
    coupled: bool = False
    sharing: NoSharing = dataclasses.field(default_factory=NoSharing)

    def __bool__(self) -> bool:
        return bool(self.names)

    @property
    def may_share(self) -> bool:
        """Whether there are contacts that could imply each other."""
        return self.n > 1

    @property
    def n(self) -> int:
        """The number of contacts."""
        return len(self.by_poisson)

    @property
    def m(self) -> int:
        """The number of directions of dry friction."""
        return len(self.contact_of)

    @property
    def contact_names(self) -> tuple[str, ...]:
        return self.names[: self.n]

    @property
    def contact_places(self) -> tuple[int, ...]:
        return self.places[: self.n]

    @property
    def friction_names(self) -> tuple[str, ...]:
        """The names of friction, once each."""
        return tuple(dict.fromkeys(self.names[self.n :]))

    @functools.cached_property
    def in_joints(self) -> Bool[np.ndarray, "frictions"]:
        """Which directions of friction belong to joints, where the size of the reaction is the normal force."""
        return np.array(self.contact_of, int) < 0

    @functools.cached_property
    def of_reactions(self) -> bool:
        """Whether some friction depends on the reaction of a joint."""
        return bool(np.any(self.in_joints & ~np.array(self.constant, bool)))

    @functools.cached_property
    def in_pairs(self) -> Bool[np.ndarray, "frictions"]:
        """Which directions of friction belong to a pair."""
        return np.isin(np.arange(self.m), of_pairs(self.pairs))

    @functools.cached_property
    def linked(self) -> Bool[np.ndarray, "laws laws"]:
        """Which laws always act on each other: a contact and its friction, and both directions of friction."""
        first = np.arange(self.n + self.m)
        for k, contact in enumerate(self.contact_of):
            first[self.n + k] = contact if contact >= 0 else first[self.n + k]
        for k in self.pairs:
            first[self.n + k + 1] = first[self.n + k]
        return first[:, None] == first[None, :]

    @functools.cached_property
    def heads(self) -> Int[np.ndarray, "units"]:
        """The first laws of those that are linked: contacts, and friction in joints."""
        return np.flatnonzero(np.argmax(self.linked, axis=1) == np.arange(self.n + self.m))

    def alone(self, system: Any) -> bool:
        """Whether the system has no other rows of A."""
        return len(self.rows) == system.acceleration_rows

    @property
    def in_groups(self) -> bool:
        """Whether there can be several groups of laws that act on each other."""
        return self.heads.size > 1

    def at_rows(self, values: Float[Array, "acceleration_rows *k"]) -> Float[Array, "laws *k"]:
        """Values of the laws, from values of all rows of A."""
        return values[np.array(self.rows, int)]

    # Modes

    def modes(self, q: Coordinates) -> Modes:
        """The modes in q."""
        if not self:
            return self.as_modes(jnp.zeros(0, q.dtype))
        return Modes.of(unchecked_take(q, np.array(self.places, int)), self.n, self.pairs)

    def as_modes(self, numbers: Float[Array, "laws"]) -> Modes:
        """Modes from their numbers."""
        return Modes(numbers, self.n, self.pairs)

    def with_modes(self, q: Coordinates, modes: ArrayLike) -> Float[Array, "nq"]:
        """The coordinates with other modes, a number for each law or a common number."""
        places = np.array(self.places, int)
        return with_entries(q, places, jnp.broadcast_to(jnp.asarray(modes, q.dtype), places.shape))

    def bound(self, q: Coordinates) -> Float[Array, "nq"]:
        """The coordinates with all contacts closed and all friction sticking."""
        return self.with_modes(q, np.repeat([CLOSED, STICK], [self.n, self.m]).astype(float))

    def stuck(self, at: Any, multipliers: Float[Array, "laws m"]) -> tuple[Any, Float[Array, "laws m"]]:
        """The instant and the multipliers of each law from which its reactions follow. Of coupled friction these are
        those of stick, whose force is the multiplier of its row.
        """
        if not self.coupled:
            return at, multipliers
        own = np.eye(multipliers.shape[1])[np.array(self.rows)]
        return at.with_(q=self.bound(at.q)), multipliers + jnp.asarray(own, multipliers.dtype)

    # Friction of constant size, whose normal force is one

    def by_forces(self, reactions: Float[Array, "more_laws m d"]) -> Float[Array, "more_laws m d"]:
        """The reactions without forces along the laws, and by a unit force along each."""
        if not any(self.constant):
            return reactions
        return reactions.at[1:, np.flatnonzero(self.constant)].set(0.0)

    def with_limits(self, system: Any, t: Scalar, size: Float[Array, ""]) -> Float[Array, ""]:
        """The largest force, with limits of friction beside which no other force may act."""
        if not any(self.constant):
            return size
        return size + jnp.max(system.contact_numbers(t).limit[np.flatnonzero(self.constant)])
