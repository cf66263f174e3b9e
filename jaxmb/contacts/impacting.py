"""An event of contacts and dry friction at a state: its time, impulses and forces, and the laws that hold after it."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..formulations import AbstractFormulation
from ..linalg.arrays import add_up
from ..linalg.complementarity import independent_components, solved_components
from ..linalg.pairs import for_first, of_pairs
from ..linalg.rotations import norm
from ..parts.modes import Modes, modes_of_contacts, modes_of_friction
from ..solvers.events import Bracket, narrowed
from ..system.contact_set import ContactSet
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .dry_laws import Answers
from .forces import free_accelerations, other_rows
from .groups import group_sums, groups_of, least_in_group, of_contacts
from .problem import Laws, Problem, is_implied
from .tolerance import REST, ContactTolerance

# If normal forces of joints depend on the friction in them, this many rounds of impulses and forces decide which
# contacts stay closed and which friction sticks. Without such friction, low bounces decide in a second round.
_ROUNDS = 4
# Rebounds without gain of energy are found in this many trials, to this fraction of the summands of the energy.
_TRIALS, _GAIN = 40, 1e-12


class Event(NamedTuple):
    """The numbers of an event, for its derivative as well.

    **Fields:** `late`: the time until the event; accelerations `before` and `after`; velocities before (`at`) and after
    (`u`); `held`: contacts whose gaps have the rates of the impact, and friction whose slip is zero; `low`: contacts
    that would bounce lower than the resolution; `slips`: the direction of slip in the impact, or zero; `compression` of
    an impact by Poisson's law, after which `held` and `slips` belong to the expansion; see `Impact` for the others.

    Each law has a `group`, None if there can be one only (`groups_of`); among the impulses alone, `balance` is the
    group with one energy balance. `first`: the gap or slip that is zero first, none if `hits` is false; `share` of the
    rebounds at which no energy is gained: single numbers for one group, otherwise those of each law's group.
    """

    late: Float[Array, ""]
    group: Int[Array, "laws"] | None
    balance: Int[Array, "laws"] | None
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
    share: Float[Array, "*laws"]
    compression: "Phase | None"


class Phase(NamedTuple):
    """The compression of an impact by Poisson's law, with the velocities at its end; see `Event`."""

    u: Float[Array, "nu"]
    held: Bool[Array, "laws"]
    slips: Float[Array, "frictions"]
    impulses: Float[Array, "laws"]


class When(NamedTuple):
    """The time of the event, see `Event`.

    **Fields:** the velocities `u` then, before it; the rates `at` of gaps and slips; which contacts are `touching`;
    `zeros`: see `Impacting.zeros`, None if there is one group only.
    """

    late: Float[Array, ""]
    first: Any
    hits: Any
    before: Float[Array, "nu"]
    u: Float[Array, "nu"]
    at: Float[Array, "laws"]
    touching: Bool[Array, "contacts"]
    zeros: tuple[Float[Array, "laws"], Bool[Array, "laws"]] | None


class Trial(NamedTuple):
    """The search for the largest `share` of the rebounds at which an impact gains no energy; with groups for each law.

    **Fields:** the `bracket` of the share, with the energy gained; `again`: whether the search goes on.
    """

    share: Float[Array, "*laws"]
    bracket: Bracket
    again: Bool[Array, "*laws"]


def next_trial(trial: Trial, gained, size, k) -> Trial:
    """The next trial after `k` trials; before the first trial, the whole rebound was tried and gained energy."""
    first = k == 0
    again = jnp.where(first, gained > REST * size, trial.again & (jnp.abs(gained) > _GAIN * size))
    bracket, share = narrowed(trial.bracket, trial.share, gained, k % 3 == 2)
    # Without a rebound, energy is lost.
    share = jnp.where(again, jnp.where(first, 0.0, share), trial.share)
    new = Trial(share, bracket, again)
    return jax.tree.map(lambda old, new: jnp.where(k < 0, old, new), trial, new)


