"""When events of contacts and dry friction are: gaps, forces and slips that become zero along a motion."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._compat import cond_of_any_lane
from .._types import Scalar, State
from ..formulations import AbstractFormulation
from ..linalg.complementarity import of_pairs, placed_pairs
from ..linalg.rotations import norm
from ..solvers import AbstractGuards
from ..system import AbstractEquation
from ..system.gaps import (
    BEGUN,
    CLOSED,
    FORWARD,
    OPEN,
    STICK,
    contacts_of,
    counts,
    direction_rates,
    direction_rows,
    frictions_of,
    gaps,
    kinds_of,
    modes_of,
    pairs_of,
)
from .contact_forces import contact_forces, largest_force, slow_slip, stick_reserve
from .contact_laws import REST
from .impact import Impact, impact
from .impact_event import NEAR, Event, find_event
from .impulse import after_impulse

# Slip in two directions that begins has the direction of its modes up to this multiple of what is slow.
_SEEN = 4
# Rates of gaps are zero below this many units in the last place of the largest velocity.
_RATE = 64
# Modes of slip are longer than this, and those of slip that has begun shorter.
_HALFWAY = 0.75


class ContactGuards(AbstractGuards):
    """The gaps of open contacts, in units of the system's size, and the forces of closed ones, relative to the largest
    forces; slips in units of the size per second, and what the forces of stick are below their limits.

    A gap g with a kink at its peak p counts as g (1 - g / 2p), which is smooth and the same near zero.
    """

    system: AbstractEquation
    formulation: AbstractFormulation
    touch: Float[Array, ""]

    @property
    def near(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return NEAR * self.touch

    def values(self, t, y):
        system, y = lax.stop_gradient((self.system, y))
        q = system.normalize(y.q)
        t, (n, _) = jnp.asarray(t, q.dtype), counts(system)
        modes = modes_of(system, q)
        gap = gaps(system, t, q)
        free = jnp.where(modes[:n] == OPEN, gap * (1 - 0.5 * gap / contacts_of(system).peaks), system.length)
        frictions = contacts_of(system).frictions
        acts = self.forces(y)
        if frictions is not None:
            rates = direction_rates(system, t, q, y.u)
            slips, slip = jnp.abs(modes[n:]) == FORWARD, modes[n:] * rates[n:]
            free = jnp.concatenate([free, jnp.where(slips, slip, system.length)])
            free = self._of_pairs(free, modes, rates, y.u)

        def forces(_):
            own = system.at(y)
            _, multipliers = contact_forces(own, t, q, y.u)
            largest = largest_force(own, t, dataclasses.replace(y, q=q), multipliers)
            taken = multipliers[np.array(direction_rows(system))]
            if frictions is not None:
                taken = jnp.concatenate([taken[:n], stick_reserve(own, t, q, y.u, multipliers)])
            return taken / largest

        held = cond_of_any_lane(jnp.any(acts), forces, jnp.ones_like, free)
        return jnp.where(acts, held, free / system.length)

    def _of_pairs(self, free, modes, rates, u):
        """With the guards of slip in two directions: that it has not turned by more than 60 degrees from its modes, nor
        is slow; where it has begun, that it is neither back at rest nor faster.
        """
        own = pairs_of(self.system)
        if not own.size:
            return free
        length = self.system.length
        slow, size, speed = slow_slip(self.system, self.touch * length, u), norm(modes[own]), norm(rates[own])
        along = jnp.sum(modes[own] * rates[own], axis=1)
        has_begun, slides = (size > 0) & (size < _HALFWAY), (size > _HALFWAY) & (size < STICK)
        turned = jnp.where(has_begun, along / BEGUN, jnp.where(slides, along - 0.5 * speed, length))
        fast = jnp.where(has_begun, _SEEN * slow - speed, jnp.where(slides, speed - slow, length))
        n, pairs = counts(self.system)[0], frictions_of(self.system).pairs
        return jnp.concatenate([free[:n], placed_pairs(pairs, jnp.stack([turned, fast], axis=1), free[n:])])

    def event(self, t: Scalar, y: State) -> Event:
        """The numbers of the event at a state, without derivatives."""
        return find_event(self.system.at(y), self.formulation, self.touch, t, y)

    def impact(self, t: Scalar, y: State, dated: bool = False, found: Event | None = None) -> Impact:
        """The event at a state; see `impact`."""
        return impact(self.system.at(y), self.formulation, self.touch, t, y, dated, found)

    def changed(self, before, after):
        system, before, after = lax.stop_gradient((self.system, before, after))
        kinds = lambda y: kinds_of(system, modes_of(system, system.normalize(y.q)))
        # Velocities change by rounding errors where impulses are none.
        scale, change = system.velocity_scale(), jnp.abs(after.u - before.u)
        sizes = jnp.abs(after.u) + jnp.abs(before.u)
        least = REST * sizes + _RATE * jnp.finfo(sizes.dtype).eps * jnp.max(sizes / scale) * scale
        return jnp.any(kinds(before) != kinds(after)) | ~jnp.all(change <= least)

    def forces(self, y):
        modes, (n, _) = modes_of(self.system, self.system.normalize(y.q)), counts(self.system)
        return jnp.concatenate([modes[:n] == CLOSED, modes[n:] >= STICK])

    def begins(self, t, y):
        system, y = lax.stop_gradient((self.system, y))
        if contacts_of(system).frictions is None:
            return None
        q, (n, _) = system.normalize(y.q), counts(system)
        modes, rates = modes_of(system, q)[n:], direction_rates(system, jnp.asarray(t, q.dtype), q, y.u)[n:]
        begins = (jnp.abs(modes) == FORWARD) & (modes * rates <= self.touch * system.length)
        pairs = frictions_of(system).pairs
        if pairs:
            size = norm(modes[of_pairs(pairs)])
            has_begun = (size > 0) & (size < _HALFWAY)
            begins = placed_pairs(pairs, jnp.stack([has_begun, jnp.zeros_like(has_begun)], axis=1), begins)
        return jnp.pad(begins, (n, 0))

    def rates(self, t, y):
        system, y = lax.stop_gradient((self.system, y))
        q, (n, m) = system.normalize(y.q), counts(system)
        t = jnp.asarray(t, q.dtype)
        slopes = 1 - gaps(system, t, q) / contacts_of(system).peaks
        rates = direction_rates(system, t, q, y.u)[:n] * slopes / system.length
        # Of bodies that move side by side rates are rounding errors, at which nothing closes.
        least = _RATE * jnp.finfo(rates.dtype).eps * jnp.max(jnp.abs(y.u) / system.velocity_scale())
        rates = jnp.where(jnp.abs(rates) > least, rates, 0.0)
        return jnp.pad(jnp.where(modes_of(system, q)[:n] == OPEN, rates, jnp.inf), (0, m), constant_values=jnp.inf)


def contact_guards(
    system: AbstractEquation, formulation: AbstractFormulation, touch: Float[Array, ""] | None
) -> ContactGuards | None:
    """The guards of a system's contacts, of which gaps up to `touch` count as closed; None without any."""
    return None if system.contacts is None or touch is None else ContactGuards(system, formulation, touch)


def found_at_jump(term: Any, t: Scalar, y: State) -> Event | None:
    """The event of contacts that close or open at a jump, of a term with `guards`; None without them."""
    return None if term.guards is None else term.guards.event(t, y)


def after_jump(term: Any, t: Scalar, y: State, found: Event | None) -> State:
    """The state after prescribed rates have jumped, or contacts closed or opened, of a term with `system`,
    `formulation` and `guards`.
    """
    if term.guards is None:
        return after_impulse(term.system, t, y)
    return term.guards.impact(t, y, found=found).after
