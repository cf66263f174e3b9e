"""An event of contacts and dry friction at a state: its time, impulses, forces, and what holds after it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..linalg.complementarity import (
    Answers,
    independent_components,
    of_pairs,
    placed_pairs,
    solved_components,
)
from ..linalg.rotations import norm
from ..solvers.events import Bracket, narrowed
from ..system.gaps import (
    CLOSED,
    FORWARD,
    IMPLIED,
    IMPLIED_STICK,
    OPEN,
    STICK,
    bound,
    contacts_of,
    counts,
    direction_rows,
    gaps,
    modes_of,
    with_modes,
)
from ..system.instant import Instant
from .contact_forces import directions, free_accelerations, friction_coefficients, slow_slip
from .contact_laws import REST, Laws, Problem, is_implied

# A step that was meant to end at an event does so where a gap is below this multiple of what counts as zero.
NEAR = 1e2
# The state moves by less than this multiple of it until then.
_FAR = 1e6
# A contact closes where it would bounce no higher than this multiple of it.
_BOUNCE = 1e3
# The normal forces of joints, which depend on the friction in them, decide on what stays closed and sticks in this many
# rounds of impulses and forces; without such friction low bounces do in a second one.
_ROUNDS = 4
# Rebounds at which no energy is gained are found in this many trials, to this fraction of what adds up in it.
_TRIALS, _GAIN = 40, 1e-12


class Event(NamedTuple):
    """The numbers of an event, by which its derivative is found as well.

    **Fields:** the time until then, `late`, and which gap or slip is `first` to be zero, none where `hits` is false;
    accelerations before and after; velocities before (`at`) and after (`u`); contacts and friction that are `held`:
    the rates of gaps are those of the impact, slips are zero; contacts that are `low`: they would bounce lower than can
    be seen; the direction in which friction `slips` in the impact, zero without; the `share` of the rebounds at which
    no energy is gained; the `compression` of an impact by Poisson's law, after which `held` and `slips` are those of
    the expansion; see `Impact` for the others.
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
    compression: "Phase | None"


class Phase(NamedTuple):
    """The compression of an impact by Poisson's law, with the velocities at its end; see `Event`."""

    u: Float[Array, "nu"]
    held: Bool[Array, "laws"]
    slips: Float[Array, "frictions"]
    impulses: Float[Array, "laws"]


