"""Events within an integration: steps end where a guard becomes negative, and the motion goes on from there.

A guard is a function of time and state that is positive as long as the equations are those of the moment. A step that
finds one negative at its end, or in between, is tried again up to the first zero of the step's own interpolant. A step
that ends at a zero is followed by a restart, as after a jump; what changes there is left to the term, by `after_jump`.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from .controller import AbstractControllerState, intended_step, states_inside
from .evaluation import ravel
from .manifold_term import AbstractGuards

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

# A zero is found to this fraction of a step, or in this many evaluations, by bisection after the first ones.
_FRACTION, _EVALUATIONS, _SECANTS = 1e-13, 60, 12
# A step ends at a zero that is this fraction of it from its end: its interpolant does not resolve a smaller one.
_END = 1e-9
# After an event that follows another one at once the next step is this fraction of the last one that was tried.
_SHORTER = 1e-2
# The result of a solve that ends since there is no state after an event.
NO_STATE: Any = diffrax.RESULTS.internal_error
# A guard that is as negative as this at the start of a run, of a state that is as exact as its digits, and rises, may
# take until the end of the step.
_OVERLAP = 1e-5
# Where a guard is zero at the start of a step as well, its rise there is looked for down to this power of two.
_HALVINGS = 30


class AbstractErrorWithMore(eqx.Module):
    """What a solver returns as its `y_error` that holds more than an `error` estimate."""

    error: AbstractVar[PyTree]


class Crossing(AbstractErrorWithMore):
    """What a solver tells an `EventController`, as its `y_error`.

    **Fields:** the `error` for the controller inside; the `target`: the time of the first zero in the step; one where a
    guard is negative `within` the step, and otherwise zero, since diffrax expects no truth values in an error; the
    `lowest` guard at its end; one where a guard is `falling` through zero there; one where the term has `lost` the
    motion at the start of the step: there was no state after an event, and it gave an infinite one; `touch` and
    `near` of the guards.
    """

    error: PyTree
    target: Any
    within: Float[Array, ""]
    lowest: Float[Array, ""]
    falling: Float[Array, ""]
    lost: Float[Array, ""]
    touch: Float[Array, ""]
    near: Float[Array, ""]


def error_of(y_error: Any) -> PyTree:
    """The error estimate in what a solver returns as its error."""
    return y_error.error if isinstance(y_error, AbstractErrorWithMore) else y_error


def map_error(function: Callable[[PyTree], Any], y_error: Any) -> Any:
    """What a solver returns as its error, with a function of the error estimate in it."""
    if not isinstance(y_error, AbstractErrorWithMore):
        return function(y_error)
    return eqx.tree_at(lambda y_error: y_error.error, y_error, function(y_error.error), is_leaf=lambda x: x is None)


# What the search in a step looks for: whether there is a zero in it, the least value of a guard, a point before the
# zero at which guards are positive, the zero; nothing more.
_LOOK, _DIP, _RISE, _ZERO, _DONE = range(5)


class Bracket(NamedTuple):
    """An interval from `a` to `b` in which a function changes its sign, with its values there; which end was `moved`
    last: -1 the first, 1 the second, 0 none.
    """

    a: Any
    b: Any
    of_a: Any
    of_b: Any
    moved: Any


class _Search(NamedTuple):
    """The search for the first zero in a step, whose times are fractions of it.

    **Fields:** the `phase`; `s`: where guards are evaluated next; the `bracket` of what changes its sign; which guards
    are `looked_at`, and which are `waiting` for that; guards and their rates at the end of the step; whether one is
    negative in its middle; the number of evaluations in this `phase`.
    """

    phase: Any
    s: Any
    bracket: Bracket
    looked_at: Any
    waiting: Any
    end: Any
    rates: Any
    dips: Any
    count: Any


def crossing(
    guards: AbstractGuards, direction: Any, error: PyTree, step: tuple[Any, Any], ends: tuple[Any, Any], at: Callable
) -> Crossing:
    """Look for zeros of guards in a step.

    **Arguments:** `direction` of time; `step`: its first and last time, in the solver's; `ends`: the states there;
    `at(t)`: a state in between.
    """
    (t0, t1), (y0, y1) = step, ends
    sign = jnp.asarray(direction, t0.dtype)
    start = guards.rates(t0 * sign, y0) * sign.astype(ravel(y0).dtype)

    def advance(search):
        # One evaluation for all that is looked for, so that the guards are compiled once.
        s, t = search.s, t0 + search.s * (t1 - t0)
        y = jax.tree.map(lambda end, inside: jnp.where(s == 1, end, inside), y1, at(t))
        values, rates = guards.values(t * sign, y), guards.rates(t * sign, y) * sign.astype(start.dtype)
        out = lax.switch(
            search.phase,
            [_looked, _dipped, _risen, _zero_found],
            search._replace(count=search.count + 1),
            values,
            rates,
            start,
            guards.touch,
        )
        return out

    none, one = jnp.zeros_like(start), jnp.ones((), t0.dtype)
    zero = jnp.zeros((), start.dtype)
    first = _Search(
        jnp.array(_LOOK),
        one,
        Bracket(jnp.zeros_like(one), one, zero, zero, jnp.array(0)),
        none > 0,
        none > 0,
        none,
        none,
        jnp.array(False),
        jnp.array(0),
    )
    found = lax.while_loop(lambda search: search.phase != _DONE, advance, first)
    falling = jnp.any((jnp.abs(found.end) <= guards.touch) & (found.rates < 0))
    lost = jnp.any(jnp.isinf(ravel(y0)))
    within, falling, lost = (x.astype(start.dtype) for x in (found.dips, falling, lost))
    touch, near = (jnp.asarray(x, start.dtype) for x in (guards.touch, guards.near))
    return Crossing(error, t0 + found.bracket.b * (t1 - t0), within, jnp.min(found.end), falling, lost, touch, near)


def _looked(search: _Search, values, rates, start, touch):
    """At the end of a step: guards that are negative, and those whose rate has changed its sign."""
    below = values < -touch
    inside = (start < 0) & (rates > 0) & jnp.isfinite(start) & ~below
    crosses = jnp.any(below)
    search = search._replace(waiting=inside & ~crosses, end=values, rates=rates)
    bracket = search.bracket._replace(of_b=jnp.min(jnp.where(below, values, jnp.inf)))
    risen = search._replace(
        phase=jnp.array(_RISE), s=search.s / 2, bracket=bracket, looked_at=below, count=jnp.array(0)
    )
    return jax.tree.map(lambda a, b: jnp.where(crosses, a, b), risen, _next_dip(search, start))


def _next_dip(search: _Search, start):
    """Before the search for the zero of the rate of the next guard that waits for it, of several the one that is least
    at the end of the step; the search is done where none does.
    """
    least = jnp.argmin(jnp.where(search.waiting, search.end, jnp.inf))
    own, one = jnp.arange(start.size) == least, jnp.ones_like(search.s)
    bracket = Bracket(jnp.zeros_like(one), one, start[least], search.rates[least], jnp.array(0))
    return search._replace(
        phase=jnp.where(jnp.any(search.waiting), _DIP, _DONE),
        s=0.5 * one,
        bracket=bracket,
        looked_at=own,
        waiting=search.waiting & ~own,
        count=jnp.array(0),
    )


def _dipped(search: _Search, values, rates, start, touch):
    """Towards the zero of a guard's rate, where it is least."""
    own = jnp.argmax(search.looked_at)
    again = _narrowed(search, rates[own])
    ends = _is_short(again)
    dips = ends & (values[own] < -touch)
    bracket = again.bracket._replace(a=jnp.zeros_like(search.s), b=search.s)
    risen = again._replace(
        phase=jnp.array(_RISE), s=search.s / 2, bracket=bracket, dips=jnp.array(True), count=jnp.array(0)
    )
    chosen = jax.tree.map(lambda a, b: jnp.where(ends, a, b), _next_dip(search, start), again)
    return jax.tree.map(lambda a, b: jnp.where(dips, a, b), risen, chosen)


