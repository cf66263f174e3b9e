"""Which contacts are closed, and which dry friction sticks or slips, also in planes with circular cones.

Source, for the direction of slip: P. Alart and A. Curnier, "A mixed formulation for frictional contact problems prone
to Newton like solution methods", Computer Methods in Applied Mechanics and Engineering 92, 1991.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..linalg.complementarity import independent_components, reduced
from ..linalg.elimination import solve
from ..linalg.pairs import for_both, of_pairs, placed_pairs
from ..linalg.rotations import norm
from .dry_laws import Answers, Dry, in_lines, laws_of

# The search for directions of slip ends when they change by less than `_TURN`, or after `_TURNS` rounds. A round has
# `_CORRECTIONS` steps of Newton's method.
_TURN, _TURNS, _CORRECTIONS = 1e-7, 60, 2
# The least limit of a force across its direction, as a fraction of its limit along it.
_ACROSS = 0.01
# There is no solution if a force of friction in two directions is off the direction of slip by this fraction.
_ASIDE = 1e-8
# Several contacts that stick share undetermined forces as if they yielded by this fraction of `W`.
_YIELD = 1e-8


def frictional(W: Float[Array, "n_m n_m"], b: Float[Array, "n_m"], dry: Dry, among: Bool[Array, "n_m"]) -> Answers:
    """Which contacts with dry friction are closed, stick and slip; without derivative.

    **Arguments:** `W x + b`: accelerations or velocities along the normals and the slips, with their forces or impulses
    x; `among`: the laws that may have a force.
    """
    W, b, among, *numbers = lax.stop_gradient((W, b, among, *dry[2:]))
    dry = Dry(dry.contact_of, dry.pairs, *numbers)
    return SlipSearch.of(W, b, dry, among).answers() if dry.pairs else in_lines(W, b, dry, among)


@dataclasses.dataclass(frozen=True, eq=False)
class SlipSearch:
    """The search for the directions of slip of friction in two directions.

    In each round the first law of a pair acts along a direction, the second across it. If the direction is right, the
    force of the second law is zero. Directions `e` are unit vectors, shape (pairs, 2).

    **Fields:** `rigid`: the matrix of the problem; `W`: a matrix with which several contacts that stick yield; `b`,
    `dry` and `among` as in `frictional`, but the second law of a pair is among them only if its direction is free
    (`may`); pairs whose contact `touches`; `step`: the inverse of the largest change of a slip by its force; `turns`:
    two matrices for each pair which, times the components of its direction, turn the pair.
    """

    rigid: Float[Array, "n_m n_m"]
    W: Float[Array, "n_m n_m"]
    b: Float[Array, "n_m"]
    dry: Dry
    among: Bool[Array, "n_m"]
    touches: Bool[Array, "pairs"]
    may: Bool[Array, "pairs"]
    step: Float[Array, "pairs"]
    turns: Float[np.ndarray, "pairs 2 n_m n_m"]

    @classmethod
    def of(cls, W, b, dry: Dry, among) -> "SlipSearch":
        pairs, laws = of_pairs(dry.pairs), np.arange(b.size)
        n = b.size - len(dry.contact_of)
        both = n + pairs
        touches = among[both[:, 0]]
        may = touches & (dry.slips[pairs] == 0).all(1)
        of_pair = placed_pairs(dry.pairs, jnp.stack([touches, may], axis=1), among[n:])
        rigid = W
        if len(pairs) > 1:
            # Normal forces are undetermined only where contacts imply each other.
            normals = among & (laws < n)
            shared = jnp.any(normals & ~independent_components(W, normals))
            yields = np.isin(laws, both) | (normals & shared)
            W = W + _YIELD * jnp.max(jnp.diag(W)) * jnp.diag(yields.astype(W.dtype))
        step = 1 / (W[both[:, 0], both[:, 0]] + W[both[:, 1], both[:, 1]])
        turns = np.zeros((len(pairs), 2, b.size, b.size), W.dtype)
        for turn, (i, j) in zip(turns, both, strict=True):
            turn[0, [i, j], [i, j]], turn[1, [i, j], [j, i]] = 1, (1, -1)
        return cls(rigid, W, b, dry, jnp.concatenate([among[:n], of_pair]), touches, may, step, turns)

    @property
    def n(self) -> int:
        """The number of contacts."""
        return self.b.size - len(self.dry.contact_of)

    @property
    def pairs(self) -> Int[np.ndarray, "pairs 2"]:
        return of_pairs(self.dry.pairs)

    @property
    def both(self) -> Int[np.ndarray, "pairs 2"]:
        """The numbers of both laws of each pair, among all laws."""
        return self.n + self.pairs

    @property
    def contact(self) -> Int[np.ndarray, "pairs"]:
        return np.array(self.dry.contact_of)[self.pairs[:, 0]]

    @property
    def given_slips(self) -> Float[Array, "pairs 2"]:
        """The given directions of slip."""
        return self.dry.slips[self.pairs]

    def answers(self) -> Answers:
        """The laws that hold."""
        start, m = self.start(), len(self.dry.contact_of)
        nothing = jnp.zeros(m, self.b.dtype)
        none = Answers(jnp.zeros(self.n, bool), nothing > 0, nothing, jnp.array(True), nothing > 0)
        first = start, none, jnp.zeros_like(self.b), jnp.array(jnp.inf, self.b.dtype), jnp.array(0)
        goes_on = lambda carry: (carry[3] > _TURN) & (carry[4] < _TURNS)
        _, answers, x, turned, _ = lax.while_loop(goes_on, self.advance, first)
        result, slides = self.with_slips(answers, self.direction(start, x))
        if len(self.pairs) > 1:
            result = with_implied(self.rigid, result)
        solvable = result.solvable & (turned <= _TURN) & ~jnp.any(slides & self.misses(result, x))
        return result._replace(solvable=solvable & jnp.all(jnp.isfinite(x)))

    def start(self) -> Float[Array, "pairs 2"]:
        """The given directions; for the others, the directions of slip without forces."""
        e = jnp.where(self.may[:, None], self.b[self.both], self.given_slips)
        size = norm(e)[:, None]
        return jnp.where(size > 0, e / jnp.where(size > 0, size, 1.0), jnp.array([1.0, 0.0], self.b.dtype))

    def advance(self, carry):
        """One round: the laws that hold along and across the directions, then Newton's method."""
        e, _, _, _, count = carry
        # The limit across decreases with each round, so that the rectangle of both approaches the circle.
        answers, *straight = self.in_lines(e, jnp.maximum(0.5**count, _ACROSS))

        def correct(k, iterate):
            last = self.direction(*iterate)
            e = jnp.where(k == 0, iterate[0], last)
            newton = self.corrected(answers, e, iterate[1])
            matrix, right = (jnp.where(k == 0, first, other) for first, other in zip(straight, newton, strict=True))
            return e, solve(matrix, right)

        _, x = lax.fori_loop(0, 1 + _CORRECTIONS, correct, (e, jnp.zeros_like(self.b)))
        new = self.direction(e, x)
        # If the method alternates between two directions, their mean is next.
        between = e + new
        size = norm(between)
        halved = (count % 4 == 3) & (size > 0.1)
        turned = jnp.max(jnp.abs(new - e))
        new = jnp.where(halved[:, None], between / jnp.where(size > 0, size, 1.0)[:, None], new)
        return new, answers, x, turned, count + 1

    def in_lines(self, e, across):
        """The answers if pairs act along and across directions, and the equations for the forces. The limit of a force
        across is `across` times the limit along.
        """
        n, m, dry = self.n, len(self.dry.contact_of), self.dry
        unpaired = np.diag(~np.isin(np.arange(n + m), self.both)).astype(self.W.dtype)
        turn = jnp.tensordot(e, self.turns, 2) + unpaired
        matrix, right = turn @ self.W @ turn.T, turn @ self.b
        share = jnp.where(np.isin(np.arange(m), self.pairs[:, 1]), across, 1.0)
        slips = turn[n:, n:] @ dry.slips
        laws = dry._replace(slips=slips, coefficient=dry.coefficient * share, bound=dry.bound * share)
        answers = in_lines(matrix, right, laws, self.among)
        matrix, right = laws_of(matrix, right, laws, answers)
        return answers, matrix @ turn, right

    def direction(self, e, x):
        """The direction of slip if the force is the point of the cone nearest to the force that would end the slip."""
        ahead = self.step[:, None] * (self.W @ x + self.b)[self.both] - x[self.both]
        size = norm(ahead)
        return jnp.where((self.may & (size > 0))[:, None], ahead / jnp.where(size > 0, size, 1.0)[:, None], e)

    def with_slips(self, answers: Answers, e) -> tuple[Answers, Bool[Array, "pairs"]]:
        """The answers with the laws of stick and slip of pairs, and which pairs slide in unknown directions."""
        pairs, dry = self.pairs, self.dry
        # The last entry is for friction without a contact.
        sticks, closed = answers.sticks[pairs].all(1), jnp.concatenate([answers.closed, jnp.ones(1, bool)])
        pressed = closed[self.contact] | (dry.bound[pairs[:, 0]] > 0)
        slips = jnp.where(self.may[:, None], e, self.given_slips)
        slips = jnp.where((self.touches & pressed & ~sticks)[:, None], slips, 0.0)
        slips = placed_pairs(dry.pairs, slips, answers.slips)
        both_stick = for_both(dry.pairs, sticks, answers.sticks)
        return answers._replace(sticks=both_stick, slips=slips), self.may & pressed & ~sticks

    def corrected(self, answers: Answers, e, x):
        """The equations of a step of Newton's method for the directions of slip and the forces."""
        dry, both = self.dry, self.both
        laws, slides = self.with_slips(answers, e)
        matrix, right = laws_of(self.W, self.b, dry, laws)
        # Along the direction the law of slip holds. Across it, force and slip are zero.
        across = jnp.stack([-e[:, 1], e[:, 0]], axis=1)
        along = jnp.einsum("pi,pik->pk", e, matrix[both])
        turned, asked = self.across(e, across, x)
        rows = e[:, :, None] * along[:, None] + across[:, :, None] * turned[:, None]
        asked = e * jnp.sum(e * right[both], axis=1)[:, None] + across * asked[:, None]
        both_slide = for_both(dry.pairs, slides, jnp.zeros(len(dry.contact_of), bool))
        are_slides = jnp.concatenate([jnp.zeros(self.n, bool), both_slide])
        rows = placed_pairs(dry.pairs, rows, matrix[self.n :], first=self.n)
        asked = placed_pairs(dry.pairs, asked, right[self.n :], first=self.n)
        return jnp.where(are_slides[:, None], rows, matrix), jnp.where(are_slides, asked, right)

    def across(self, e, across, x):
        """The equations of forces and slips across the directions."""
        first, both = self.pairs[:, 0], self.both
        push = jnp.where(self.contact >= 0, jnp.maximum(x[self.contact], 0.0), 0.0)
        load = self.dry.bound[first] + self.dry.coefficient[first] * push
        speed = jnp.abs(jnp.sum(e * (self.W @ x + self.b)[both], axis=1))
        size = load / self.step + speed + jnp.finfo(self.b.dtype).tiny
        one = np.eye(self.b.size, dtype=self.b.dtype)
        turned = (load / size)[:, None] * jnp.einsum("pi,pik->pk", across, self.W[both])
        turned = turned + (speed / size)[:, None] * jnp.einsum("pi,pik->pk", across, one[both])
        return turned, -load / size * jnp.sum(across * self.b[both], axis=1)

    def misses(self, answers: Answers, x) -> Bool[Array, "pairs"]:
        """Pairs whose force differs from the direction of slip, or does not oppose it."""
        e, both = answers.slips[self.pairs], self.both
        rates = (self.W @ x + self.b)[both]
        aside, back = jnp.abs(e[:, 0] * x[both[:, 1]] - e[:, 1] * x[both[:, 0]]), jnp.sum(e * rates, axis=1)
        return (aside > _ASIDE * jnp.max(jnp.abs(x))) | (back < -_ASIDE * jnp.max(jnp.abs(self.b)))


def with_implied(W: Float[Array, "n_m n_m"], answers: Answers) -> Answers:
    """The answers with as many closed contacts as are independent of each other, and as many laws of stick as are
    independent of each other and of the contacts.
    """
    n, sticks = answers.closed.size, answers.sticks
    closed = independent_components(W, jnp.concatenate([answers.closed, jnp.zeros_like(sticks)]))
    independent = independent_components(reduced(W, closed)[n:, n:], sticks)
    return answers._replace(closed=closed[:n], sticks=independent, implied=sticks & ~independent)
