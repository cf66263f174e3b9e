"""Contacts that do not hold at a state: open ones that are overlapped, and closed ones that would have to pull."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..system import AbstractSystem
from ..system.gaps import are_open, contacts_of, gaps
from ..system.instant import Instant
from .closest import tolerance


def contacts_against(
    at: Instant, multipliers: Float[Array, "rows"], alone: Bool[Array, "contacts"]
) -> tuple[Bool[Array, "contacts"], Bool[Array, "contacts"]]:
    """Which open contacts are overlapped, and which closed ones pull; of a system without contacts, none is asked.

    **Arguments:** the `multipliers` of all rows; which contacts are `alone`: of those that imply each other only the
    sum of the forces is known.
    """
    system, is_open = at.system, are_open(at.system, at.q)
    if not is_open.size:
        return is_open, is_open
    tol = tolerance(at.q.dtype) ** 0.5
    largest = jnp.max(jnp.abs(multipliers)) + jnp.max(jnp.abs(at.force))
    overlaps = is_open & (gaps(system, at.t, at.q) < -tol * system.length)
    pulls = ~is_open & alone & (multipliers[np.array(contacts_of(system).rows, int)] < -tol * largest)
    return overlaps, pulls


def about_contacts(what: str, system: AbstractSystem, overlapped: Array, pulled: Array) -> tuple[str, str]:
    """That `what` is found only where contacts do not hold, and what to fix instead, as an argument of a call."""
    names, overlaps, pulls = np.array(contacts_of(system).names), np.asarray(overlapped), np.asarray(pulled)
    texts = []
    if np.any(overlaps):
        own = names[overlaps]
        texts.append(f"{', '.join(own)} {'is' if own.size == 1 else 'are'} open and overlapped: close with mode 1")
    if np.any(pulls):
        texts.append(f"{', '.join(names[pulls])} would have to pull: open with mode 0")
    against = overlaps | pulls
    fix = f"fix={{'{names[against][0]}.mode': {int(overlaps[against][0])}}}"
    return f"{what} only where contacts do not hold: {'; '.join(texts)}. ", fix
