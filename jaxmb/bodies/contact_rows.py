"""Places of contacts and dry friction in a scene: their rows of A, and their modes in q."""

from collections.abc import Sequence
from typing import Any

from ..contacts.shares import Sharing
from ..system.contact_set import ContactSet
from ..system.sharing import NoSharing
from .groups import AbstractConstraintGroup, ConstraintGroup


def contact_set(
    constraints: Sequence[ConstraintGroup], velocity_constraints: Sequence[Any], shares: bool
) -> ContactSet:
    """The contacts among the groups of position constraints, and the dry friction among the velocity constraints;
    `shares`: whether contacts imply each other, see `ContactSet.sharing`.
    """
    contacts = [g for g in constraints if g.is_contact]
    frictions = [g for g in velocity_constraints if g.is_friction]
    if not contacts and not frictions:
        return ContactSet()
    first_row, rows = {}, 0
    for g in (*constraints, *velocity_constraints):
        first_row[id(g)] = rows
        rows += _count(g)
    names = [name for g in contacts for name in g.group.names]
    contact_of, pairs = [], []
    for g in frictions:
        pairs += range(len(contact_of), len(contact_of) + _count(g), 2) if g.group.part.directions == 2 else ()
        contact_of += [names.index(name) if name in names else -1 for name in g.joints for _ in range(g.rows)]
    laws = (*contacts, *frictions)
    return ContactSet(
        names=tuple(name for g in laws for name in _names(g)),
        rows=tuple(first_row[id(g)] + k for g in laws for k in range(_count(g))),
        places=tuple(place for g in laws for place in _places(g)),
        phases=tuple(g.group.part.contact_law.phases for g in contacts for _ in g.group.names),
        contact_of=tuple(contact_of),
        releases=tuple(g.group.part.contact_law.jumps for g in frictions for _ in range(_count(g))),
        pairs=tuple(pairs),
        of_reactions=any(g.law.needs in ("wrenches", "multipliers") for g in frictions),
        coupled=any(g.group.part.coupled for g in frictions),
        sharing=Sharing() if shares else NoSharing(),
    )


def _names(group: AbstractConstraintGroup) -> list[str]:
    """The names of the rows; those of several slips of one part are the names of their modes."""
    several = not group.of_poses and group.rows > group.group.part.directions
    of_rows = (lambda name, k: f"{name}.mode_{k + 1}") if several else (lambda name, k: name)
    return [of_rows(name, k) for name in group.group.names for k in range(group.rows)]


def _count(group: AbstractConstraintGroup) -> int:
    return len(group.group.names) * group.rows


def _places(group: AbstractConstraintGroup) -> list[int]:
    """Indices in q of the modes of stacked parts; each part has a mode for each row, after its bodies."""
    modes = group.group.body_index[:, -group.rows :].reshape(-1)
    return group.group.layout.pose_index[modes, 0].tolist()
