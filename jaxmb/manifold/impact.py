"""Impacts, loss of contact, stick and slip: the state after an event of contacts and dry friction.

In an impact the impulses `Λ ≥ 0` of all contacts that touch change the velocities, `M (u⁺ − u⁻) = Aᵀ Λ`. By Newton's
law a gap that closed at a rate v opens at least at `restitution` times v; where it opens faster its impulse is zero. By
Poisson's law an impact has two phases: at the end of compression no gap closes any more, and in the expansion each
contact pushes `restitution` times as much again, or more where its gap would close. With friction Λ is that along slips
as well, in each phase at most `coefficient` times that of the contact, and against the slip that remains at its end.
Contacts that do not open then stay closed where their forces push: `λ ≥ 0`, the second derivative of the gap `≥ 0`, and
one of them zero; friction where slip has ended sticks as long as its force is within its limit. These are linear
complementarity problems, over the constraints that are always there.

Sources: J. J. Moreau, "Unilateral contact and dry friction in finite freedom dynamics", in: Nonsmooth Mechanics and
Applications, Springer, 1988; Ch. Glocker, "Set-Valued Force Laws", Springer, 2001; for Poisson's law F. Pfeiffer and
Ch. Glocker, "Multibody Dynamics with Unilateral Contacts", Wiley, 1996, chapter 8. The derivative of the state after an
event by that before it is the saltation matrix: P. C. Müller, "Calculation of Lyapunov exponents for dynamic systems
with discontinuities", Chaos, Solitons & Fractals 5, 1995.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._types import Scalar, State
from ..formulations import AbstractFormulation
from ..linalg.complementarity import of_pairs
from ..linalg.elimination import solve
from ..linalg.rotations import norm
from ..linalg.sums import with_entries
from ..system import AbstractEquation
from ..system.gaps import (
    CLOSED,
    OPEN,
    STICK,
    bound,
    contacts_of,
    counts,
    direction_accelerations,
    direction_rates,
    direction_rows,
    frictions_of,
    gaps,
    kinds_of,
    mode_places,
    with_modes,
)
from ..system.instant import Instant
from .constraints import dense, push
from .contact_forces import contact_forces, directions, friction_coefficients, largest_force, stick_reserve
from .impact_event import NEAR, Event, Phase, find_event

NO_SECOND_DERIVATIVES = (
    "Second derivatives through impacts are not supported: their times and states have first derivatives only."
)

# An event is found to this fraction of its time, and more exactly.
_AT_ONCE = 1e-10


class Impact(NamedTuple):
    """An event of contacts.

    Where contacts and friction are listed together, contacts come first.

    **Fields:** the state `after` it, at the time that was asked for; the event is `late` after that; `impulses` of
    contacts and friction; `modes` before and after it; `rest`: the time from the event until the last of infinitely
    many bounces that are left out, zero for contacts without any; the `energy` lost; whether it is `solvable`.
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
    touch: Scalar,
    t: Scalar,
    y: State,
    dated: bool = False,
    found: Event | None = None,
) -> Impact:
    """The event of contacts that are about to close, or to open, at a state.

    The first gap that closes is zero later by a small time τ. The state moves on by τ, changes, and moves back by τ
    with the new equations. So the state after it is right to the second power of τ, and the derivative is that of a
    motion whose event time depends on the state. `late`, `impulses` and the `energy` have derivatives as well, `rest`
    has none. There is no second derivative.

    **Arguments:** `system`: with the internal states of `y`; `touch`: gaps down to minus this, in units of the system's
    size, count as zero; `dated`: whether `late` has its derivative also where the state after the event does not depend
    on it, as where a contact opens; `found`: the event, where it is known.
    """
    t = jnp.asarray(t, y.q.dtype)
    found = find_event(system, formulation, touch, t, y) if found is None else found
    after, event = _impact(system, t, y, found, jnp.asarray(touch, y.q.dtype), dated)
    modes = kinds_of(system, event.modes[0]), kinds_of(system, event.modes[1])
    return Impact(after, event.late, event.impulses, modes, event.rest, event.energy, event.solvable)


