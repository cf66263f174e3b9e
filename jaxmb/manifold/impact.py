"""Impacts, loss of contact, stick and slip: the state after an event of contacts and dry friction.

An impact is Newton's: with the impulses `Λ ≥ 0` of all contacts that touch, `M (u⁺ − u⁻) = Aᵀ Λ`, and a gap that closed
at a rate v opens at least at `restitution` times v; where it opens faster its impulse is zero. With friction Λ is that
along slips as well, at most `coefficient` times that of the contact, and against the slip that remains. Contacts that
do not open then stay closed where their forces push: `λ ≥ 0`, the second derivative of the gap `≥ 0`, and one of them
zero; friction where slip has ended sticks as long as its force is within its limit. These are linear complementarity
problems, over the constraints that are always there.

Sources: J. J. Moreau, "Unilateral contact and dry friction in finite freedom dynamics", in: Nonsmooth Mechanics and
Applications, Springer, 1988; Ch. Glocker, "Set-Valued Force Laws", Springer, 2001. The derivative of the state after an
event by that before it is the saltation matrix: P. C. Müller, "Calculation of Lyapunov exponents for dynamic systems
with discontinuities", Chaos, Solitons & Fractals 5, 1995.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Scalar, State
from ..formulations import AbstractFormulation, accelerations
from ..linalg.complementarity import (
    Answers,
    independent_components,
    of_pairs,
    placed_pairs,
    solved_components,
)
from ..linalg.rotations import norm
from ..solvers import AbstractGuards
from ..solvers.events import narrowed
from ..system import AbstractEquation
from ..system.gaps import (
    BEGUN,
    CLOSED,
    FORWARD,
    IMPLIED,
    IMPLIED_STICK,
    OPEN,
    STICK,
    bound,
    contacts_of,
    counts,
    direction_accelerations,
    direction_gradients,
    direction_rates,
    direction_rows,
    frictions_of,
    gaps,
    kinds_of,
    mode_places,
    modes_of,
    pairs_of,
    with_modes,
)
from ..system.residuals import binding_velocities, velocity_rows
from .constraints import dense, push
from .contact_laws import REST, Laws, Problem, is_implied, sizes_of
from .impulse import after_impulse

# A step that was meant to end at an event does so where a gap is below this multiple of what counts as zero.
_NEAR = 1e2
# The state moves by less than this multiple of it until then.
_FAR = 1e6
# Slip in two directions, which has none at rest, ends at this multiple of it per second: errors of integration, that
# are larger than it, turn slower ones. Slip that begins has the direction of its modes up to a multiple of that.
_SLOW, _SEEN = 1e4, 4
# Modes of slip are longer than this, and those of slip that has begun shorter.
_HALFWAY = 0.75
# Forces of several contacts that stick are as small as they can be up to this fraction of them.
_YIELD = 1e-10
# A contact closes where it would bounce no higher than this multiple of it.
_BOUNCE = 1e3
# Low bounces, and the normal forces of joints, which depend on the friction in them, decide on what stays closed and
# sticks in this many rounds.
_ROUNDS = 4
# Rebounds at which no energy is gained are found in this many trials, to this fraction of what adds up in it.
_TRIALS, _GAIN = 40, 1e-12


class ContactGuards(AbstractGuards):
    """The gaps of open contacts, in units of the system's size, and the forces of closed ones, relative to the largest
    forces; slips in units of the size per second, and what the forces of stick are below their limits.
    """

    system: AbstractEquation
    formulation: AbstractFormulation
    touch: Float[Array, ""]

    @property
    def near(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return _NEAR * self.touch

    def values(self, t, y):
        system, y = lax.stop_gradient((self.system, y))
        q = system.normalize(y.q)
        t, (n, _) = jnp.asarray(t, q.dtype), counts(system)
        modes = modes_of(system, q)
        free = jnp.where(modes[:n] == OPEN, gaps(system, t, q), system.length)
        frictions = contacts_of(system).frictions
        if frictions is None:
            acts = modes == CLOSED
        else:
            acts = jnp.concatenate([modes[:n] == CLOSED, modes[n:] >= STICK])
            rates = direction_rates(system, t, q, y.u)
            slips, slip = jnp.abs(modes[n:]) == FORWARD, modes[n:] * rates[n:]
            free = jnp.concatenate([free, jnp.where(slips, slip, system.length)])
            free = self._of_pairs(free, modes, rates, y.u)

        def forces():
            own = system.at(y)
            _, multipliers = _solved(own, self.formulation, t, q, y.u)
            largest = _largest_force(own, t, dataclasses.replace(y, q=q), multipliers)
            taken = multipliers[np.array(direction_rows(system))]
            if frictions is not None:
                taken = jnp.concatenate([taken[:n], _reserve(own, t, q, y.u, multipliers)])
            return taken / largest

        held = lax.cond(jnp.any(acts), forces, lambda: jnp.ones_like(free))
        return jnp.where(acts, held, free / system.length)

    def _of_pairs(self, free, modes, rates, u):
        """With the guards of slip in two directions: that it has not turned by more than 60 degrees from its modes, nor
        is slow; where it has begun, that it is neither back at rest nor faster.
        """
        own = pairs_of(self.system)
        if not own.size:
            return free
        length = self.system.length
        slow, size, speed = _slow(self.system, self.touch * length, u), norm(modes[own]), norm(rates[own])
        along = jnp.sum(modes[own] * rates[own], axis=1)
        has_begun, slides = (size > 0) & (size < _HALFWAY), (size > _HALFWAY) & (size < STICK)
        turned = jnp.where(has_begun, along / BEGUN, jnp.where(slides, along - 0.5 * speed, length))
        fast = jnp.where(has_begun, _SEEN * slow - speed, jnp.where(slides, speed - slow, length))
        n, pairs = counts(self.system)[0], frictions_of(self.system).pairs
        return jnp.concatenate([free[:n], placed_pairs(pairs, jnp.stack([turned, fast], axis=1), free[n:])])

    def impact(self, t: Scalar, y: State, dated: bool = False) -> "Impact":
        """The event at a state; see `impact`."""
        return impact(self.system.at(y), self.formulation, self.touch, t, y, dated)

    def rates(self, t, y):
        system, y = lax.stop_gradient((self.system, y))
        q, (n, _) = system.normalize(y.q), counts(system)
        rates = direction_rates(system, jnp.asarray(t, q.dtype), q, y.u) / system.length
        watched = (modes_of(system, q) == OPEN) & (np.arange(rates.size) < n)
        return jnp.where(watched, rates, jnp.inf)


def _largest_force(system, t, y, multipliers):
    """What forces are compared with."""
    largest = jnp.max(jnp.abs(multipliers)) + jnp.max(jnp.abs(system.force(t, y.q, y.u)))
    return largest + jnp.finfo(largest.dtype).tiny


def _reserve(system, t, q, u, multipliers):
    """By how much the forces [N] of friction that sticks are within their limits."""
    frictions = frictions_of(system)
    normal = norm(system.friction_reactions(t, q, u, multipliers))
    forces = multipliers[np.array(frictions.rows)]
    if len(frictions.pairs) > 1:
        # Those that are not determined are as small as they can be.
        n = counts(system)[0]
        stick = modes_of(system, q)[n:] >= STICK
        gradients = jnp.where(stick[:, None], direction_gradients(system, t, q, u)[n:], 0.0)
        gram = gradients @ gradients.T
        size = _YIELD * jnp.max(jnp.diag(gram)) + jnp.finfo(gram.dtype).tiny
        shared = jnp.linalg.solve(gram + size * jnp.eye(stick.size, dtype=gram.dtype), gram @ forces)
        forces = jnp.where(stick, shared, forces)
    return frictions.limit * normal - sizes_of(frictions.pairs, forces)


def _coefficients(system, t, q, u):
    """Coefficients of friction and limits of stick, as multiples of the force along the gap of a contact, which is the
    normal force where the gap grows by one metre a metre.
    """
    frictions, contacts = frictions_of(system), contacts_of(system)
    unit = np.isin(np.arange(system.acceleration_rows), contacts.rows).astype(q.dtype)
    if min(frictions.contacts) < 0 and not contacts.rows:
        return frictions.coefficient, frictions.limit
    sizes = norm(system.friction_reactions(t, bound(system, q), u, jnp.asarray(unit)))
    sizes = jnp.where(np.array(frictions.contacts) < 0, 1.0, sizes)
    return frictions.coefficient * sizes, frictions.limit * sizes


def contact_guards(
    system: AbstractEquation, formulation: AbstractFormulation, touch: Float[Array, ""]
) -> ContactGuards | None:
    """The guards of a system's contacts; None without any."""
    return None if system.contacts is None else ContactGuards(system, formulation, touch)


