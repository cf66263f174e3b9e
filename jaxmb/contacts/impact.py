"""Impacts, loss of contact, stick and slip: the state after an event of contacts and dry friction.

In an impact the impulses `Λ ≥ 0` of all touching contacts change the velocities, `M (u⁺ − u⁻) = Aᵀ Λ`. By Newton's law
a gap that closed at a rate v opens at least at `restitution` times v; if it opens faster its impulse is zero. By
Poisson's law an impact has two phases. At the end of compression no gap closes any more. In the expansion each contact
pushes `restitution` times as much again, or more if its gap would close.

With friction, Λ includes the impulses along slips. In each phase they are at most `coefficient` times the contact's
impulse, and oppose the slip at the end of the phase. Contacts that do not open then stay closed if their forces push:
`λ ≥ 0`, the second derivative of the gap `≥ 0`, and one of them zero. Friction whose slip has ended sticks as long as
its force is within its limit. These are linear complementarity problems, under the permanent constraints.

Sources: J. J. Moreau, "Unilateral contact and dry friction in finite freedom dynamics", in: Nonsmooth Mechanics and
Applications, Springer, 1988; Ch. Glocker, "Set-Valued Force Laws", Springer, 2001; for Poisson's law F. Pfeiffer and
Ch. Glocker, "Multibody Dynamics with Unilateral Contacts", Wiley, 1996, chapter 8. The derivative of the state after an
event by the state before it is the saltation matrix: P. C. Müller, "Calculation of Lyapunov exponents for dynamic
systems with discontinuities", Chaos, Solitons & Fractals 5, 1995.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Scalar, State
from ..formulations import AbstractFormulation
from ..linalg.pairs import of_pairs
from ..linalg.pushed import filled, push
from ..linalg.sums import with_entries
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .forces import contact_forces, largest_force, reserves
from .groups import HOLDS, least_in_group
from .impacting import Event, find_event
from .phases import MovingFrame, Phases
from .tolerance import ContactTolerance

NO_SECOND_DERIVATIVES = (
    "Second derivatives through impacts are not supported: their times and states have first derivatives only."
)

# An event is found to this fraction of its time, or better.
_AT_ONCE = 1e-10


class Impact(NamedTuple):
    """An event of contacts. In lists of contacts and friction, contacts come first.

    **Fields:** the state `after` it, at the requested time; `late`: the time from then to the event; `impulses` of
    contacts and friction; `modes` before and after it; `rest`: the time from the event until the last of infinitely
    many omitted bounces, zero for contacts without any; the `energy` lost; whether it is `solvable`.
    """

    after: State
    late: Float[Array, ""]
    impulses: Float[Array, "laws"]
    modes: tuple[Float[Array, "laws"], Float[Array, "laws"]]
    rest: Float[Array, "contacts"]
    energy: Float[Array, ""]
    solvable: Bool[Array, ""]


@eqx.filter_jit
def impact(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    tolerance: ContactTolerance,
    t: Scalar,
    y: State,
    dated: bool = False,
    given: Event | None = None,
) -> Impact:
    """The event of contacts that are about to close, or to open, at a state.

    The first gap that closes is zero after a small time τ. The state moves on by τ, changes, and moves back by τ with
    the new equations. So the state after the event is right to second order in τ, and its derivative includes the
    dependence of the event's time on the state. Groups of contacts that do not act on each other have derivatives of
    times of their own. `late`, `impulses` and the `energy` have derivatives as well, `rest` has none. There is no
    second derivative.

    **Arguments:** `system`: with the internal states of `y`; `dated`: whether `late` has its derivative even if the
    state after the event does not depend on it, as when a contact opens; `given`: the event, if it is known.
    """
    t, touch = jnp.asarray(t, y.q.dtype), jnp.asarray(tolerance.touch, y.q.dtype)
    given = find_event(system, formulation, tolerance, t, y) if given is None else given
    after, event = _impact(system, t, y, given, ContactTolerance(touch), dated)
    old, new = (system.contacts.as_modes(numbers).kinds for numbers in event.modes)
    return Impact(after, event.late, event.impulses, (old, new), event.rest, event.energy, event.solvable)


@eqx.filter_custom_jvp
def _impact(system, t, y, event, tolerance, dated):
    del tolerance, dated
    q = system.contacts.with_modes(y.q, event.modes[1])
    # The state moves on before the event, and back after it, each at the mean velocity.
    before = system.rates(t, y.q, event.at - 0.5 * event.late * event.before)
    after = system.rates(t, q, event.u - 0.5 * event.late * event.after)
    z = y.z
    if z is not None:
        z = z + event.late * (system.state_rates(t, y.q, event.at) - system.state_rates(t, q, event.u))
    # Without a solution the motion ends here, at infinite velocities, or NaN if the forces are NaN.
    nowhere = jnp.where(jnp.all(jnp.isfinite(event.before)), jnp.inf, jnp.nan)
    u = jnp.where(event.solvable, event.u - event.late * event.after, nowhere)
    return State(q + event.late * (before - after), u, z), event


@_impact.def_jvp
def _impact_jvp(primals, tangents):
    system, t, y, _, tolerance, dated = primals
    dsystem, dt, dy, *_ = tangents
    after, event = _impact(*primals)
    system, t, y, event = _without_second_derivative((system, t, y, event))
    contacts = system.contacts
    dq, du, dt = filled(y.q, dy.q), filled(y.u, dy.u), filled(t, dt)

    # The time of the event changes, and with it the time and the state there, by the equations before it.
    frame = MovingFrame.of((system, t, y.q), (dsystem, dt, dq))
    dlate = _later(event, Instant(system, t, y.q, event.at), frame, (y.u, du))
    if dated or any(contacts.releases):
        dlate = dlate + _release(system, tolerance, event, (t, y), (dsystem, dt, dy))
    dz = filled(y.z, dy.z)
    change = _together if event.group is None else _apart
    dafter, late, impulses, energy = change(system, t, y, event, dlate, frame, (dsystem, dt, dq, du, dz))
    dq = jnp.where(np.isin(np.arange(system.nq), contacts.places), 0.0, dafter.q)
    devent = jax.tree.map(lambda _: None, event)._replace(late=late, impulses=impulses, energy=energy)
    return (after, event), (State(dq, dafter.u, dafter.z), devent)


def _together(system, t, y, event: Event, dlate, frame: MovingFrame, along):
    """The tangents of the state after the event, of its time, of its impulses and of the energy lost, if all laws are
    in one group, with one time.
    """
    dsystem, dt, dq, du, dz = along
    q = system.contacts.with_modes(y.q, event.modes[1])
    rates = system.rates(t, y.q, event.at), system.rates(t, q, event.u)
    frame = frame.later(_in_time(system, t, y.q, rates[0])[1], dlate)
    dq, du, dt = dq + dlate * rates[0], du + dlate * event.before, dt + dlate
    impulses, change, energy = _struck(Phases.of(event, (system, t, y.q), (dsystem, dt, dq), du, frame))
    if dz is not None:
        dz = dz + dlate * (system.state_rates(t, y.q, event.at) - system.state_rates(t, q, event.u))
    return State(dq - dlate * rates[1], change - dlate * event.after, dz), dlate, impulses, energy


def _in_time(system, t, q, rates):
    """The tangents of system, t and q in time, and the frame with its tangent along these."""
    onwards = jax.tree.map(lambda _: None, system), jnp.ones_like(t), rates
    return onwards, MovingFrame.of((system, t, q), onwards)


def _apart(system, t, y, event: Event, dlate, frame: MovingFrame, along):
    """The same for several groups, each with its own time."""
    dsystem, dt, dq, du, dz = along
    heads = system.contacts.heads
    phases = Phases.of(event, (system, t, y.q), (dsystem, dt, dq), du, frame)
    impulses, change, energy = _struck(phases)
    # A group with a zero comes before a group whose modes change.
    before, after = (system.contacts.as_modes(numbers).kinds for numbers in event.modes)
    _, changes = least_in_group(event.group, before != after, before)
    rank = jnp.where(event.hits, 2, jnp.where(changes & (event.group != HOLDS), 1, 0))
    by_time = _by_times(phases, y, rank > 0)
    dlate = dlate[heads]
    sums = jax.tree.map(lambda x, of_times: x + dlate @ of_times, (State(dq, change, dz), impulses, energy), by_time)
    # The time of the event is the time of its first group.
    return sums[0], dlate[jnp.argmax(rank[heads])], *sums[1:]


def _by_times(phases: Phases, y, acts):
    """The derivatives of the state after the event, of its impulses and of the energy lost by the time of each group,
    zero for groups none of whose laws `acts`. The equations of motion change group by group.
    """
    event, (system, t, _), (before, after) = phases.event, phases.at, phases.event.modes
    assert event.group is not None
    heads, leads = jnp.asarray(system.contacts.heads), acts & (event.group == jnp.arange(acts.size))
    order, count = jnp.argsort(~leads[heads], stable=True), jnp.sum(leads)
    rates = Instant(system, t, y.q, event.at, y.z).motion(event.before)
    onwards, in_time = _in_time(system, t, y.q, rates.q)

    def advance(k, carry):
        (u, modes), rates, table = carry
        head = heads[order[k]]
        own = phases.of_group(event.group == head, onwards, event.before, in_time)
        impulses, change, energy = _struck(own)
        u, modes = u + (own.event.u - event.at), jnp.where(event.group == head, after, modes)
        q = system.contacts.with_modes(y.q, modes)
        at = Instant(system, t, q, u, y.z)
        new = at.motion(contact_forces(at)[0])
        left = jax.tree.map(lambda old, new: old - new, rates, new)
        row = State(left.q, change - event.before + left.u, left.z), impulses, energy
        return (u, modes), new, jax.tree.map(lambda table, x: table.at[order[k]].set(x), table, row)

    start = event.u - phases.alone(acts, event.impulses, event.held) @ phases.moves
    row = rates, event.impulses, event.energy
    table = jax.tree.map(lambda x: jnp.zeros((heads.size, *x.shape), x.dtype), row)
    # A loop over the groups that act, since it is mostly one.
    carry = (start, jnp.where(acts, before, after)), rates, table
    return lax.fori_loop(0, count, advance, carry)[2]


def _struck(phases: Phases):
    """The derivatives of the impulses of an impact, of the velocities after it, and of the energy lost."""
    event, at, along = phases.event, phases.at, phases.tangents
    impulses, change = phases.changes()
    kinetic = lambda system, t, q, u: 0.5 * jnp.dot(u, system.inertia(t, q, u).product(u))
    energy = push(kinetic, (*at, event.at), (*along, phases.du)) - push(kinetic, (*at, event.u), (*along, change))
    return impulses, change, energy


def _later(event: Event, at: Instant, frame: MovingFrame, velocities):
    """The derivative of the time at which a gap, or a slip, is zero; with groups for each law.

    **Arguments:** `at`: the instant before the event; the `velocities` at the time, and their tangent.
    """
    contacts, n = at.system.contacts, at.system.contacts.n
    zero, rate = frame.change.gaps, frame.here.rates(at.u)[:n]
    if contacts.m:
        slip, slowing = frame.change_of_rates(*velocities)[n:], at.contact_accelerations(event.before)[n:]
        both = of_pairs(contacts.pairs)
        if both.size:
            # Slip in two directions ends when it is zero along its modes.
            modes = contacts.as_modes(event.modes[0]).of_friction[both]
            slip = with_entries(slip, both[:, 0], jnp.sum(modes * slip[both], axis=1))
            slowing = with_entries(slowing, both[:, 0], jnp.sum(modes * slowing[both], axis=1))
        zero, rate = jnp.concatenate([zero, slip]), jnp.concatenate([rate, slowing])
    return jnp.where(event.hits, -zero[event.first] / jnp.where(event.hits, rate[event.first], 1.0), 0.0)


def _release(system, tolerance, event, at, along):
    """The derivative of the time at which a force reaches its limit: zero for a contact that opens, the limit of
    sticking for friction that begins to slip; with groups for each law.
    """
    (t, y), (dsystem, dt, dy), contacts = at, along, system.contacts
    before, after = map(contacts.as_modes, event.modes)
    released = jnp.concatenate([before.closed & after.open, before.sticks & ~after.sticks])

    def reserve(system, t, y):
        """The reserves of the forces below their limits, and their size of comparison."""
        at = Instant(system, t, y.q, y.u)
        _, multipliers = contact_forces(at)
        return contacts.sharing.reserves(at, multipliers, reserves), largest_force(at, multipliers)

    reserve_at_event, largest = reserve(system, t, y)
    k, releases = least_in_group(event.group, released, jnp.abs(reserve_at_event))
    least = lambda system, t, y: reserve(system, t, y)[0][k]
    motion = Instant(system, t, y.q, y.u, y.z).motion(event.before)
    value = push(least, (system, t, y), (dsystem, dt, dy))
    rate = eqx.filter_jvp(lambda t, y: least(system, t, y), (t, y), (jnp.ones_like(t), motion))[1]
    # A contact that an impact opens, or sets in motion, is not at its limit before. Balanced forces may leave no size
    # of comparison: then the time to the limit is compared with the time.
    is_zero = jnp.abs(reserve_at_event[k]) <= jnp.maximum(tolerance.near * largest, _AT_ONCE * jnp.abs(rate * t))
    at_limit = releases & ~event.hits & is_zero & (rate < 0)
    return jnp.where(at_limit, -value / jnp.where(at_limit, rate, 1.0), 0.0)


@eqx.filter_custom_jvp
def _without_second_derivative(x):
    return x


@_without_second_derivative.def_jvp
def _without_jvp(primals, tangents):
    raise ValueError(NO_SECOND_DERIVATIVES)
