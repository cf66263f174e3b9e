"""Contacts that do not hold at a state: open contacts that are overlapped, and closed contacts that would pull."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..system import AbstractSystem
from ..system.instant import Instant
from .closest import tolerance


def contacts_against(
    at: Instant, multipliers: Float[Array, "rows"], alone: Bool[Array, "contacts"]
) -> tuple[Bool[Array, "contacts"], Bool[Array, "contacts"]]:
    """Which open contacts are overlapped, and which closed contacts pull.

    **Arguments:** the `multipliers` of all rows; `alone`: which contacts have a determinate force, since of contacts
    that imply each other only the sum of the forces is determinate.
    """
    contacts, is_open = at.system.contacts, at.system.contacts.modes(at.q).open
    if not is_open.size:
        return is_open, is_open
    tol = tolerance(at.q.dtype) ** 0.5
    largest = jnp.max(jnp.abs(multipliers)) + jnp.max(jnp.abs(at.force))
    overlaps = is_open & (at.gaps < -tol * at.system.length)
    pulls = ~is_open & alone & (contacts.at_rows(multipliers)[: contacts.n] < -tol * largest)
    return overlaps, pulls


def about_contacts(what: str, system: AbstractSystem, overlapped: Array, pulled: Array) -> tuple[str, str]:
    """A message that `what` is found only with contacts that do not hold; and the cure, as an argument `fix=`."""
    names, overlaps, pulls = np.array(system.contacts.contact_names), np.asarray(overlapped), np.asarray(pulled)
    texts = []
    if np.any(overlaps):
        open_names = names[overlaps]
        texts.append(
            f"{', '.join(open_names)} {'is' if open_names.size == 1 else 'are'} open and overlapped: close with mode 1"
        )
    if np.any(pulls):
        texts.append(f"{', '.join(names[pulls])} would have to pull: open with mode 0")
    against = overlaps | pulls
    fix = f"fix={{'{names[against][0]}.mode': {int(overlaps[against][0])}}}"
    return f"{what} only where contacts do not hold: {'; '.join(texts)}. ", fix