def after_jump(term: Any, t: Scalar, y: State) -> State:
    """The state after prescribed rates have jumped, or contacts closed or opened, of a term with `system`,
    `formulation` and `guards`.
    """
    if term.guards is None:
        return after_impulse(term.system, t, y)
    return term.guards.impact(t, y).after


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


class _Event(NamedTuple):
    """The numbers of an event, by which its derivative is found as well.

    **Fields:** the time until then, `late`, and which gap or slip is `first` to be zero, none where `hits` is false;
    accelerations before and after; velocities before (`at`) and after (`u`); contacts and friction that are `held`:
    the rates of gaps are those of the impact, slips are zero; contacts that are `low`: they would bounce lower than can
    be seen; the direction in which friction `slips` in the impact, zero without; the `share` of the rebounds at which
    no energy is gained; see `Impact` for the others.
    """

    late: Float[Array, ""]
    first: Any
    hits: Any
    before: Float[Array, "nu"]
    after: Float[Array, "nu"]
    at: Float[Array, "nu"]
    u: Float[Array, "nu"]
    held: Bool[Array, "laws"]
    low: Bool[Array, "contacts"]
    slips: Float[Array, "frictions"]
    impulses: Float[Array, "laws"]
    modes: tuple[Float[Array, "laws"], Float[Array, "laws"]]
    rest: Float[Array, "contacts"]
    energy: Float[Array, ""]
    solvable: Bool[Array, ""]
    share: Float[Array, ""]