@eqx.filter_custom_jvp
def _impact(system, t, y, event, touch, dated):
    del touch, dated
    q = with_modes(system, y.q, event.modes[1])
    # The state moves on before the event, and back after it, each at the mean velocity.
    before = system.rates(t, y.q, event.at - 0.5 * event.late * event.before)
    after = system.rates(t, q, event.u - 0.5 * event.late * event.after)
    z = y.z
    if z is not None:
        z = z + event.late * (system.state_rates(t, y.q, event.at) - system.state_rates(t, q, event.u))
    # Without a solution the motion ends here, at infinite velocities; they are not a number where forces are none.
    nowhere = jnp.where(jnp.all(jnp.isfinite(event.before)), jnp.inf, jnp.nan)
    u = jnp.where(event.solvable, event.u - event.late * event.after, nowhere)
    return State(q + event.late * (before - after), u, z), event


@_impact.def_jvp
def _impact_jvp(primals, tangents):
    system, t, y, _, touch, dated = primals
    dsystem, dt, dy, *_ = tangents
    after, event = _impact(*primals)
    system, t, y, event = _without_second_derivative((system, t, y, event))
    n, m = counts(system)
    dq, du, dt = dense(dy.q, y.q), dense(dy.u, y.u), dense(dt, t)

    # The time of the event changes, and so do time and state there, with the equations before it.
    zero = push(gaps, (system, t, y.q), (dsystem, dt, dq))
    rate = direction_rates(system, t, y.q, event.at)
    if m:
        slip = push(direction_rates, (system, t, y.q, y.u), (dsystem, dt, dq, du))[n:]
        slowing = direction_accelerations(system, t, y.q, event.at, event.before)[n:]
        own = of_pairs(frictions_of(system).pairs)
        if own.size:
            # Slip in two directions ends where it is zero along its modes.
            along = event.modes[0][n:][own]
            slip = with_entries(slip, own[:, 0], jnp.sum(along * slip[own], axis=1))
            slowing = with_entries(slowing, own[:, 0], jnp.sum(along * slowing[own], axis=1))
        zero, rate = jnp.concatenate([zero, slip]), jnp.concatenate([rate[:n], slowing])
    dlate = jnp.where(event.hits, -zero[event.first] / jnp.where(event.hits, rate[event.first], 1.0), 0.0)
    if dated or (m and any(frictions_of(system).releases)):
        dlate = dlate + _release(system, touch, event, (t, y), (dsystem, dt, dy))
    q = with_modes(system, y.q, event.modes[1])
    rates = system.rates(t, y.q, event.at), system.rates(t, q, event.u)
    dq, du, dt = dq + dlate * rates[0], du + dlate * event.before, dt + dlate

    impulses, change = _struck(event, (system, t, y.q), (dsystem, dt, dq, du))
    at, along = (system, t, y.q), (dsystem, dt, dq)
    kinetic = lambda system, t, q, u: 0.5 * jnp.dot(u, system.inertia(t, q, u).product(u))
    energy = push(kinetic, (*at, event.at), (*along, du)) - push(kinetic, (*at, event.u), (*along, change))
    dq, du = dq - dlate * rates[1], change - dlate * event.after
    dq = jnp.where(_are_modes(system), 0.0, dq)
    dz = None
    if y.z is not None:
        jump = system.state_rates(t, y.q, event.at) - system.state_rates(t, q, event.u)
        dz = dense(dy.z, y.z) + dlate * jump
    devent = jax.tree.map(lambda _: None, event)._replace(late=dlate, impulses=impulses, energy=energy)
    return (after, event), (State(dq, du, dz), devent)