def _risen(search: _Search, values, rates, start, touch):
    """Back from a point where guards are negative to one where they are positive; near the start there may be none."""
    del rates
    least = jnp.min(jnp.where(search.looked_at, values, jnp.inf))
    positive, ends = least > 0, search.count >= _HALVINGS
    before = search.bracket
    found = before._replace(a=search.s, of_a=least, moved=jnp.array(0))
    back = before._replace(a=jnp.zeros_like(search.s), b=search.s, of_b=least)
    bracket = jax.tree.map(lambda found, back: jnp.where(positive, found, back), found, back)
    # Those that have been negative all the time, and have risen, are not crossed here.
    overlap = search.looked_at & (values < -touch) & (values >= -_OVERLAP) & (start > 0) & (search.end >= values)
    eases = ends & ~positive & jnp.all(overlap | ~search.looked_at)
    return search._replace(
        phase=jnp.where(positive, _ZERO, jnp.where(ends, _DONE, _RISE)),
        s=jnp.where(positive, 0.5 * (bracket.a + bracket.b), search.s / 2),
        bracket=bracket._replace(b=jnp.where(eases, 1.0, bracket.b)),
        end=jnp.where(eases & overlap, jnp.maximum(search.end, 0.0), search.end),
        dips=search.dips & ~eases,
        count=jnp.where(positive, 0, search.count),
    )