@eqx.filter_jit
def impact(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    touch: Scalar,
    t: Scalar,
    y: State,
    dated: bool = False,
) -> Impact:
    """The event of contacts that are about to close, or to open, at a state.

    The first gap that closes is zero later by a small time τ. The state moves on by τ, changes, and moves back by τ
    with the new equations. So the state after it is right to the second power of τ, and the derivative is that of a
    motion whose event time depends on the state. `late`, `impulses` and the `energy` have derivatives as well, `rest`
    has none. There is no second derivative.

    **Arguments:** `system`: with the internal states of `y`; `touch`: gaps down to minus this, in units of the system's
    size, count as zero; `dated`: whether `late` has its derivative also where the state after the event does not depend
    on it, as where a contact opens.
    """
    t = jnp.asarray(t, y.q.dtype)
    after, event = _impact(system, t, y, formulation, jnp.asarray(touch, y.q.dtype), dated)
    modes = kinds_of(system, event.modes[0]), kinds_of(system, event.modes[1])
    return Impact(after, event.late, event.impulses, modes, event.rest, event.energy, event.solvable)


@eqx.filter_custom_jvp
def _impact(system, t, y, formulation, touch, dated):
    del dated
    event = _event(system, formulation, touch * system.length, t, y)
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
    system, t, y, formulation, touch, dated = primals
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
            slip = slip.at[own[:, 0]].set(jnp.sum(along * slip[own], axis=1), unique_indices=True)
            slowing = slowing.at[own[:, 0]].set(jnp.sum(along * slowing[own], axis=1))
        zero, rate = jnp.concatenate([zero, slip]), rate.at[n:].set(slowing)
    dlate = jnp.where(event.hits, -zero[event.first] / jnp.where(event.hits, rate[event.first], 1.0), 0.0)
    if dated or (m and any(frictions_of(system).releases)):
        dlate = dlate + _release(system, formulation, touch, event, (t, y), (dsystem, dt, dy))
    q = with_modes(system, y.q, event.modes[1])
    rates = system.rates(t, y.q, event.at), system.rates(t, q, event.u)
    dq, du, dt = dq + dlate * rates[0], du + dlate * event.before, dt + dlate

    # Of the impact `M (u⁺ − u⁻) = Aᵀ Λ` and the rates of gaps that are held together are known, and slips that end.
    free = with_modes(system, y.q, 0.0)
    rows = direction_gradients(system, t, y.q, event.u)
    jacobian = binding_velocities(system, t, free, event.u).selected(system.velocity_rank, system.velocity_scale())
    projector = jacobian.projector(system.inertia(t, free, event.u))
    change = event.u - event.at
    _, multipliers = projector.solve(event.impulses @ rows, jacobian.product(change))
    numbers = np.array(direction_rows(system))
    multipliers = multipliers.at[numbers].set(event.impulses)

    def equations(system, t, q, u):
        unmet = velocity_rows(system, t, q, event.u)
        bounce = contacts_of(system).restitution * jnp.maximum(-direction_rates(system, t, q, u)[:n], 0.0)
        bounce = jnp.where(event.held[:n] & ~event.low, event.share * bounce, 0.0)
        unmet = unmet.at[numbers[:n]].add(-bounce)
        force = system.inertia(t, q, u).product(event.u - u)
        return unmet, force - system.constraint_force(t, q, event.u, multipliers)

    unmet, forces = push(equations, (system, t, bound(system, y.q), event.at), (dsystem, dt, dq, du))
    moves = jax.vmap(lambda force: projector.solve(force, jnp.zeros_like(unmet))[0])(rows)
    # Rows of modes ask for nothing.
    plain, _ = projector.solve(-forces, jnp.where(np.isin(np.arange(unmet.size), numbers), 0.0, -unmet))
    asked = -(unmet[numbers] + rows @ plain)
    law = jnp.eye(n + m, dtype=q.dtype)
    more = jnp.zeros(n + m, q.dtype)
    if m:
        frictions = frictions_of(system)
        known, _ = _coefficients(system, t, y.q, event.u)
        coefficients = lambda system, t, q: _coefficients(system, t, q, event.u)[0]
        coefficient = push(coefficients, (system, t, y.q), (dsystem, dt, dq))
        of_contact = np.array(frictions.contacts) >= 0
        normal = jnp.where(of_contact, event.impulses[np.array(frictions.contacts)], 0.0)
        more = jnp.concatenate([more[:n], -coefficient * event.slips * normal])
        for k in np.flatnonzero(of_contact):
            law = law.at[n + k, frictions.contacts[k]].set(known[k] * event.slips[k])
        rates_after = lambda system, t, q: direction_rates(system, t, q, event.u)
        for k in frictions.pairs:
            # The direction of slip changes with the velocity after the impact.
            own = np.array([k, k + 1])
            turned = push(rates_after, (system, t, y.q), (dsystem, dt, dq))[n + own]
            last, speed = direction_rates(system, t, y.q, event.u)[n + own], norm(event.slips[own])
            across = jnp.eye(2, dtype=q.dtype) - jnp.outer(event.slips[own], event.slips[own])
            by = known[k] * normal[k] * speed * across / jnp.where(speed > 0, norm(last), 1.0)
            law = law.at[n + own].add(by @ rows[n + own] @ moves.T, unique_indices=True)
            more = more.at[n + own].add(-by @ (turned + rows[n + own] @ plain), unique_indices=True)
    matrix = jnp.where(event.held[:, None], rows @ moves.T, law)
    impulses = jnp.linalg.solve(matrix, jnp.where(event.held, asked, more))
    change = plain + impulses @ moves
    at, along = (system, t, y.q), (dsystem, dt, dq)
    less = _less_rebound(event, at, along, (du, change, impulses), (rows, moves, matrix))
    impulses, change = impulses + less, change + less @ moves
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