def _struck(event: Event, at, along):
    """The derivatives of the impulses, and of the velocities after them, by those before an impact.

    Of `M (u⁺ − u⁻) = Aᵀ Λ` and the rates of gaps that are held, and slips that end, each phase has one linear system.
    """
    (system, t, q), tangents, du = at, along[:3], along[3]
    contacts, (n, m), compression = contacts_of(system), counts(system), event.compression
    of = _phases(event, at, tangents, du)

    def solved(plain, matrix, right):
        impulses = solve(matrix, right)
        return impulses, plain + impulses @ of.moves

    # By the share of the rebounds velocities and impulses change as well.
    at_rates = direction_rates(system, t, q, event.at)
    bounce = contacts.restitution * jnp.maximum(-at_rates[:n], 0.0)
    bounce = jnp.pad(jnp.where(of.rebounds, bounce, 0.0), (0, m))
    none = jnp.zeros(n, q.dtype)
    if compression is None:
        last = Phase(event.u, event.held, event.slips, event.impulses)
        plain, matrix, right = _equations(of, event.at, du, last, none)
        impulses, change = solved(plain, matrix, right)
        by_share = solve(matrix, jnp.where(event.held, bounce, 0.0))
    else:
        plain, matrix, right = _equations(of, event.at, du, compression, none)
        first, between = solved(plain, matrix, right)
        first_by_share = solve(matrix, jnp.where(compression.held, bounce, 0.0))
        pushes = ~event.low & np.array(contacts.by_poisson, bool)
        again = lambda system, impulses: jnp.where(
            pushes, event.share * contacts_of(system).restitution * impulses[:n], 0.0
        )
        normal = push(again, (system, compression.impulses), (tangents[0], first))
        last = Phase(event.u, event.held, event.slips, event.impulses - compression.impulses)
        plain, matrix, right = _equations(of, compression.u, between, last, normal)
        second, change = solved(plain, matrix, right)
        normal = contacts.restitution * (compression.impulses + event.share * first_by_share)[:n]
        normal = jnp.where(pushes, normal, 0.0)
        closing = bounce - of.rows @ (first_by_share @ of.moves)
        right = jnp.where(event.held, closing, jnp.pad(normal, (0, m)))
        impulses, by_share = first + second, first_by_share + solve(matrix, right)

    # The share is that at which no energy is gained.
    both = at_rates + direction_rates(system, t, q, event.u)
    changed = push(direction_rates, (*at, event.at), along)
    changed = changed + push(direction_rates, (*at, event.u), (*tangents, change))
    gained = jnp.dot(impulses, both) + jnp.dot(event.impulses, changed)
    slope = jnp.dot(by_share, both) + jnp.dot(event.impulses, of.rows @ (by_share @ of.moves))
    less = event.share < 1
    less = jnp.where(less, -gained / jnp.where(less, slope, 1.0), 0.0) * by_share
    return impulses + less, change + less @ of.moves


class _Phases(NamedTuple):
    """What the linear equations of the phases of an impact have in common.

    **Fields:** system, t and q `at` the `event`, their `tangents`, and that of the velocities before it, `du`; the
    `rows` of A of contacts and friction, the `jacobian` of the other constraints with its `projector`, and the changes
    of velocities, `moves`, by unit impulses; contacts whose rebound is asked for by Newton's law; the `coefficients` of
    friction and their derivatives.
    """

    event: Event
    at: Any
    tangents: Any
    du: Float[Array, "nu"]
    rows: Float[Array, "laws nu"]
    jacobian: Any
    projector: Any
    moves: Float[Array, "laws nu"]
    rebounds: Bool[Array, "contacts"]
    coefficients: tuple[Float[Array, "frictions"], Float[Array, "frictions"]]


def _phases(event: Event, at, tangents, du) -> _Phases:
    system, t, q = at
    rows, jacobian = directions(system, t, q, event.u)
    projector = jacobian.projector(system.inertia(t, with_modes(system, q, 0.0), event.u))
    moves = jax.vmap(lambda force: projector.solve(force, jnp.zeros(system.acceleration_rows, q.dtype))[0])(rows)
    rebounds = ~event.low & ~np.array(contacts_of(system).by_poisson, bool)
    known = change = jnp.zeros(0, q.dtype)
    if counts(system)[1]:
        coefficients = lambda system, t, q: friction_coefficients(system, t, q, event.u)[0]
        known, change = coefficients(*at), push(coefficients, at, tangents)
    return _Phases(event, at, tangents, du, rows, jacobian, projector, moves, rebounds, (known, change))


def _equations(of: _Phases, before, dbefore, phase: Phase, normal):
    """The velocities at the end of a phase without a change of its impulses, and the linear equations for that change.

    **Arguments:** the velocities `before` the phase, and their derivative; the changes of the impulses along the
    `normal` of contacts that are not held.
    """
    event, (system, t, q), numbers = of.event, of.at, np.array(direction_rows(of.at[0]))
    n, m = counts(system)
    _, multipliers = of.projector.solve(phase.impulses @ of.rows, of.jacobian.product(phase.u - before))
    multipliers = with_entries(multipliers, numbers, phase.impulses)

    def unmet(system, t, q, first, u):
        """What is left of the rates, and of the balance of momentum."""
        rates = Instant(system, t, q, phase.u).velocity_rows
        bounce = contacts_of(system).restitution * jnp.maximum(-direction_rates(system, t, q, first)[:n], 0.0)
        bounce = jnp.where(phase.held[:n] & of.rebounds, event.share * bounce, 0.0)
        rates = rates.at[numbers[:n]].add(-bounce)
        momentum = system.inertia(t, q, u).product(phase.u - u)
        return rates, momentum - system.constraint_force(t, q, phase.u, multipliers)

    point = system, t, bound(system, q), event.at, before
    rates, forces = push(unmet, point, (*of.tangents, of.du, dbefore))
    # Rows of modes ask for nothing.
    plain, _ = of.projector.solve(-forces, jnp.where(np.isin(np.arange(rates.size), numbers), 0.0, -rates))
    asked = -(rates[numbers] + of.rows @ plain)
    law, right = jnp.eye(n + m, dtype=q.dtype), jnp.pad(normal, (0, m))
    if m:
        law, right = _friction_laws(of, plain, phase, law, right)
    matrix = jnp.where(phase.held[:, None], of.rows @ of.moves.T, law)
    return plain, matrix, jnp.where(phase.held, asked, right)