def _zero_found(search: _Search, values, rates, start, touch):
    """Towards the first zero of guards, between a point where they are positive and one where one is negative."""
    del rates, start, touch
    again = _narrowed(search, jnp.min(jnp.where(search.looked_at, values, jnp.inf)))
    return again._replace(phase=jnp.where(_is_short(again), _DONE, _ZERO))


def _is_short(search: _Search):
    width = search.bracket.b - search.bracket.a
    return (width <= _FRACTION) | (search.bracket.of_b == 0) | (search.count >= _EVALUATIONS)


def _narrowed(search: _Search, value):
    """The shorter interval with a value at `s` in it, and where the next one is asked for."""
    bracket, s = narrowed(search.bracket, search.s, value, search.count >= _SECANTS, 0.5 * _FRACTION)
    return search._replace(bracket=bracket, s=s)


def narrowed(bracket: Bracket, s: Any, value: Any, bisects: Any, least: float = 0.0) -> tuple[Bracket, Any]:
    """An interval with a further value of the function in it, and where the next one is asked for.

    Source: M. Dowell and P. Jarratt, "A modified regula falsi method for computing the root of an equation", BIT 11,
    1971 (the Illinois method): where the same end moves twice, the value at the other one counts half.

    **Arguments:** `value` at `s`; `bisects`: whether the middle is next; `least`: how far the next point is from both
    ends, so that the interval becomes as short as that once one end is at the zero.
    """
    a, b, of_a, of_b, moved = bracket
    same = jnp.sign(value) == jnp.sign(of_b)
    halved_a, halved_b = jnp.where(moved > 0, 0.5 * of_a, of_a), jnp.where(moved < 0, 0.5 * of_b, of_b)
    a, of_a = jnp.where(same, a, s), jnp.where(same, halved_a, value)
    b, of_b = jnp.where(same, s, b), jnp.where(same, value, halved_b)
    slope = (of_b - of_a).astype(a.dtype)
    secant = (a * of_b.astype(a.dtype) - b * of_a.astype(a.dtype)) / jnp.where(slope == 0, 1.0, slope)
    secant = jnp.clip(secant, a + least, b - least)
    good = (secant > a) & (secant < b) & (slope != 0) & ~bisects
    return Bracket(a, b, of_a, of_b, jnp.where(same, 1, -1)), jnp.where(good, secant, 0.5 * (a + b))


