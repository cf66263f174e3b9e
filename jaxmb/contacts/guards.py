"""When events of contacts and dry friction happen: gaps, forces and slips that become zero along a motion."""

import jax.numpy as jnp
from jax import lax

from .._branches import cond_of_any_lane
from .._types import Scalar, State
from ..formulations import AbstractFormulation
from ..linalg.pairs import for_first, of_pairs, placed_pairs
from ..linalg.rotations import norm
from ..parts.modes import BEGUN
from ..solvers.manifold_term import AbstractGuards, GuardsSeen
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .forces import contact_forces, largest_force, reserves
from .impact import Impact, impact
from .impacting import Event, find_event
from .tolerance import REST, ContactTolerance

# Slip in two directions that begins has the direction of its modes up to this multiple of the slow velocity.
_SEEN = 4
# Rates of gaps below this many units in the last place of the largest velocity are zero.
_RATE = 64


class ContactGuards(AbstractGuards):
    """The guards of contacts and dry friction. Gaps of open contacts are in units of the system's size, slips in this
    unit per second; forces of closed contacts and reserves of sticking friction are relative to the largest forces.

    A gap g with a kink at its peak p counts as g (1 - g / 2p), which is smooth and the same near zero.
    """

    system: AbstractEquation
    formulation: AbstractFormulation
    tolerance: ContactTolerance

    @property
    def touch(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.tolerance.touch

    @property
    def near(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.tolerance.near

    def seen(self, t, y):
        system, y = lax.stop_gradient((self.system, y))
        contacts, t = system.contacts, jnp.asarray(t, y.q.dtype)
        q = system.normalize(t, y.q)
        at, modes = Instant(system.at(y), t, q, y.u), contacts.modes(q)
        gaps, rates = at.contact_place.gaps, at.contact_motion.rates
        closing, slips = rates[: contacts.n], modes.of_friction * rates[contacts.n :]
        peaks, touch = at.contact_laws.peaks, self.touch * system.length
        free = jnp.where(modes.open, gaps * (1 - 0.5 * gaps / peaks), system.length)
        free = contacts.sharing.guarded(at, gaps, self.tolerance, free)
        begins = modes.open & (gaps <= touch)
        if contacts.m:
            slides = jnp.where(modes.slides, slips, system.length)
            free = jnp.concatenate([free, self._in_plane(slides, modes, rates[contacts.n :], y.u)])
            sets_in = modes.slides & (slips <= touch)
            if contacts.pairs:
                sets_in = for_first(contacts.pairs, modes.in_plane.begun, sets_in)
            begins = jnp.concatenate([begins, sets_in])
        closing = closing * (1 - gaps / peaks) / system.length
        # The rates of bodies that move side by side are rounding errors, and close nothing.
        least = _RATE * jnp.finfo(closing.dtype).eps * jnp.max(jnp.abs(y.u) / system.velocity_scale())
        closing = jnp.where(jnp.abs(closing) > least, closing, 0.0)
        closing = jnp.where(modes.open, closing, jnp.inf)
        closing = jnp.pad(closing, (0, contacts.m), constant_values=jnp.inf)
        return GuardsSeen(self._with_forces(at, self.forces(y), free / system.length), closing, begins)

    def _with_forces(self, at, acts, free):
        """The guards, from those of contacts and friction without a force; `acts`: the others."""

        def forces(_):
            _, multipliers = contact_forces(at)
            reserve = at.system.contacts.sharing.reserves(at, multipliers, reserves)
            return reserve / largest_force(at, multipliers)

        return jnp.where(acts, cond_of_any_lane(jnp.any(acts), forces, jnp.ones_like, free), free)

    def _in_plane(self, slips, modes, rates, u):
        """The slips, with guards for slip in two directions: it has neither turned by more than 60 degrees from its
        modes nor become slow. Slip that has just begun is neither back at rest nor fast enough to be followed.
        """
        system, pairs = self.system, modes.pairs
        if not pairs:
            return slips
        in_plane, rates = modes.in_plane, rates[of_pairs(pairs)]
        slow, speed = self.tolerance.in_metres(system).slow(system, u), norm(rates)
        along, begun, slides = jnp.sum(in_plane.modes * rates, axis=1), in_plane.begun, in_plane.slides
        turned = jnp.where(begun, along / BEGUN, jnp.where(slides, along - 0.5 * speed, system.length))
        fast = jnp.where(begun, _SEEN * slow - speed, jnp.where(slides, speed - slow, system.length))
        return placed_pairs(pairs, jnp.stack([turned, fast], axis=1), slips)

    def event(self, t: Scalar, y: State) -> Event:
        """The numbers of the event at a state, without derivatives."""
        return find_event(self.system.at(y), self.formulation, self.tolerance, t, y)

    def impact(self, t: Scalar, y: State, dated: bool = False, event: Event | None = None) -> Impact:
        """The event at a state; see `impact`."""
        return impact(self.system.at(y), self.formulation, self.tolerance, t, y, dated, event)

    def changed(self, before, after):
        system, before, after = lax.stop_gradient((self.system, before, after))
        kinds = lambda y: system.contacts.modes(y.q).kinds
        # Without impulses, velocities change by rounding errors.
        scale, change = system.velocity_scale(), jnp.abs(after.u - before.u)
        sizes = jnp.abs(after.u) + jnp.abs(before.u)
        least = REST * sizes + _RATE * jnp.finfo(sizes.dtype).eps * jnp.max(sizes / scale) * scale
        return jnp.any(kinds(before) != kinds(after)) | ~jnp.all(change <= least)

    def forces(self, y):
        modes = self.system.contacts.modes(y.q)
        return jnp.concatenate([modes.closed, modes.held])


def contact_guards(
    system: AbstractEquation, formulation: AbstractFormulation, tolerance: ContactTolerance
) -> ContactGuards | None:
    """The guards of a system's contacts, None without any."""
    return ContactGuards(system, formulation, tolerance) if system.contacts else None
