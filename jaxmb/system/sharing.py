"""What closed contacts that imply each other add to the laws of contacts and dry friction: the interface."""

import dataclasses
from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Bool, Float

from .._types import State
from ..parts.modes import Modes


@dataclasses.dataclass(frozen=True)
class NoSharing:
    """Contacts that do not imply each other: each force is determined, and nothing is added.

    `contacts.shares.Sharing` is for the others.
    """

    def shut(self, modes: Modes, gap: Float[Array, "n"], near: Float[Array, ""]) -> Bool[Array, "n"]:
        """The contacts that are shut; `near`: gaps at which a step ends that was meant to end at an event [m, rad]."""
        del gap, near
        return modes.shut

    def guarded(self, at: Any, gap: Float[Array, "n"], tolerance: Any, values: Float[Array, "n"]) -> Float[Array, "n"]:
        """The guards of contacts without a force at an instant [m, rad], with those of contacts that others imply."""
        del at, gap, tolerance
        return values

    def reserves(self, at: Any, multipliers: Float[Array, "m"], reserves: Callable[..., Any]) -> Float[Array, "laws"]:
        """The forces of contacts, and the reserve of friction that sticks, at an instant.

        **Arguments:** `reserves`: these as a function of the system, time, coordinates, velocities and multipliers.
        """
        return reserves(at, multipliers)

    def determined(self, laws: Any, settled: Any, implied: Bool[Array, "n"], slow: Float[Array, ""]) -> Any:
        """Whether slip after an event is the same for all shares of the forces of contacts; `slow`: see `Impacting`."""
        del laws, settled, implied, slow
        return True

    def multipliers(self, at: Any, multipliers: Float[Array, "m"]) -> Float[Array, "m"]:
        """Multipliers at an instant in which implied contacts have their shares of the forces."""
        del at
        return multipliers

    def bearing(self, contacts: Any, ys: State) -> State:
        """States in which implied contacts bear forces as other closed contacts do."""
        del contacts
        return ys

    def where_stuck(self, contacts: Any) -> str:
        """What to say of contacts and friction if a run got stuck."""
        del contacts
        return ""

    def about(self) -> str:
        """What to say of contacts with friction for which no motion was found."""
        return ""