class EventState(AbstractControllerState):
    """The state of `EventController`.

    **Fields:** that of the controller `inner`; the `target` of the step that is tried, infinite without one; the
    `length` that it had before it was made to end there; the `count` of events, their `times` and the raveled `states`
    before them, in buffers; `touch` of the guards.
    """

    inner: Any
    target: Any
    length: Any
    count: Any
    times: Float[Array, " events"]
    states: Float[Array, "events n"]
    touch: Float[Array, ""]

    @property
    def intended(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return intended_step(self.inner)


class EventController(diffrax.AbstractAdaptiveStepSizeController):
    """A controller around another one, whose steps end at events; at most `most` of them.

    Too many events end the solve with `diffrax.RESULTS.dt_min_reached`, and one after which there is no state with
    `NO_STATE`.
    """

    controller: Any
    most: int = eqx.field(static=True)

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.norm

    def __init__(self, controller: Any, most: int):
        self.controller = controller
        self.most = most

    def wrap(self, direction):
        return eqx.tree_at(lambda c: c.controller, self, self.controller.wrap(direction))

    def init(self, terms, t0: Any, t1, y0, dt0, args, func, error_order):
        first, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        flat = ravel(y0)
        # The last entry of the buffers is written where there is no event.
        times = jnp.full(self.most + 1, jnp.inf, t0.dtype)
        states = jnp.zeros((self.most + 1, flat.size), flat.dtype)
        touch = jnp.zeros((), flat.dtype)
        none = jnp.asarray(jnp.inf, t0.dtype), jnp.zeros((), t0.dtype), jnp.array(0)
        return first, EventState(inner, *none, times, states, touch)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error: Any, error_order, controller_state):
        before, found = controller_state, y_error
        keep, next_t0, next_t1, made_jump, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, found.error, error_order, before.inner
        )
        # Compilers round what is computed in two places twice.
        meant = jnp.abs(t1 - before.target) <= 4 * jnp.finfo(before.target.dtype).eps * jnp.abs(t1)
        close = (t1 - found.target) <= _END * (t1 - t0)
        at_zero = jnp.where(meant, jnp.abs(found.lowest) <= found.near, found.falling > 0)
        at_zero = at_zero | (close & (found.lowest < -found.touch))
        crossed = (found.within > 0) | ((found.lowest < -found.touch) & ~at_zero)
        again, ends = keep & crossed, keep & at_zero & ~crossed
        # The controller inside does not learn of a step that was good but too long, nor of one without a length, where
        # one event follows another at once.
        empty = t1 <= t0
        inner = jax.tree.map(lambda new, old: jnp.where(again | empty, old, new), inner, before.inner)
        next_t0, next_t1 = jnp.where(again, t0, next_t0), jnp.where(again, found.target, next_t1)
        length = jnp.where(jnp.isinf(before.target), t1 - t0, before.length)
        next_t1 = jnp.where(empty & ~again, t1 + _SHORTER * length, next_t1)
        target = jnp.where(again, found.target, jnp.inf)
        place = jnp.where(ends, jnp.minimum(before.count, self.most), self.most)
        state = EventState(
            inner,
            target,
            length,
            before.count + ends.astype(before.count.dtype),
            before.times.at[place].set(t1),
            before.states.at[place].set(ravel(y1_candidate)),
            found.touch,
        )
        full = ends & (before.count >= self.most)
        result = diffrax.RESULTS.where(full, diffrax.RESULTS.dt_min_reached, result)
        lost = found.lost > 0
        result = diffrax.RESULTS.where(lost, NO_STATE, result)
        return keep & ~crossed & ~lost, next_t0, next_t1, made_jump | ends, state, result


def events_found(controller_state: Any) -> EventState | None:
    """What an `EventController` found, from the state of a controller that may be wrapped around it."""
    found = states_inside(controller_state, EventState)
    return found[0] if found else None