# Compiled inside the whole program, so that it is traced once.
@eqx.filter_jit
def find_event(system, formulation, touch, t, y) -> Event:
    """An event at a state, without derivatives; `touch` in units of the system's size."""
    system, touch, t, y = lax.stop_gradient((system, jnp.asarray(touch, y.q.dtype), jnp.asarray(t, y.q.dtype), y))
    touch = touch * system.length
    contacts, q, u = contacts_of(system), y.q, y.u
    frictions, (n, m) = contacts.frictions, counts(system)
    modes, free_q = modes_of(system, q), with_modes(system, q, 0.0)
    inertia = system.inertia(t, free_q, u)
    rows, jacobian = directions(system, t, q, u)
    projector = jacobian.projector(inertia)
    zero = jnp.zeros(system.acceleration_rows, q.dtype)
    # The changes of velocities by unit impulses, with those that the other constraints answer with; in the last row the
    # change that these constraints ask for themselves.
    unmet = Instant(system, t, bound(system, q), u).velocity_rows
    forces = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
    asked = jnp.concatenate([jnp.tile(zero, (len(rows), 1)), -unmet[None]])
    moves, answers = jax.vmap(projector.solve)(forces, asked)
    moves, jump, answers = moves[:-1], moves[-1], answers[:-1]
    influence = rows @ moves.T
    laws = Laws(influence, frictions, n, m, *(friction_coefficients(system, t, q, u) if m else (zero[:0], zero[:0])))

    def accelerated(u):
        """Accelerations without contacts and friction, those along their directions, and the reactions of the joints
        that have friction, without forces along these and by a unit of each.
        """
        udot, multipliers, opening = free_accelerations(system, formulation, projector, t, q, u)
        if not laws.of_joints.any():
            return udot, opening, None
        reactions = lambda own: system.friction_reactions(t, q, u, own)
        return udot, opening, jax.vmap(reactions)(jnp.concatenate([multipliers[None], answers]))

    by_poisson = np.array(contacts.by_poisson, bool)
    # Impulses, in one phase or two, and forces take turns.
    turns = 3 if by_poisson.any() else 2
    slow = slow_slip(system, touch, u)
    rates = unmet[np.array(direction_rows(system))]
    rates_at = lambda other: rates + rows @ (other - u)
    gap = gaps(system, t, q)

    def expand(k, before: _Round, answers, impulses):
        """The end of the compression, and the impulses that are asked for besides those with which contacts push again
        in the expansion.
        """
        again = contacts.restitution * impulses[:n]
        again = jnp.where(by_poisson & ~before.low, before.trial.share * again, 0.0)
        u = before.when.u + jnp.where(k < turns, 0.0, jump) + impulses @ moves
        free = before.problem.free + influence @ impulses
        free = jnp.where(jnp.abs(free) <= REST * (jnp.abs(rows) @ (jnp.abs(u) + jnp.abs(before.when.u))), 0.0, free)
        problem = laws.of_expansion(free, again, before.when.touching, reactions)
        held = jnp.concatenate([answers.closed, answers.sticks])
        return before._replace(
            problem=problem,
            compression=Phase(u, held, answers.slips, impulses),
            pushed=impulses + jnp.pad(again, (0, m)),
            solvable=answers.solvable,
        )

    def strike(k, before: _Round, answers, impulses):
        """The velocities after an impulse, and the forces that are asked for there."""
        solvable = answers.solvable
        if turns == 3:
            impulses, solvable = before.pushed + impulses, solvable & before.solvable
        after = before.when.u + jnp.where(k < turns, 0.0, jump) + impulses @ moves
        rate = rates_at(after)
        gained = jnp.dot(impulses, before.when.at + rate)
        size = jnp.dot(jnp.abs(impulses), jnp.abs(before.when.at) + jnp.abs(rate))
        udot, opening, reactions = accelerated(after)
        sizes = jnp.abs(rows) @ (jnp.abs(after) + jnp.abs(before.when.u))
        resting = before.when.touching & ((rate[:n] <= REST * sizes[:n]) | before.low)
        # Slip that is not to be seen has ended.
        speed = laws.sizes(rate[n:])
        ended = (speed <= REST * laws.sizes(sizes[n:])) | (speed <= jnp.where(laws.are_pairs, 2 * slow, NEAR * touch))
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
            solvable=solvable,
            gained=(gained, size),
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
        when, is_first = before.when, k == 2 * turns - 1
        bounce = bounces(when)
        curve = (before.problem.free + influence @ forces)[:n]
        falls = jnp.where(curve < 0, -curve, 1.0)
        opens = before.rate[:n] ** 2 <= 2 * falls * _BOUNCE * touch
        low = when.touching & ~before.resting & (curve < 0) & opens & (contacts.restitution < 1)
        low = jnp.where(is_first, low, before.low)
        # Each bounce takes `restitution` times the time of the one before.
        ratio = jnp.where(low & (bounce > 0), contacts.restitution, 0.0)
        rest = jnp.where(low & (bounce > 0), 2 * before.rate[:n] / (falls * (1 - ratio)), 0.0)
        # Where nothing bounces low, and no force depends on others, a second round would find the same.
        rounds = before.rounds if laws.of_joints.any() else jnp.where(jnp.any(low), 2, 1)
        trial = _next_trial(before.trial, *before.gained, k // turns - rounds)
        return before._replace(
            problem=impulse_of(when, low, trial.share),
            rounds=rounds,
            trial=trial,
            low=low,
            rest=jnp.where(is_first, rest, before.rest),
            answers=answers,
            forces=forces,
            solvable=before.solvable & answers.solvable,
        )

    def at_event(before, curve) -> _When:
        """The first of the zeros that are next, with accelerations until then, and those along the directions."""
        closing = rates[:n]
        about_to = (modes[:n] == OPEN) & (gap <= NEAR * touch) & (closing < 0)
        # The first zero of a parabola.
        root = jnp.sqrt(jnp.maximum(closing**2 - 2 * curve[:n] * gap, 0.0))
        until = 2 * gap / (root + jnp.where(about_to, -closing, 1.0))
        if m:
            slip, slowing = modes[n:] * rates[n:], modes[n:] * curve[n:]
            slides = jnp.abs(modes[n:]) == FORWARD
            if laws.pairs:
                single = slides, slip, slowing
                slides, slip, slowing = _of_both(laws.pairs, modes[n:], rates[n:], curve[n:], slow, single)
            ends = slides & (slip <= jnp.where(laws.are_pairs, 2 * slow, NEAR * touch)) & (slowing < 0)
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
        whole rebound; by Poisson's law none does at the end of compression.
        """
        back = jnp.where(low | by_poisson, 0.0, share * bounces(when))
        approach = when.at + rows @ jump - jnp.pad(back, (0, m))
        if laws.pairs:
            # Directions of rounding errors have no sense.
            approach = jnp.where(jnp.abs(approach) <= REST * (jnp.abs(rows) @ jnp.abs(when.u)), 0.0, approach)
        return laws.of_impulses(approach, when.touching, reactions)

    # The program that finds impulses or forces is compiled once. The first impulse is none, and the forces after it are
    # those before the event.
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
        rounds=jnp.array(_ROUNDS if laws.of_joints.any() else 1),
        gained=(one, one),
        trial=_Trial(one, Bracket(0 * one, one, 0 * one, one, jnp.array(0)), ~yes),
        share=one,
        compression=Phase(u, none > 0, none[n:], none) if turns == 3 else None,
        pushed=none if turns == 3 else None,
    )
    does = [expand, strike, begin, settle][3 - turns :]

    def going(carry):
        k, last = carry
        more = k // turns - 1 - last.rounds
        return (k % turns != 0) | (more < 0) | (last.trial.again & (more < _TRIALS))

    def advance(carry):
        k, last = carry
        answers = laws.answers(last.problem)
        known = laws.of_modes(modes, rates)
        answers = jax.tree.map(lambda known, found: jnp.where(k == turns - 1, known, found), known, answers)
        found = laws.solved(last.problem, answers)
        turn = k % turns
        which = jnp.where((turn == turns - 1) & (k >= turns), turns, turn)
        return k + 1, lax.switch(which, does, k, last, answers, found)

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
    cancelled = held & cancelled
    if m:
        # Bodies that move side by side would come nearer, at a rate that is too small beside slips to close their
        # contact, and each step would end with an event.
        drifts = jnp.pad(staying & ~held[:n] & ~implied & (rate[:n] < 0), (0, m))
        cancelled = cancelled | drifts
        cancelled = cancelled & independent_components(influence, cancelled)
    compression = settled.compression
    if compression is not None:
        first = compression.held
        compression = compression._replace(held=first & independent_components(influence, first))
    lost = jnp.where(cancelled, solved_components(influence, left, cancelled), 0.0)
    after = settled.after + lost @ moves
    # Impulses of rounding errors are none.
    sizes = jnp.abs(rows) @ (jnp.abs(after) + jnp.abs(when.u))
    impulses = settled.impulses
    impulses = jnp.where(jnp.abs(jnp.diag(influence) * impulses) <= REST * sizes, 0.0, impulses)
    energy = 0.5 * (jnp.dot(when.u, inertia.product(when.u)) - jnp.dot(after, inertia.product(after)))
    return Event(
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
        compression=compression,
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


class _When(NamedTuple):
    """When the event is, see `Event`, with the velocities `u` then, before it, the rates `at` of gaps and slips, and
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
    """The search for the largest `share` of the rebounds at which an impact gives no energy back: it is in the
    `bracket`, of what is gained; whether it goes on `again`.
    """

    share: Float[Array, ""]
    bracket: Bracket
    again: Bool[Array, ""]


def _next_trial(trial: _Trial, gained, size, k) -> _Trial:
    """What is tried next, after `k` trials; before the first one the whole rebound was, and gained some energy."""
    first = k == 0
    again = jnp.where(first, gained > REST * size, trial.again & (jnp.abs(gained) > _GAIN * size))
    bracket, share = narrowed(trial.bracket, trial.share, gained, k % 3 == 2)
    # Without a rebound energy is lost.
    share = jnp.where(again, jnp.where(first, 0.0, share), trial.share)
    new = _Trial(share, bracket, again)
    return jax.tree.map(lambda old, new: jnp.where(k < 0, old, new), trial, new)


class _Round(NamedTuple):
    """What happens in an event in one round of impulses and forces of `find_event`; see there.

    **Fields:** the `problem` of the impulses or forces that are to be found next; `when` the event is; in how many
    `rounds` what stays closed and sticks is known; twice the energy that the impulses have `gained`, and what adds up
    in it; by Poisson's law the `compression`, and the impulses with which contacts have `pushed` then and push again at
    least.
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
    rounds: Int[Array, ""]
    gained: tuple[Float[Array, ""], Float[Array, ""]]
    trial: _Trial
    share: Float[Array, ""]
    compression: Phase | None
    pushed: Float[Array, "laws"] | None