# A nested program, so that it is traced once.
@eqx.filter_jit
def find_event(system, formulation, tolerance: ContactTolerance, t, y) -> Event:
    """An event at a state, without derivatives; the tolerance is in units of the system's size."""
    touch, t = (jnp.asarray(x, y.q.dtype) for x in (tolerance.touch, t))
    system, touch, t, y = lax.stop_gradient((system, touch, t, y))
    at = Instant(system, t, y.q, y.u)
    return Impacting.of(at, formulation, ContactTolerance(touch).in_metres(system)).event()


class Struck(NamedTuple):
    """An impact in one round.

    **Fields:** `answers`: the laws that hold in it; its `impulses`; the velocities `u` after it, and the `rate` of gaps
    and slips; the accelerations `udot` there without contacts and friction; contacts that are `resting`, and friction
    whose slip has `ended`; `gained`: twice the energy gained by the impulses, and the size of its summands; the
    `share`. Energies and shares are those of each law's group.
    """

    answers: Answers
    impulses: Float[Array, "laws"]
    u: Float[Array, "nu"]
    rate: Float[Array, "laws"]
    udot: Float[Array, "nu"]
    resting: Bool[Array, "contacts"]
    ended: Bool[Array, "frictions"]
    balance: Int[Array, "laws"] | None
    gained: tuple[Float[Array, "*laws"], Float[Array, "*laws"]]
    share: Float[Array, "*laws"]


class Round(NamedTuple):
    """The state of an event after some impulses and forces have been found.

    **Fields:** the `problem` of the next impulses or forces; `when` the event is; contacts that bounce too `low` to be
    resolved, and for how long (`rest`); `struck`: the impact; `answers`: the laws that hold with the `forces` after it;
    whether all problems were `solvable`; `rounds`: the number of rounds after which closed contacts and sticking
    friction are known; the `trial` of a share of the rebounds; by Poisson's law the `compression`, and `pushed`: its
    impulses plus the least impulses of the expansion.
    """

    problem: Problem
    when: When
    low: Bool[Array, "contacts"]
    rest: Float[Array, "contacts"]
    struck: Struck
    answers: Answers
    forces: Float[Array, "laws"]
    solvable: Bool[Array, ""]
    rounds: Int[Array, ""]
    trial: Trial
    compression: Phase | None
    pushed: Float[Array, "laws"] | None


class Moves(NamedTuple):
    """How velocities respond to impulses along the directions of contacts and friction, under the other constraints.

    **Fields:** `rows`, the derivatives of the rates of gaps and slips by velocities; the `projector` on the other
    constraints; `by_unit`, the changes of velocities by unit impulses, and `answers`, the impulses of the other
    constraints in response; `jump`, the change that the other constraints need themselves.
    """

    rows: Float[Array, "laws nu"]
    projector: Any
    by_unit: Float[Array, "laws nu"]
    answers: Float[Array, "laws acceleration_rows"]
    jump: Float[Array, "nu"]

    @classmethod
    def at(cls, at: Instant) -> "Moves":
        """The moves at an instant."""
        rows, unmet = at.contact_place.gradients, at.velocity_rows
        projector = other_rows(at).projector(at.inertia)
        # The last entry has no impulse.
        impulses = jnp.concatenate([rows, jnp.zeros_like(rows[:1])])
        asked = jnp.concatenate([jnp.zeros((len(rows), unmet.size), rows.dtype), -unmet[None]])
        moves, answers = jax.vmap(projector.solve)(impulses, asked)
        return cls(rows, projector, moves[:-1], answers[:-1], moves[-1])