def _friction_laws(of: _Phases, plain, phase: Phase, law, right):
    """The equations with those of friction that slips, whose impulses are in proportion to those of the contacts."""
    (system, *_), frictions = of.at, frictions_of(of.at[0])
    n, of_contact = counts(system)[0], np.array(frictions.contacts) >= 0
    known, change = of.coefficients
    pushed = jnp.where(of_contact, phase.impulses[np.array(frictions.contacts)], 0.0)
    right = jnp.concatenate([right[:n], -change * phase.slips * pushed])
    for k in np.flatnonzero(of_contact):
        law = law.at[n + k, frictions.contacts[k]].set(known[k] * phase.slips[k])
    rates = lambda system, t, q: direction_rates(system, t, q, phase.u)
    for k in frictions.pairs:
        # The direction of slip changes with the velocity after the impact.
        own = np.array([k, k + 1])
        turned = push(rates, of.at, of.tangents)[n + own]
        last, speed = rates(*of.at)[n + own], norm(phase.slips[own])
        across = jnp.eye(2, dtype=law.dtype) - jnp.outer(phase.slips[own], phase.slips[own])
        by = known[k] * pushed[k] * speed * across / jnp.where(speed > 0, norm(last), 1.0)
        law = law.at[n + own].add(by @ of.rows[n + own] @ of.moves.T, unique_indices=True)
        right = right.at[n + own].add(-by @ (turned + of.rows[n + own] @ plain), unique_indices=True)
    return law, right


def _release(system, touch, event, at, along):
    """The derivative of the time at which a force reaches its limit: that of a contact that opens, which is zero, or of
    friction that sticks, where slip begins at the event.
    """
    n, m = counts(system)
    (t, y), (dsystem, dt, dy) = at, along
    before, after = event.modes
    released = jnp.concatenate(
        [(before[:n] == CLOSED) & (after[:n] == OPEN), (before[n:] == STICK) & (after[n:] != STICK)]
    )

    def reserves(system, t, y):
        """What the forces are within their limits, and what they are compared with."""
        _, multipliers = contact_forces(system, t, y.q, y.u)
        own = multipliers[np.array(direction_rows(system))]
        if m:
            own = jnp.concatenate([own[:n], stick_reserve(system, t, y.q, y.u, multipliers)])
        return own, largest_force(system, t, y, multipliers)

    left, largest = reserves(system, t, y)
    own = jnp.argmin(jnp.where(released, jnp.abs(left), jnp.inf))
    reserve = lambda system, t, y: reserves(system, t, y)[0][own]
    z = None if y.z is None else system.state_rates(t, y.q, y.u)
    motion = State(system.rates(t, y.q, y.u), event.before, z)
    value = push(reserve, (system, t, y), (dsystem, dt, dy))
    rate = eqx.filter_jvp(lambda t, y: reserve(system, t, y), (t, y), (jnp.ones_like(t), motion))[1]
    # What an impact opens, or sets in motion, is not at its limit before. Where forces balance there may be none to
    # compare with: then the time to the limit is, with the time itself.
    is_zero = jnp.abs(left[own]) <= jnp.maximum(NEAR * touch * largest, _AT_ONCE * jnp.abs(rate * t))
    at_limit = jnp.any(released) & ~event.hits & is_zero & (rate < 0)
    return jnp.where(at_limit, -value / jnp.where(at_limit, rate, 1.0), 0.0)


def _are_modes(system):
    """A mask of the modes in q."""
    return np.isin(np.arange(system.nq), mode_places(system))


@eqx.filter_custom_jvp
def _without_second_derivative(x):
    return x


@_without_second_derivative.def_jvp
def _without_jvp(primals, tangents):
    raise ValueError(NO_SECOND_DERIVATIVES)
