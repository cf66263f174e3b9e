"""Events within an integration: steps end where a guard becomes negative, and the motion goes on from there.

A guard is a function of time and state that is positive as long as the equations are those of the moment. A step that
finds one negative at its end, or in between, is tried again up to the first zero of the step's own interpolant. A step
that ends at a zero is followed by a restart, as after a jump; what changes there is left to the term, by `after_jump`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._compat import any_of_batch
from .controller import AbstractControllerState, intended_step, states_inside
from .evaluation import ravel
from .manifold_term import AbstractGuards

# A zero is found to this fraction of a step, or in this many evaluations.
_FRACTION, _EVALUATIONS = 1e-13, 60
# Where a guard is zero at the start of a step as well, its rise there is looked for down to this power of two.
_HALVINGS = 30


class Crossing(NamedTuple):
    """What a solver tells an `EventController`, as its `y_error`.

    **Fields:** the `error` for the controller inside; the `target`: the time of the first zero in the step; one where a
    guard is negative `within` the step, and otherwise zero, since diffrax expects no truth values in an error; the
    `lowest` guard at its end; one where a guard is `falling` through zero there; `touch` and `near` of the guards.
    """

    error: PyTree
    target: Any
    within: Float[Array, ""]
    lowest: Float[Array, ""]
    falling: Float[Array, ""]
    touch: Float[Array, ""]
    near: Float[Array, ""]


def crossing(
    guards: AbstractGuards, direction: Any, error: PyTree, step: tuple[Any, Any], ends: tuple[Any, Any], at: Callable
) -> Crossing:
    """Look for zeros of guards in a step.

    **Arguments:** `direction` of time; `step`: its first and last time, in the solver's; `ends`: the states there;
    `at(t)`: a state in between.
    """
    t0, t1 = step
    sign = jnp.asarray(direction, t0.dtype)
    values = lambda t, y: guards.values(t * sign, y)
    rates = lambda t, y: guards.rates(t * sign, y) * sign.astype(ravel(y).dtype)
    v0, v1, r0, r1 = values(t0, ends[0]), values(t1, ends[1]), rates(t0, ends[0]), rates(t1, ends[1])
    below, inside = v1 < -guards.touch, (r0 < 0) & (r1 > 0) & jnp.isfinite(r0) & (v1 >= -guards.touch)
    state = lambda s: at(t0 + s * (t1 - t0))

    def search():
        value = lambda s: values(t0 + s * (t1 - t0), state(s))
        # A guard whose rate changes its sign has its least value there.
        most = jnp.argmin(jnp.where(inside, v0 + v1, jnp.inf))
        rate = lambda s: rates(t0 + s * (t1 - t0), state(s))[most]
        lowest = _zero(rate, *(jnp.asarray(x, t0.dtype) for x in (0.0, 1.0)), r0[most], r1[most])
        dips = jnp.any(inside) & (value(lowest)[most] < -guards.touch)
        looked_at = below | (dips & (jnp.arange(v0.size) == most))
        least = lambda s: jnp.min(jnp.where(looked_at, value(s), jnp.inf))
        end = jnp.where(jnp.any(below), 1.0, lowest).astype(t0.dtype)
        start, end = _rising(least, jnp.min(jnp.where(looked_at, v0, jnp.inf)) > guards.touch, end)
        found = _zero(least, start, end, least(start), least(end))
        return t0 + found * (t1 - t0), dips

    look = jnp.any(below | inside)
    target, dips = lax.cond(any_of_batch(look), search, lambda: (t1, jnp.array(False)))
    falling = jnp.any((jnp.abs(v1) <= guards.touch) & (r1 < 0))
    within, falling = (x.astype(v1.dtype) for x in (dips & look, falling))
    touch, near = (jnp.asarray(x, v1.dtype) for x in (guards.touch, guards.near))
    return Crossing(error, jnp.where(look, target, t1), within, jnp.min(v1), falling, touch, near)


def _rising(least, positive, end):
    """An interval whose end is a zero or behind it and before whose start there is none, from one that starts at
    zero.
    """

    def halved(carry):
        s, _, k = carry
        return s / 2, s, k + 1

    def proceed(carry):
        s, _, k = carry
        return (least(s) <= 0) & (k < _HALVINGS)

    start, end, _ = lax.while_loop(
        lambda carry: ~positive & proceed(carry), halved, (end / 2, end, jnp.array(0))
    )
    return jnp.where(positive, 0.0, start), end


def _zero(function, a, b, fa, fb):
    """The end of a short interval in which a function changes its sign, from a longer one, on the side of `b`.

    Source: M. Dowell and P. Jarratt, "A modified regula falsi method for computing the root of an equation", BIT 11,
    1971 (the Illinois method).
    """

    def proceed(carry):
        a, b, _, fb, k = carry
        return (jnp.abs(b - a) > _FRACTION) & (fb != 0) & (k < _EVALUATIONS)

    def advance(carry):
        a, b, fa, fb, k = carry
        slope = fb - fa
        secant = (a * fb - b * fa) / jnp.where(slope == 0, 1.0, slope)
        inside = (secant - a) * (secant - b) < 0
        # Every third interval is halved, so that the number of evaluations is bounded.
        middle = jnp.where(inside & (slope != 0) & (k % 3 != 2), secant, 0.5 * (a + b))
        f = function(middle)
        same = jnp.sign(f) == jnp.sign(fb)
        # `b` stays the side of the negative values: where the new point is on the other side, `a` moves.
        a, fa = jnp.where(same, a, middle), jnp.where(same, fa * 0.5, f)
        b, fb = jnp.where(same, middle, b), jnp.where(same, f, fb * 0.5)
        return a, b, fa, fb, k + 1

    fa, fb = fa.astype(a.dtype), fb.astype(a.dtype)
    return lax.while_loop(proceed, advance, (a, b, fa, fb, jnp.array(0)))[1]


class EventState(AbstractControllerState):
    """The state of `EventController`.

    **Fields:** that of the controller `inner`; the `target` of the step that is tried, infinite without one; the
    `count` of events, their `times` and the raveled `states` before them, in buffers.
    """

    inner: Any
    target: Any
    count: Any
    times: Float[Array, " events"]
    states: Float[Array, "events n"]

    @property
    def intended(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return intended_step(self.inner)


class EventController(diffrax.AbstractAdaptiveStepSizeController):
    """A controller around another one, whose steps end at events; at most `most` of them.

    Too many events end the solve with `diffrax.RESULTS.event_occurred`.
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

    def wrap(self, direction):
        return eqx.tree_at(lambda c: c.controller, self, self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        first, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        flat = ravel(y0)
        # The last entry of the buffers is written where there is no event.
        times = jnp.full(self.most + 1, jnp.inf, t0.dtype)
        states = jnp.zeros((self.most + 1, flat.size), flat.dtype)
        return first, EventState(inner, jnp.asarray(jnp.inf, t0.dtype), jnp.array(0), times, states)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error: Any, error_order, controller_state):
        before, found = controller_state, y_error
        keep, next_t0, next_t1, made_jump, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, found.error, error_order, before.inner
        )
        meant = t1 == before.target
        at_zero = jnp.where(meant, (found.lowest <= found.near) & (found.lowest >= -found.near), found.falling > 0)
        crossed = (found.within > 0) | ((found.lowest < -found.touch) & ~at_zero)
        again, ends = keep & crossed, keep & at_zero & ~crossed
        # The controller inside does not learn of a step that was good but too long.
        inner = jax.tree.map(lambda new, old: jnp.where(again, old, new), inner, before.inner)
        next_t0, next_t1 = jnp.where(again, t0, next_t0), jnp.where(again, found.target, next_t1)
        target = jnp.where(again, found.target, jnp.inf)
        place = jnp.where(ends, jnp.minimum(before.count, self.most), self.most)
        state = EventState(
            inner,
            target,
            before.count + ends,
            before.times.at[place].set(t1),
            before.states.at[place].set(ravel(y1_candidate)),
        )
        full = ends & (before.count >= self.most)
        result = diffrax.RESULTS.where(full, diffrax.RESULTS.event_occurred, result)
        return keep & ~crossed, next_t0, next_t1, made_jump | ends, state, result


def events_found(controller_state: Any) -> EventState | None:
    """What an `EventController` found, from the state of a controller that may be wrapped around it."""
    found = states_inside(controller_state, EventState)
    return found[0] if found else None
