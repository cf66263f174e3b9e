"""The contacts and the dry friction of a system: places of their rows and modes, gaps and slips with derivatives."""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._types import Coordinates
from ..linalg.pairs import of_pairs
from ..linalg.sums import unchecked_take, with_entries
from ..parts.modes import CLOSED, STICK, Modes
from .sharing import NoSharing


class StackedLaws(eqx.Module):
    """Laws of one kind, see `parts.contact_laws`.

    **Fields:** the `laws`, stacked, or what their `kernels` take in their place: the methods of a user's laws by name,
    captured when the scene was compiled.
    """

    laws: Any
    kernels: tuple[tuple[str, Callable[..., Any]], ...] = eqx.field(static=True, default=())

    @property
    def count(self) -> int:
        return len(jax.tree.leaves(self.laws)[0])

    @property
    def kind(self) -> Any:
        """A law, for what it says of its class."""
        return self.laws.contact_law if self.kernels else self.laws

    def ask(self, name: str, *values: Float[Array, "laws"]) -> Float[Array, "laws"]:
        """The answers of a method."""
        method = dict(self.kernels).get(name, lambda law, *values: getattr(law, name)(*values))
        return jax.vmap(method)(self.laws, *values)


class LawTable(eqx.Module):
    """The laws of all contacts, or of all directions of friction, kind by kind.

    **Fields:** the `kinds`, and the places of their laws among all, their `members`; an array for `none`.
    """

    kinds: tuple[StackedLaws, ...]
    members: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    none: Float[Array, "0"]

    @classmethod
    def of(cls, groups: Iterable[StackedLaws], dtype: Any) -> "LawTable":
        """The laws of some groups, in their order."""
        kinds: dict[Any, list[tuple[StackedLaws, list[int]]]] = {}
        first = 0
        for group in groups:
            members = list(range(first, first + group.count))
            kinds.setdefault(jax.tree.structure(group), []).append((group, members))
            first += group.count
        joined = lambda *x: x[0] if len(x) == 1 else jnp.concatenate(x)
        stacked = [jax.tree.map(joined, *(g for g, _ in alike)) for alike in kinds.values()]
        members = [tuple(k for _, of_group in alike for k in of_group) for alike in kinds.values()]
        return cls(tuple(stacked), tuple(members), jnp.zeros(0, dtype))

    @property
    def varies(self) -> bool:
        """Whether some friction depends on the speed of slip."""
        return any(stacked.kind.varies for stacked in self.kinds)

    @property
    def resists(self) -> bool:
        """Whether some friction has a force without a normal force."""
        return any(stacked.kind.resists for stacked in self.kinds)

    def ask(self, name: str, *values: Float[Array, "laws"]) -> Float[Array, "laws"]:
        """The answers of a method of the laws, whose arguments have one value for each law."""
        if len(self.kinds) < 2:
            return self.kinds[0].ask(name, *values) if self.kinds else self.none
        places = [np.array(of_kind) for of_kind in self.members]
        pieces = [k.ask(name, *(x[at] for x in values)) for k, at in zip(self.kinds, places, strict=True)]
        return jnp.concatenate(pieces)[np.argsort(np.concatenate(places))]


class ContactLaws(NamedTuple):
    """The laws of contacts and dry friction at a time.

    **Fields:** the laws along the `normal` of each contact, and along the `slip` of each direction of friction;
    `peaks`: of each contact the kink of a gap that rises and falls again, infinite for other gaps.
    """

    normal: LawTable
    slip: LawTable
    peaks: Float[Array, "contacts"]


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
    - For each contact: the number of the `phases` of its impacts.
    - For each direction of friction: the index of its contact in `contact_of`, -1 in a joint; in `releases`, whether
        accelerations jump as slip begins.
    - `of_reactions`: whether some friction depends on the reaction of a joint.
    - `pairs`: for friction with two directions, the index of the first among all friction; the second follows.
    - `coupled`: whether the normal forces of friction in joints depend on friction itself, without other constraints.
    - `sharing`: what is added if contacts imply each other when all are closed, see `shared_contacts`.
    """

    names: tuple[str, ...] = ()
    rows: tuple[int, ...] = ()
    places: tuple[int, ...] = ()
    phases: tuple[int, ...] = ()
    contact_of: tuple[int, ...] = ()
    releases: tuple[bool, ...] = ()
    of_reactions: bool = False
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
        return len(self.phases)

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