def _less_rebound(event, at, along, tangents, known):
    """The change of the impulses by the derivative of the share of the rebounds at which no energy is gained."""
    (system, t, q), (before, after, impulses), (rows, moves, matrix) = at, tangents, known
    n, m = counts(system)
    first, last = direction_rates(system, t, q, event.at), direction_rates(system, t, q, event.u)
    changed = push(direction_rates, (*at, event.at), (*along, before))
    changed = changed + push(direction_rates, (*at, event.u), (*along, after))
    both = first + last
    gained = jnp.dot(impulses, both) + jnp.dot(event.impulses, changed)
    bounce = contacts_of(system).restitution * jnp.maximum(-first[:n], 0.0)
    right = jnp.pad(jnp.where(event.held[:n] & ~event.low, bounce, 0.0), (0, m))
    by_share = jnp.linalg.solve(matrix, right)
    slope = jnp.dot(by_share, both) + jnp.dot(event.impulses, rows @ (by_share @ moves))
    less = event.share < 1
    return jnp.where(less, -gained / jnp.where(less, slope, 1.0), 0.0) * by_share


def _release(system, formulation, touch, event, at, along):
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
        _, multipliers = _solved(system, formulation, t, y.q, y.u)
        own = multipliers[np.array(direction_rows(system))]
        if m:
            own = own.at[n:].set(_reserve(system, t, y.q, y.u, multipliers))
        return own, _largest_force(system, t, y, multipliers)

    left, largest = reserves(system, t, y)
    own = jnp.argmin(jnp.where(released, jnp.abs(left), jnp.inf))
    reserve = lambda system, t, y: reserves(system, t, y)[0][own]
    z = None if y.z is None else system.state_rates(t, y.q, y.u)
    motion = State(system.rates(t, y.q, y.u), event.before, z)
    value = push(reserve, (system, t, y), (dsystem, dt, dy))
    rate = eqx.filter_jvp(lambda t, y: reserve(system, t, y), (t, y), (jnp.ones_like(t), motion))[1]
    # What an impact opens, or sets in motion, is not at its limit before.
    is_zero = jnp.abs(left[own]) <= _NEAR * touch * largest
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
    raise ValueError(
        "Second derivatives through impacts are not supported: their times and states have first derivatives only."
    )


