"""The contacts and the dry friction of a system: where their rows and modes are, and their gaps and slips, also where
contacts are closed and friction sticks, with their derivatives.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from .._types import Coordinates, Scalar, Velocities
from ..linalg.pairs import of_pairs
from ..linalg.sums import unchecked_take, with_entries
from ..parts.modes import CLOSED, STICK, Modes


class ContactNumbers(NamedTuple):
    """The numbers of contacts and dry friction.

    **Fields:** of contacts coefficients of `restitution`, and the `peaks` of gaps that rise to a kink and fall again,
    infinite for others; of friction, for each direction, the `coefficient` of slip, and the `limit` of stick.
    """

    restitution: Float[Array, "contacts"]
    peaks: Float[Array, "contacts"]
    coefficient: Float[Array, "frictions"]
    limit: Float[Array, "frictions"]


@dataclasses.dataclass(frozen=True)
class ContactSet:
    """The unilateral constraints of a system, gaps that stay non-negative, and its dry friction, which sticks or slips;
    without any it is false.

    Each contact has a law, and each direction of slip; contacts come first. A law has a row of A and a coordinate, its
    mode, see `parts.modes`. The row says `gap = 0` where the contact is closed, `slip = 0` where friction sticks, and
    otherwise that the mode stays what it is. So the number and the rank of rows never change, and the mode, which no
    force acts on, is a number of the state like any other. The direction of a law is that of its force: normal to a
    contact, along the slip of friction.

    **Fields:** for each law its name, the number of its row of A in `rows`, the index of its mode in q in `places`; of
    contacts whether their impacts are `by_poisson`, or by Newton's law; of friction, for each direction, the number of
    its contact in `contact_of`, -1 in a joint, and whether the coefficients of slip and of stick differ, so that
    accelerations jump where it `releases`; `pairs`: the numbers of the first directions of friction that has two, one
    after the other.
    """

    names: tuple[str, ...] = ()
    rows: tuple[int, ...] = ()
    places: tuple[int, ...] = ()
    by_poisson: tuple[bool, ...] = ()
    contact_of: tuple[int, ...] = ()
    releases: tuple[bool, ...] = ()
    pairs: tuple[int, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.names)

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
        """Which friction is that of a joint, whose normal force is the size of its reaction."""
        return np.array(self.contact_of, int) < 0

    @functools.cached_property
    def in_pairs(self) -> Bool[np.ndarray, "frictions"]:
        """Which friction has two directions."""
        return np.isin(np.arange(self.m), of_pairs(self.pairs))

    def at_rows(self, values: Float[Array, "acceleration_rows *k"]) -> Float[Array, "laws *k"]:
        """The values of the laws, from those of all rows of A."""
        return values[np.array(self.rows, int)]

    # Modes

    def modes(self, q: Coordinates) -> Modes:
        """The modes in some coordinates."""
        if not self:
            return self.as_modes(jnp.zeros(0, q.dtype))
        return Modes.of(unchecked_take(q, np.array(self.places, int)), self.n, self.pairs)

    def as_modes(self, numbers: Float[Array, "laws"]) -> Modes:
        """The modes that are numbers of modes already."""
        return Modes(numbers, self.n, self.pairs)

    def with_modes(self, q: Coordinates, modes: ArrayLike) -> Float[Array, "nq"]:
        """The coordinates with other modes, one number for each law, or one for all."""
        places = np.array(self.places, int)
        return with_entries(q, places, jnp.broadcast_to(jnp.asarray(modes, q.dtype), places.shape))

    def bound(self, q: Coordinates) -> Float[Array, "nq"]:
        """The coordinates with all contacts closed and all friction sticking."""
        return self.with_modes(q, np.repeat([CLOSED, STICK], [self.n, self.m]).astype(float))

    # Gaps and slips of a `system` that these are the contacts of

    def gaps(self, system: Any, t: Scalar, q: Coordinates) -> Float[Array, "contacts"]:
        """The gaps [m, rad], negative where bodies are inside each other."""
        if not self.n:
            return jnp.zeros(0, q.dtype)
        return _taken(system.position_residual(t, self.bound(q)), self.rows[: self.n])

    def rates(self, system: Any, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "laws"]:
        """The rates of the gaps, and the velocities of slip."""
        return _taken(system.velocity_residual(t, self.bound(q), u), self.rows)

    def accelerations(
        self, system: Any, t: Scalar, q: Coordinates, u: Velocities, udot: Float[Array, "nu"]
    ) -> Float[Array, "laws"]:
        """The second derivatives of the gaps, and the derivatives of the velocities of slip."""
        return _taken(system.acceleration_residual(t, self.bound(q), u, udot), self.rows)

    def gradients(self, system: Any, t: Scalar, q: Coordinates, u: Velocities) -> Float[Array, "laws nu"]:
        """Derivatives of the rates with respect to velocities: the rows of A of contacts that are closed, and of
        friction that sticks.
        """
        rates, pull = jax.vjp(lambda u: self.rates(system, t, q, u), u)
        return jax.vmap(lambda row: pull(row)[0])(jnp.eye(rates.size, dtype=rates.dtype))


def _taken(values, numbers):
    # Slices of rows that follow one another, so that the compiler leaves out those of other parts.
    rows = np.array(numbers, int)
    runs = np.split(rows, 1 + np.flatnonzero(np.diff(rows) != 1)) if rows.size else []
    return jnp.concatenate([*(values[run[0] : run[-1] + 1] for run in runs), values[:0]])