@dataclasses.dataclass(frozen=True, eq=False)
class Impacting:
    """An event at a state. Each round first finds impulses, in one phase or in the two of Poisson's law, and then the
    forces after them.

    In the first round the impulse is zero; its forces are the forces before the event, which determine the event's
    time.

    **Fields:** the instant `at`; `tolerance` [m, rad]; the `modes`; the `moves`; the `laws`; `slow`: the velocity up to
    which slip in a plane has ended.
    """

    at: Instant
    formulation: AbstractFormulation
    tolerance: ContactTolerance
    modes: Modes
    moves: Moves
    laws: Laws
    slow: Float[Array, ""]

    @classmethod
    def of(cls, at: Instant, formulation, tolerance: ContactTolerance) -> "Impacting":
        contacts, moves = at.system.contacts, Moves.at(at)
        laws = Laws.of(at, moves.rows @ moves.by_unit.T)
        return cls(at, formulation, tolerance, contacts.modes(at.q), moves, laws, tolerance.slow(at.system, at.u))

    @property
    def system(self) -> AbstractEquation:
        return self.at.system

    @property
    def contacts(self) -> ContactSet:
        return self.system.contacts

    @property
    def gap(self) -> Float[Array, "contacts"]:
        """The gaps."""
        return self.at.contact_place.gaps

    @property
    def rates(self) -> Float[Array, "laws"]:
        """The rates of gaps and slips."""
        return self.at.contact_motion.rates

    @property
    def influence(self) -> Float[Array, "laws laws"]:
        """The changes of the rates of gaps and slips by unit impulses."""
        return self.laws.influence

    @property
    def in_groups(self) -> bool:
        """Whether there can be several groups."""
        return self.contacts.in_groups

    @property
    def phases(self) -> int:
        """The number of phases of an impact."""
        return max(self.contacts.phases, default=1)

    @property
    def turns(self) -> int:
        """The number of problems in a round."""
        return self.phases + 1

    def rates_at(self, u):
        """The rates of gaps and slips at other velocities."""
        return self.rates + self.moves.rows @ (u - self.at.u)

    def sizes_of_rates(self, *velocities):
        """The sizes of the summands of the rates at some velocities. Rates below their resolution are rounding errors:
        of bodies at rest all summands are.
        """
        return jnp.abs(self.moves.rows) @ add_up(map(jnp.abs, velocities)) + self.tolerance.slowest / REST

    def accelerated(self, u):
        """Accelerations without contacts and friction, as `u̇` and along the laws' directions. Also the reactions of the
        joints with friction: without forces along the laws, and by a unit force along each.
        """
        at = self.at.with_(u=u)
        udot, multipliers, opening = free_accelerations(at, self.formulation, self.moves.projector)
        if not self.contacts.of_reactions:
            return udot, opening, None
        at, answers = self.contacts.stuck(at, self.moves.answers)
        return udot, opening, jax.vmap(at.friction_reactions)(jnp.concatenate([multipliers[None], answers]))

    # The time of the event

    def at_event(self, before, curve) -> When:
        """The next zero of a gap or slip, by the accelerations `before` it and the accelerations along the laws."""
        n, system = self.contacts.n, self.system
        until, about_to = self.zeros(curve)
        # A zero far off in time does not count: its rates are rounding errors.
        largest = jnp.maximum(jnp.abs(self.at.u), jnp.abs(before))
        speed = jnp.max(largest / system.velocity_scale()) * system.length
        about_to = about_to & (jnp.abs(until) * speed <= self.tolerance.far)
        first = jnp.argmin(jnp.where(about_to, until, jnp.inf))
        hits = about_to[first]
        late = jnp.where(hits, until[first], 0.0)
        closes = about_to[:n] & (np.arange(n) == first)
        shut = self.contacts.sharing.shut(self.modes, self.gap, self.tolerance.near)
        touching = shut | closes | (self.gap + late * self.rates[:n] <= self.tolerance.touch)
        at = self.at.u + late * before
        zeros = (until, about_to) if self.in_groups else None
        return When(late, first, hits, before, at, self.rates_at(at), touching, zeros)

    def zeros(self, curve):
        """The times until gaps and slips are zero, and which are about to be zero.

        **Arguments:** `curve`: the second derivatives of gaps, and the accelerations of slips.
        """
        n, gap, closing = self.contacts.n, self.gap, self.rates[: self.contacts.n]
        about_to = self.modes.open & (gap <= self.tolerance.near) & (closing < 0)
        # The first zero of a parabola.
        root = jnp.sqrt(jnp.maximum(closing**2 - 2 * curve[:n] * gap, 0.0))
        until = 2 * gap / (root + jnp.where(about_to, -closing, 1.0))
        if not self.contacts.m:
            return until, about_to
        slides, slip, slowing = self.slips(self.rates[n:], curve[n:])
        least = jnp.where(self.contacts.in_pairs, 2 * self.slow, self.tolerance.near)
        ends = slides & (slip <= least) & (slowing < 0)
        until = jnp.concatenate([until, -slip / jnp.where(ends, slowing, 1.0)])
        return until, jnp.concatenate([about_to, ends])

    def slips(self, rates, curve):
        """Which friction may come to rest, its velocity of slip, and the rate of that velocity, along its modes.

        Friction in two directions has these values at its first law.
        """
        modes, pairs = self.modes, self.contacts.pairs
        single = modes.slides, modes.of_friction * rates, modes.of_friction * curve
        if not pairs:
            return single
        in_plane, both = modes.in_plane, of_pairs(pairs)
        along = in_plane.modes / jnp.where(in_plane.size > 0, in_plane.size, 1.0)[:, None]
        may = in_plane.slips & (norm(rates[both]) <= 2 * self.slow)
        of_both = may, jnp.sum(along * rates[both], axis=1), jnp.sum(along * curve[both], axis=1)
        return tuple(for_first(pairs, *values) for values in zip(of_both, single, strict=True))

    # The turns of a round

    def closing(self, when: When):
        """The rates at which gaps close, zero for others."""
        return jnp.maximum(-when.at[: self.contacts.n], 0.0)

    def impulse_of(self, when: When, low, share, reactions) -> Problem:
        """The problem of the impulses. Contacts that are `low` do not bounce, others bounce with a share of the whole
        rebound; by Poisson's law none bounces at the end of compression.
        """
        share = of_contacts(share, self.contacts.n)
        back = jnp.where(low, 0.0, share * self.at.contact_laws.normal.ask("rebound", self.closing(when)))
        approach = when.at + self.moves.rows @ self.moves.jump - jnp.pad(back, (0, self.contacts.m))
        if self.contacts.pairs:
            # Rounding errors have no direction.
            approach = jnp.where(jnp.abs(approach) <= REST * self.sizes_of_rates(when.u), 0.0, approach)
        return self.laws.of_impulses(approach, when.touching, reactions)

    def moved(self, k, when: When, impulses):
        """The velocities after impulses; in the first round there is no event yet."""
        return when.u + jnp.where(k < self.turns, 0.0, self.moves.jump) + impulses @ self.moves.by_unit

    def expand(self, k, before: Round, answers, impulses) -> Round:
        """The end of the compression, and the problem of the expansion: impulses beyond the least ones."""
        when = before.when
        again = self.at.contact_laws.normal.ask("pushed", impulses[: self.contacts.n], self.closing(when))
        again = jnp.where(before.low, 0.0, of_contacts(before.trial.share, self.contacts.n) * again)
        u = self.moved(k, when, impulses)
        free = before.problem.free + self.influence @ impulses
        free = jnp.where(jnp.abs(free) <= REST * self.sizes_of_rates(u, when.u), 0.0, free)
        held = jnp.concatenate([answers.closed, answers.sticks])
        return before._replace(
            problem=self.laws.of_expansion(free, again, when.touching, before.problem.reactions),
            compression=Phase(u, held, answers.slips, impulses),
            pushed=impulses + jnp.pad(again, (0, self.contacts.m)),
            solvable=answers.solvable,
        )

    def strike(self, k, before: Round, answers, impulses) -> Round:
        """The velocities after an impulse, and the problem of the forces there."""
        when, n, solvable = before.when, self.contacts.n, answers.solvable
        if before.pushed is not None:
            impulses, solvable = before.pushed + impulses, solvable & before.solvable
        after = self.moved(k, when, impulses)
        rate = self.rates_at(after)
        udot, opening, reactions = self.accelerated(after)
        sizes = self.sizes_of_rates(after, when.u)
        resting = when.touching & ((rate[:n] <= REST * sizes[:n]) | before.low)
        ended, slips = self.slips_left(rate[n:], sizes[n:])
        balance = self.groups(when.touching, resting, ended, jnp.zeros_like(ended))
        last = before.struck.balance
        if balance is not None and last is not None:
            # While shares are searched, their groups stay.
            balance = jnp.where(jnp.any(before.trial.again), last, balance)
        gained = group_sums(balance, impulses * (when.at + rate))
        size = group_sums(balance, jnp.abs(impulses) * (jnp.abs(when.at) + jnp.abs(rate)))
        of_share = balance, (gained, size), before.trial.share
        struck = Struck(answers, impulses, after, rate, udot, resting, ended, *of_share)
        forces = self.laws.of_forces(opening, reactions, resting, rate[n:], slips, self.modes, before.forces)
        return before._replace(problem=forces, struck=struck, solvable=solvable)

    def groups(self, touching, resting, ended, turned):
        """The group of each law in an event, if there can be several.

        **Arguments:** contacts that are `touching`, and `resting` after it; friction whose slip has `ended`; friction
        in joints whose mode has `turned`. Other friction in joints passes nothing on.
        """
        if not self.in_groups:
            return None
        acting = jnp.concatenate([touching, jnp.where(self.contacts.in_joints, turned, self.laws.may(touching))])
        stays = jnp.concatenate([self.modes.shut & resting, self.modes.held & ended])
        return groups_of(self.contacts, self.influence, acting, stays)

    def slips_left(self, rate, sizes):
        """Which friction no longer slips, and the directions of the other slips."""
        # Slip below the resolution has ended.
        speed = self.laws.sizes(rate)
        least = jnp.where(self.contacts.in_pairs, 2 * self.slow, self.tolerance.near)
        ended = (speed <= REST * self.laws.sizes(sizes)) | (speed <= least)
        return ended, jnp.where(ended, 0.0, rate / jnp.where(ended, 1.0, speed))

    def begin(self, k, before: Round, answers, forces) -> Round:
        """The time of the event, by the equations before it, and the problem of its impulses."""
        del k, answers
        udot, curve = before.struck.udot + forces @ self.moves.by_unit, before.problem.free + self.influence @ forces
        when = self.at_event(udot, curve)
        problem = self.impulse_of(when, before.low, before.trial.share, before.problem.reactions)
        return before._replace(problem=problem, when=when)

    def settle(self, k, before: Round, answers, forces) -> Round:
        """The laws that hold after an impact with their forces, and the problem of the impulses in a further round. In
        that round, other contacts may bounce too low to be resolved.
        """
        struck, curve = before.struck, before.problem.free + self.influence @ forces
        low, rest = self.low_bounces(before, curve[: self.contacts.n], k == 2 * self.turns - 1)
        # Without low bounces, and without forces that depend on others, a second round would give the same result.
        rounds = before.rounds if self.contacts.of_reactions else jnp.where(jnp.any(low), 2, 1)
        trial = next_trial(before.trial, *struck.gained, k // self.turns - rounds)
        return before._replace(
            problem=self.impulse_of(before.when, low, trial.share, before.problem.reactions),
            rounds=rounds,
            trial=trial,
            low=low,
            rest=rest,
            answers=answers,
            forces=forces,
            solvable=before.solvable & answers.solvable,
        )

    def low_bounces(self, before: Round, curve, is_first):
        """Contacts whose next bounce in the first round is below the resolution, and the times until they rest.

        **Arguments:** `curve`: the second derivatives of the gaps.
        """
        when, struck, rate = before.when, before.struck, before.struck.rate[: self.contacts.n]
        closing = self.closing(when)
        restitution = self.at.contact_laws.normal.ask("ratio", closing)
        falls = jnp.where(curve < 0, -curve, 1.0)
        opens = rate**2 <= 2 * falls * self.tolerance.bounce
        low = when.touching & ~struck.resting & (curve < 0) & opens & (restitution < 1)
        low = jnp.where(is_first, low, before.low)
        # Each bounce takes `restitution` times as long as the previous bounce.
        bounces = low & (restitution * closing > self.tolerance.slowest)
        ratio = jnp.where(bounces, restitution, 0.0)
        rest = jnp.where(bounces, 2 * rate / (falls * (1 - ratio)), 0.0)
        return low, jnp.where(is_first, rest, before.rest)

    # The rounds

    def start(self) -> Round:
        """The state before the first round."""
        n, m, in_rounds = self.contacts.n, self.contacts.m, self.contacts.of_reactions
        dtype, u = self.at.u.dtype, self.at.u
        none, one, yes = jnp.zeros(n + m, dtype), jnp.ones((), dtype), jnp.array(True)
        each, balance, zeros = one, None, None
        if self.in_groups:
            each, balance, zeros = 1 + none, jnp.zeros(n + m, int), (none, none > 0)
        no, idle = Answers(none[:n] > 0, none[n:] > 0, none[n:], yes, none[n:] > 0), none[:n] > 0
        reactions = jax.tree.map(jnp.zeros_like, jax.eval_shape(self.accelerated, u)[2])
        return Round(
            problem=self.laws.of_impulses(none, idle, reactions),
            when=When(0 * one, jnp.argmin(none), ~yes, u, u, self.rates, idle, zeros),
            low=idle,
            rest=none[:n],
            struck=Struck(no, none, u, none, u, idle, none[n:] > 0, balance, (each, each), each),
            answers=no,
            forces=none,
            solvable=yes,
            rounds=jnp.array(_ROUNDS if in_rounds else 1),
            trial=Trial(each, Bracket(0 * each, each, 0 * each, each, jnp.zeros(each.shape, int)), each < 0),
            compression=Phase(u, none > 0, none[n:], none) if self.phases == 2 else None,
            pushed=none if self.phases == 2 else None,
        )

    def goes_on(self, carry):
        """Whether the round has further turns, or another round follows."""
        k, last = carry
        extra_rounds = k // self.turns - 1 - last.rounds
        return (k % self.turns != 0) | (extra_rounds < 0) | (jnp.any(last.trial.again) & (extra_rounds < _TRIALS))

    def advance(self, carry):
        """The next turn; the program for impulses or forces is compiled once."""
        k, last = carry
        turns = self.turns
        answers, by_modes = self.laws.answers(last.problem), self.laws.of_modes(self.modes, self.rates)
        answers = jax.tree.map(lambda by_modes, values: jnp.where(k == turns - 1, by_modes, values), by_modes, answers)
        values = self.laws.solved(last.problem, answers)
        turn = k % turns
        which = jnp.where((turn == turns - 1) & (k >= turns), turns, turn)
        does = [self.expand, self.strike, self.begin, self.settle][2 - self.phases :]
        return k + 1, lax.switch(which, does, k, last, answers, values)

    def event(self) -> Event:
        """The event, after all rounds."""
        _, settled = lax.while_loop(self.goes_on, self.advance, (jnp.array(0), self.start()))
        when, struck = settled.when, settled.struck
        modes, implied = self.new_modes(settled)
        held, lost = self.lost(settled, implied)
        after = struck.u + lost @ self.moves.by_unit
        kinetic = lambda u: jnp.dot(u, self.at.inertia.product(u))
        impulses = self.seen(struck.impulses, self.sizes_of_rates(after, when.u))
        # Without an impulse, the kinetic energy changes by rounding errors.
        energy = jnp.where(jnp.any(impulses != 0), 0.5 * (kinetic(when.u) - kinetic(after)), 0.0)
        group, first, hits = self.firsts(settled, modes)
        return Event(
            late=when.late,
            group=group,
            balance=struck.balance,
            first=first,
            hits=hits,
            before=when.before,
            after=struck.udot + settled.forces @ self.moves.by_unit,
            at=when.u,
            u=after,
            held=held,
            low=settled.low,
            slips=struck.answers.slips,
            impulses=impulses,
            modes=(self.modes.numbers, modes),
            rest=jnp.pad(settled.rest, (0, self.contacts.m)),
            energy=energy,
            solvable=settled.solvable & self.contacts.sharing.determined(self.laws, settled, implied, self.slow),
            share=struck.share,
            compression=self.compressed(settled.compression),
        )

    def firsts(self, settled: Round, modes):
        """The group of each law, the gap or slip that is zero first in it, and whether there is one."""
        when, struck, contacts = settled.when, settled.struck, self.contacts
        if when.zeros is None:
            return None, when.first, when.hits
        after = contacts.as_modes(modes)
        before, now = (numbers.kinds[contacts.n :] for numbers in (self.modes, after))
        group = self.groups(when.touching, struck.resting & after.shut, struck.ended & after.held, before != now)
        until, about_to = when.zeros
        return group, *least_in_group(group, about_to & jnp.concatenate([when.touching, struck.ended]), until)

    def seen(self, impulses, sizes):
        """The impulses, with zeros for rounding errors."""
        return jnp.where(jnp.abs(jnp.diag(self.influence) * impulses) <= REST * sizes, 0.0, impulses)

    def independent(self, laws):
        """As many of the given laws as are independent of each other."""
        return laws & independent_components(self.influence, laws)

    def compressed(self, phase: Phase | None) -> Phase | None:
        return None if phase is None else phase._replace(held=self.independent(phase.held))

    def new_modes(self, settled: Round):
        """The modes after the event, and contacts whose closure other contacts imply."""
        n, struck, last = self.contacts.n, settled.struck, settled.answers
        implied = struck.resting & ~last.closed & is_implied(self.influence[:n, :n], last.closed)
        of_contacts = modes_of_contacts(last.closed, implied)
        begun = struck.ended & self.contacts.in_pairs
        of_friction = modes_of_friction(last.sticks, last.implied, last.slips, begun)
        return jnp.concatenate([of_contacts, of_friction]).astype(self.at.q.dtype), implied

    def lost(self, settled: Round, implied):
        """Which laws hold the velocities after the event, and the impulses that remove the rates left by rounding
        errors, low bounces and ended slips.
        """
        n, m, struck, last = self.contacts.n, self.contacts.m, settled.struck, settled.answers
        staying, rate, is_held = struck.resting, struck.rate, struck.answers.closed | settled.low
        if m:
            # Slips that have ended are exactly zero. Slip in two directions begins at rest.
            rests = last.sticks | (self.contacts.in_pairs & struck.ended & (last.slips != 0))
            is_held = jnp.concatenate([is_held | last.closed, rests | struck.answers.sticks])
            rates_left = jnp.concatenate([jnp.where(staying, rate[:n], 0.0), jnp.where(rests, rate[n:], 0.0)])
            cancelled = is_held & jnp.concatenate([staying, rests])
        else:
            rates_left, cancelled = jnp.where(staying, rate, 0.0), is_held & settled.low
        is_held = self.independent(is_held)
        cancelled = is_held & cancelled
        if m:
            # Otherwise bodies that move side by side would approach, too slowly beside slips to close their contact.
            # Each step would then end with an event.
            drifts = jnp.pad(staying & ~is_held[:n] & ~implied & (rate[:n] < 0), (0, m))
            cancelled = self.independent(cancelled | drifts)
        return is_held, jnp.where(cancelled, solved_components(self.influence, rates_left, cancelled), 0.0)
