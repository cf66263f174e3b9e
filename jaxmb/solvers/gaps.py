"""Steps that would pass over a force which sets in and ends within them.

A method sees a force where it evaluates the equations, mostly at the ends of steps. It would miss a contact that closes
and opens again in between. So the gaps in which forces act are followed along the interpolant of each step. A step that
hides a contact is tried again up to the time of least gap; all other steps are unchanged.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._branches import loop_of_lanes
from .manifold_term import AbstractGaps

# A stretch of a step is examined in this many pieces; stretches that hide nothing grow by this factor.
_PIECES, _GROWTH = 8, 4.0
# A contact is hidden if it is this many times deeper than at both ends of the step. It is also hidden if its depth
# differs by this fraction from the cubic polynomial through gaps and rates at both ends.
_DEEPER, _OFF = 2.0, 0.2
# Depths below this fraction of the width in which a force sets in do not count (the depth of a ramp at a distance of
# 25 000 widths). Depths below the next fraction may differ from the polynomial: the contact is not closed yet.
_FAINT, _NEAR = 1e-5, 0.25
# Pieces this short, relative to the step, are not divided; after this many looks the step is shortened.
_SHORTEST, _LOOKS = 1e-9, 256
# The uncertainty of a gap is this many times its difference from the integral of its rates. A step that may hide a
# contact within the uncertainty is halved: the additional stages of an interpolant may have seen a force.
_UNCERTAIN = 2.0


class Hidden(NamedTuple):
    """What a step hides: the `target`, the time up to which the step may go; whether it `hides` a force."""

    target: Any
    hides: Bool[Array, ""]


class _Ends(NamedTuple):
    """Gaps and their rates, in units of the step, at both ends of the step, and the widths in which forces set in."""

    first: Any
    last: Any
    first_rate: Any
    last_rate: Any
    widths: Any


class _Walk(NamedTuple):
    """The progress along a step, whose times are fractions of it.

    **Fields:** the `start` and the `length` of the next stretch; the `ends` of the step; by how much gaps are
    `uncertain`; whether the step `hides` a force; `target`: the time up to which the step may go; the number of
    `looks`.
    """

    start: Any
    length: Any
    ends: _Ends
    uncertain: Any
    hides: Any
    target: Any
    looks: Any


def hidden(gaps: AbstractGaps, direction: Any, step: tuple[Any, Any], y1: Any, at: Any) -> Hidden:
    """Search for forces that a step hides.

    **Arguments:** `direction` of time; `step`: its first and last time, in the solver's time; `y1`: the state at its
    end; `at(t)`: a state in between.
    """
    t0, t1 = step
    sign = jnp.asarray(direction, t0.dtype)

    def seen(s):
        t = t0 + s * (t1 - t0)
        y = jax.tree.map(lambda end, inside: jnp.where(s == 1, end, inside), y1, at(t))
        return gaps.seen(t * sign, y)

    # Rates in the direction of the solver, and in units of the step.
    unit = (t1 - t0) * sign

    def advance(walk):
        s = jnp.minimum(walk.start + walk.length * jnp.linspace(0.0, 1.0, _PIECES + 1, dtype=t0.dtype), 1.0)
        sight = jax.vmap(seen)(s)
        rates = sight.rates * unit.astype(sight.rates.dtype)
        seen_ends = _Ends(sight.gaps[0], sight.gaps[-1], rates[0], rates[-1], sight.widths[0])
        ends = jax.tree.map(lambda new, old: jnp.where(walk.looks == 0, new, old), seen_ends, walk.ends)
        pace = sight.pace * (t1 - t0).astype(sight.pace.dtype)
        return _advanced(walk._replace(ends=ends), s, sight.gaps, rates, pace, gaps.touch)

    zero, one = jnp.zeros_like(t0), jnp.ones_like(t0)
    none = jax.eval_shape(seen, t0).gaps
    none = jnp.zeros(none.shape, none.dtype)
    first = _Walk(zero, one, _Ends(none, none, none, none, none), none, jnp.array(False), one, jnp.array(0))
    goes = lambda walk: (walk.start < 1) & ~walk.hides
    # Most steps of most lanes need one look.
    last = loop_of_lanes(lambda walk: goes(walk) & (walk.looks < 2), goes, advance, first)
    return Hidden(t0 + last.target * (t1 - t0), last.hides)


def _advanced(walk: _Walk, s, gaps, rates, pace, touch) -> _Walk:
    """One stretch further, or into the first piece of this stretch that may hide a force.

    **Arguments:** at times `s` in the step the `gaps`, their `rates` in units of the step, and the `pace`.
    """
    ends, piece = walk.ends, walk.length / _PIECES
    # A gap that changes by less than the width in which its force sets in hides nothing in a step. A difference there
    # is a jump of the gap itself, as of an angle that wraps.
    varies = (jnp.max(jnp.abs(rates), axis=0) > jnp.maximum(_NEAR * ends.widths, touch))[None]
    score = jnp.max(_score(ends, s, gaps, varies, touch), axis=1)
    deepest = jnp.argmax(score)
    width = piece.astype(gaps.dtype)
    least = _least(gaps, rates, width)
    fast = jnp.maximum(pace[:-1], pace[1:]) * width > 1
    divided = (jnp.any(_deeper(ends, least, touch), axis=1) | fast) & (piece > _SHORTEST)
    passed = jnp.cumsum(divided) == 0
    unlike = jnp.where(passed[1::2, None], _unlike(gaps, rates, width), 0.0)
    uncertain = walk.uncertain + jnp.sum(unlike, axis=0)
    doubtful = jnp.any(_deeper(ends, least - _UNCERTAIN * uncertain[None], touch) & varies, axis=1)
    looks, start = walk.looks + 1, jnp.where(passed[-1], s[-1], s[jnp.argmax(divided)])
    length = jnp.minimum(jnp.where(passed[-1], _GROWTH * walk.length, piece), 1 - start)
    hides, wrong, tired = score[deepest] > 0, jnp.any(doubtful & passed), (looks >= _LOOKS) & (start < 1)
    shorter = jnp.where(wrong, 0.5, jnp.where(tired, jnp.maximum(start, piece), 1.0))
    target = jnp.where(hides, s[deepest], shorter)
    return _Walk(start, length, ends, uncertain, hides | wrong | tired, target, looks)


def _score(ends: _Ends, s, gaps, varies, touch):
    """How much deeper contacts are than the ends of the step show, at times of the step; zero where nothing is hidden.
    Contacts that do not vary are hidden only where they are deeper than at both ends.
    """
    s, widths = s.astype(gaps.dtype)[:, None], ends.widths[None]
    depth, first, last = (_depth(gap, widths) for gap in (gaps, ends.first[None], ends.last[None]))
    most = jnp.maximum(first, last)
    shown = _depth(_cubic(ends, s), widths)
    beyond = jnp.maximum(depth - jnp.maximum(shown, most), jnp.minimum(shown, jnp.minimum(first, last)) - depth)
    size = jnp.maximum(depth, most)
    off = (size > _NEAR * widths + touch) & (beyond > _OFF * size) & varies
    return jnp.where(_deeper(ends, gaps, touch) | off, 1 + depth / (most + _FAINT * widths + touch), 0.0)


def _deeper(ends: _Ends, gaps, touch):
    """Where gaps are much further closed than at both ends of a step."""
    widths = ends.widths[None]
    most = jnp.maximum(_depth(ends.first[None], widths), _depth(ends.last[None], widths))
    return _depth(gaps, widths) > _DEEPER * jnp.maximum(most, _FAINT * widths + touch)


def _depth(gaps, widths):
    """The depth by which a gap is closed: a ramp as wide as the ramp of the force; a kink for a width of zero."""
    root = jnp.sqrt(gaps**2 + widths**2)
    outside = 0.5 * widths**2 / jnp.where(root > 0, root + jnp.abs(gaps), 1.0)
    return jnp.where(gaps < 0, 0.5 * (root - gaps), outside)


def _cubic(ends: _Ends, s):
    """The cubic polynomial with the gaps and rates at both ends of a step."""
    difference = (ends.last - ends.first)[None]
    first, last = ends.first_rate[None], ends.last_rate[None]
    return ends.first[None] + s * (
        first + s * (3 * difference - 2 * first - last + s * (first + last - 2 * difference))
    )


def _unlike(gaps, rates, piece):
    """The difference of gaps from the integral of their rates, by Simpson's rule, in pairs of pieces without a turn."""
    closes = rates < 0
    turns = (closes[:-2:2] != closes[1:-1:2]) | (closes[1:-1:2] != closes[2::2])
    integral = piece / 3 * (rates[:-2:2] + 4 * rates[1:-1:2] + rates[2::2])
    return jnp.where(turns, 0.0, jnp.abs(gaps[2::2] - gaps[:-2:2] - integral))


def _least(gaps, rates, piece):
    """Lower bounds of gaps in pieces between times. Gaps that close and open again are convex, as the distance from a
    convex body along a straight path. So the tangents at both ends meet at a lower bound.
    """
    (before, after), (closing, opening) = (gaps[:-1], gaps[1:]), (rates[:-1], rates[1:])
    turns = (closing < 0) & (opening > 0)
    way = jnp.clip((after - before - piece * opening) / jnp.where(turns, closing - opening, 1.0), 0.0, piece)
    least = jnp.minimum(before, after)
    return jnp.where(turns, jnp.minimum(before + closing * way, least), least)