def _of_both(pairs, modes, rates, curve, slow, single):
    """Which friction may come to rest, how fast it slips, and how fast that changes, with that in two directions, of
    which the first number is that of both, along the modes.
    """
    own = of_pairs(pairs)
    size = norm(modes[own])
    along = modes[own] / jnp.where(size > 0, size, 1.0)[:, None]
    may = (size > 0) & (size < STICK) & (norm(rates[own]) <= 2 * slow)
    both = may, jnp.sum(along * rates[own], axis=1), jnp.sum(along * curve[own], axis=1)
    # The second number says nothing.
    pairwise = lambda new, old: placed_pairs(pairs, jnp.stack([new, jnp.zeros_like(new)], axis=1), old)
    return tuple(map(pairwise, both, single))


def _slow(system, touch, u):
    """The velocity [m/s] up to which slip in two directions has ended; `touch` [m, rad]."""
    return _SLOW * touch * (1 + jnp.max(jnp.abs(u) / system.velocity_scale()))


def _event(system, formulation, touch, t, y) -> _Event:
    """An event at a state; `touch` [m, rad]."""
    contacts, q, u = contacts_of(system), y.q, y.u
    frictions, (n, m) = contacts.frictions, counts(system)
    modes, free_q = modes_of(system, q), with_modes(system, q, 0.0)
    inertia = system.inertia(t, free_q, u)
    rows = direction_gradients(system, t, q, u)
    jacobian = binding_velocities(system, t, free_q, u).selected(system.velocity_rank, system.velocity_scale())
    projector = jacobian.projector(inertia)
    zero = jnp.zeros(system.acceleration_rows, q.dtype)
    # The changes of velocities by unit impulses, with those that the other constraints answer with; in the last row the
    # change that these constraints ask for themselves.
    unmet = -velocity_rows(system, t, free_q, u)
    forces = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
    asked = jnp.concatenate([jnp.tile(zero, (len(rows), 1)), unmet[None]])
    moves, answers = jax.vmap(projector.solve)(forces, asked)
    moves, jump, answers = moves[:-1], moves[-1], answers[:-1]
    influence = rows @ moves.T
    laws = Laws(influence, frictions, n, m, *(_coefficients(system, t, q, u) if m else (zero[:0], zero[:0])))

    def accelerated(u):
        """Accelerations without contacts and friction, those along their directions, and the reactions of the joints
        that have friction, without forces along these and by a unit of each.
        """
        udot, multipliers = _free_acceleration(system, formulation, projector, t, free_q, u)
        opening = direction_accelerations(system, t, q, u, udot)
        if not laws.of_joints.any():
            return udot, opening, None
        reactions = lambda own: system.friction_reactions(t, q, u, own)
        return udot, opening, jax.vmap(reactions)(jnp.concatenate([multipliers[None], answers]))

    slow = _slow(system, touch, u)
    rates = direction_rates(system, t, q, u)
    rates_at = lambda other: rates + rows @ (other - u)
    gap = gaps(system, t, q)

    def strike(k, before: _Round, answers, impulses):
        """The velocities after an impulse, and the forces that are asked for there."""
        after = before.when.u + jnp.where(k == 0, 0.0, jump) + impulses @ moves
        rate = rates_at(after)
        both = before.when.at + rate
        gained = jnp.dot(impulses, both)
        size = jnp.dot(jnp.abs(impulses), jnp.abs(before.when.at) + jnp.abs(rate))
        trial = _next_trial(before.trial, gained, size, k // 2 - 1)
        udot, opening, reactions = accelerated(after)
        sizes = jnp.abs(rows) @ (jnp.abs(after) + jnp.abs(before.when.u))
        resting = before.when.touching & ((rate[:n] <= REST * sizes[:n]) | before.low)
        # Slip that is not to be seen has ended.
        speed = laws.sizes(rate[n:])
        ended = (speed <= REST * laws.sizes(sizes[n:])) | (speed <= jnp.where(laws.are_pairs, 2 * slow, _NEAR * touch))
        slips = jnp.where(ended, 0.0, rate[n:] / jnp.where(ended, 1.0, speed))
        return before._replace(
            problem=laws.of_forces(opening, reactions, resting, slips, modes, before.forces),
            struck=answers,
            impulses=impulses,
            after=after,
            rate=rate,
            udot=udot,
            resting=resting,
            ended=ended,
            solvable=answers.solvable,
            trial=trial,
            share=before.trial.share,
        )

    def begin(k, before: _Round, answers, forces):
        """What is next, of the equations before, and when."""
        del k, answers
        when = at_event(before.udot + forces @ moves, before.problem.free + influence @ forces)
        return before._replace(problem=impulse_of(when, before.low, before.trial.share), when=when)

    def settle(k, before: _Round, answers, forces):
        """The laws that hold after an impact with their forces, and the impulses that are asked for in a further round,
        in which other contacts may bounce too low to be seen.
        """
        # Contacts that would open by less than can be seen, before they close again, stay closed: of those that open in
        # the first round.
        when, is_first = before.when, k == 3
        bounce = bounces(when)
        curve = (before.problem.free + influence @ forces)[:n]
        falls = jnp.where(curve < 0, -curve, 1.0)
        opens = before.rate[:n] ** 2 <= 2 * falls * _BOUNCE * touch
        low = when.touching & ~before.resting & (curve < 0) & opens & (contacts.restitution < 1)
        low = jnp.where(is_first, low, before.low)
        # Each bounce takes `restitution` times the time of the one before.
        ratio = jnp.where(low & (bounce > 0), contacts.restitution, 0.0)
        rest = jnp.where(low & (bounce > 0), 2 * before.rate[:n] / (falls * (1 - ratio)), 0.0)
        return before._replace(
            problem=impulse_of(when, low, before.trial.share),
            low=low,
            rest=jnp.where(is_first, rest, before.rest),
            answers=answers,
            forces=forces,
            solvable=before.solvable & answers.solvable,
        )

    def at_event(before, curve) -> _When:
        """The first of the zeros that are next, with accelerations until then, and those along the directions."""
        closing = rates[:n]
        about_to = (modes[:n] == OPEN) & (gap <= _NEAR * touch) & (closing < 0)
        # The first zero of a parabola.
        root = jnp.sqrt(jnp.maximum(closing**2 - 2 * curve[:n] * gap, 0.0))
        until = 2 * gap / (root + jnp.where(about_to, -closing, 1.0))
        if m:
            slip, slowing = modes[n:] * rates[n:], modes[n:] * curve[n:]
            slides = jnp.abs(modes[n:]) == FORWARD
            if laws.pairs:
                single = slides, slip, slowing
                slides, slip, slowing = _of_both(laws.pairs, modes[n:], rates[n:], curve[n:], slow, single)
            ends = slides & (slip <= jnp.where(laws.are_pairs, 2 * slow, _NEAR * touch)) & (slowing < 0)
            until = jnp.concatenate([until, -slip / jnp.where(ends, slowing, 1.0)])
            about_to = jnp.concatenate([about_to, ends])
        # A zero that is far off in time, since rates are rounding errors, is none.
        speed = jnp.max(jnp.maximum(jnp.abs(u), jnp.abs(before)) / system.velocity_scale()) * system.length
        about_to = about_to & (jnp.abs(until) * speed <= _FAR * touch)
        first = jnp.argmin(jnp.where(about_to, until, jnp.inf))
        hits = about_to[first]
        late = jnp.where(hits, until[first], 0.0)
        is_first = np.arange(n) == first
        touching = (modes[:n] != OPEN) | (about_to[:n] & is_first) | (gap + late * closing <= touch)
        at = u + late * before
        return _When(late, first, hits, before, at, rates_at(at), touching)

    def bounces(when: _When):
        return contacts.restitution * jnp.maximum(-when.at[:n], 0.0)

    def impulse_of(when: _When, low, share) -> Problem:
        """What is asked of the impulses, where contacts that are `low` do not bounce, and others with a share of the
        whole rebound.
        """
        back = jnp.where(low, 0.0, share * bounces(when))
        approach = when.at + rows @ jump - jnp.pad(back, (0, m))
        if laws.pairs:
            # Directions of rounding errors have no sense.
            approach = jnp.where(jnp.abs(approach) <= REST * (jnp.abs(rows) @ jnp.abs(when.u)), 0.0, approach)
        return laws.of_impulses(approach, when.touching, reactions)

    # Impulses and forces take turns, so that the program that finds one of them is compiled once. The first impulse is
    # none, and the forces after it are those before the event.
    none, one, yes = jnp.zeros(n + m, q.dtype), jnp.ones((), q.dtype), jnp.array(True)
    no, idle = Answers(none[:n] > 0, none[n:] > 0, none[n:], yes, none[n:] > 0), none[:n] > 0
    reactions = jax.tree.map(jnp.zeros_like, jax.eval_shape(accelerated, u)[2])
    when = _When(0 * one, jnp.argmin(none), ~yes, u, u, rates, idle)
    start = _Round(
        problem=laws.of_impulses(none, idle, reactions),
        when=when,
        low=idle,
        rest=none[:n],
        struck=no,
        impulses=none,
        after=u,
        rate=none,
        udot=u,
        resting=idle,
        ended=none[n:] > 0,
        answers=no,
        forces=none,
        solvable=yes,
        trial=_Trial(one, 0 * one, one, 0 * one, one, ~yes),
        share=one,
    )

    def going(carry):
        k, last = carry
        rounds = k // 2 - 1
        return (k % 2 == 1) | (rounds < _ROUNDS) | (last.trial.again & (rounds < _ROUNDS + _TRIALS))

    def advance(carry):
        k, last = carry
        answers = laws.answers(last.problem)
        known = laws.of_modes(modes, rates)
        answers = jax.tree.map(lambda known, found: jnp.where(k == 1, known, found), known, answers)
        found = laws.solved(last.problem, answers)
        which = jnp.where(k % 2 == 0, 0, jnp.where(k == 1, 1, 2))
        return k + 1, lax.switch(which, [strike, begin, settle], k, last, answers, found)

    _, settled = lax.while_loop(going, advance, (jnp.array(0), start))
    when, struck, last = settled.when, settled.struck, settled.answers
    rate, staying, ended = settled.rate, settled.resting, settled.ended
    held = struck.closed | settled.low

    implied = staying & ~last.closed & is_implied(influence[:n, :n], last.closed)
    new = jnp.where(last.closed, CLOSED, jnp.where(implied, IMPLIED, OPEN))
    dry = jnp.where(last.implied, IMPLIED_STICK, laws.begun(ended) * last.slips)
    new = jnp.concatenate([new, jnp.where(last.sticks, STICK, dry)]).astype(q.dtype)
    if m:
        # Slips that have ended are zero to all digits.
        # Slip in two directions begins at rest.
        rests = last.sticks | (laws.are_pairs & ended & (last.slips != 0))
        held = jnp.concatenate([held | last.closed, rests | struck.sticks])
        left = jnp.concatenate([jnp.where(staying, rate[:n], 0.0), jnp.where(rests, rate[n:], 0.0)])
        cancelled = held & jnp.concatenate([staying, rests])
    else:
        left, cancelled = jnp.where(staying, rate, 0.0), held & settled.low
    held = held & independent_components(influence, held)
    lost = jnp.where(held & cancelled, solved_components(influence, left, held & cancelled), 0.0)
    after = settled.after + lost @ moves
    # Impulses of rounding errors are none.
    sizes = jnp.abs(rows) @ (jnp.abs(after) + jnp.abs(when.u))
    impulses = settled.impulses
    impulses = jnp.where(jnp.abs(jnp.diag(influence) * impulses) <= REST * sizes, 0.0, impulses)
    energy = 0.5 * (jnp.dot(when.u, inertia.product(when.u)) - jnp.dot(after, inertia.product(after)))
    return _Event(
        late=when.late,
        first=when.first,
        hits=when.hits,
        before=when.before,
        after=settled.udot + settled.forces @ moves,
        at=when.u,
        u=after,
        held=held,
        low=settled.low,
        slips=struck.slips,
        impulses=impulses,
        modes=(modes, new),
        rest=jnp.pad(settled.rest, (0, m)),
        energy=energy,
        solvable=settled.solvable,
        share=settled.share,
    )


class _When(NamedTuple):
    """When the event is, see `_Event`, with the velocities `u` then, before it, the rates `at` of gaps and slips, and
    which contacts are `touching`.
    """

    late: Float[Array, ""]
    first: Any
    hits: Any
    before: Float[Array, "nu"]
    u: Float[Array, "nu"]
    at: Float[Array, "laws"]
    touching: Bool[Array, "contacts"]


class _Trial(NamedTuple):
    """The search for the largest `share` of the rebounds at which an impact gives no energy back: it is between `a`, at
    which some is lost, and `b`, with what is gained at both; whether it goes on `again`.
    """

    share: Float[Array, ""]
    a: Float[Array, ""]
    b: Float[Array, ""]
    of_a: Float[Array, ""]
    of_b: Float[Array, ""]
    again: Bool[Array, ""]


def _next_trial(trial: _Trial, gained, size, k) -> _Trial:
    """What is tried next, after the first rounds, in which the whole rebound was, and gained some energy."""
    first = k == _ROUNDS - 1
    again = jnp.where(first, gained > REST * size, trial.again & (jnp.abs(gained) > _GAIN * size))
    a, b, of_a, of_b, share = narrowed((trial.a, trial.b, trial.of_a, trial.of_b), trial.share, gained, k % 3 == 2)
    # Without a rebound energy is lost.
    share = jnp.where(again, jnp.where(first, 0.0, share), trial.share)
    new = _Trial(share, a, b, of_a, of_b, again)
    return jax.tree.map(lambda old, new: jnp.where(k < _ROUNDS - 1, old, new), trial, new)


class _Round(NamedTuple):
    """What happens in an event in one round of impulses and forces of `_event`; see there.

    **Fields:** the `problem` of the impulses or forces that are to be found next; `when` the event is.
    """

    problem: Problem
    when: _When
    low: Bool[Array, "contacts"]
    rest: Float[Array, "contacts"]
    struck: Answers
    impulses: Float[Array, "laws"]
    after: Float[Array, "nu"]
    rate: Float[Array, "laws"]
    udot: Float[Array, "nu"]
    resting: Bool[Array, "contacts"]
    ended: Bool[Array, "frictions"]
    answers: Answers
    forces: Float[Array, "laws"]
    solvable: Bool[Array, ""]
    trial: _Trial
    share: Float[Array, ""]


def _free_acceleration(system, formulation, projector, t, q, u):
    """Accelerations and multipliers at coordinates without contacts and friction, where the projector on the other
    constraints is known.
    """
    if not system.ideal_without_friction:
        return accelerations(system, formulation, t, q, u)
    return _by_projector(system, projector, t, q, u)


def _solved(system, formulation, t, q, u):
    """Accelerations and multipliers at a state, without a search for pivots where that is possible."""
    if not system.ideal_on_velocities:
        return accelerations(system, formulation, t, q, u)
    jacobian = system.structured_jacobian(t, q, u).selected(system.acceleration_rank, system.velocity_scale())
    return _by_projector(system, jacobian.projector(system.inertia(t, q, u)), t, q, u)


def _by_projector(system, projector, t, q, u):
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    return projector.solve(system.force(t, q, u), gamma)
