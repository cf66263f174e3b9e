"""Events within an integration: steps end where a guard becomes negative, and the motion goes on from there.

A guard is a function of time and state that is positive as long as the present equations hold. A step with a negative
guard at its end, or in between, is tried again up to the first zero of the step's interpolant. A step that ends at a
zero is followed by a restart, as after a jump; the term's `after_jump` makes the changes there.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._branches import cond_of_any_lane, cond_of_lanes, loop_of_lanes
from .controller import AbstractControllerAround, AbstractControllerState, intended_step, states_inside
from .directed import next_number
from .evaluation import ravel
from .manifold_term import AbstractGuards
from .packing import Layout, switch

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

# A zero is found to this fraction of a step, or in this many evaluations, by bisection after the first few.
_FRACTION, _EVALUATIONS, _SECANTS = 1e-13, 60, 12
# A zero this fraction of a step before its end counts as at the end: the interpolant resolves no smaller distance.
_END = 1e-9
# After an event that follows another one at once, the next step is this fraction of the last attempted step.
_SHORTER = 1e-2
# At the middle of a step, gaps must follow a cubic polynomial and forces the mean of both ends, up to the first two
# fractions. Otherwise the step is halved, at most `_HALVED` times in a row, since guards may jump. If the differences
# exceed a hundredth of that, or if a force varies, the next step is at most twice as long: a longer one could hide a
# repetition.
_COARSE, _BENT, _HALVED, _NOT_SMOOTH, _VARIES, _GROWTH = 0.25, 0.05, 4, 0.01, 0.4, 2.0
# The next start has this share of the length that the error of the last start allows.
_START_SAFETY = 0.92
# The least size of forces, relative to the largest.
_FAINT = 1e-3
# The result of a solve that ends because an event leads to no state.
NO_STATE: Any = diffrax.RESULTS.internal_error
# At the start of a run a guard may be this negative, by rounding of the given state, if it rises in the step.
_OVERLAP = 1e-5
# If a guard is zero at the start of a step as well, a point with a positive guard is searched in so many halvings.
_HALVINGS = 30


class AbstractErrorWithMore(eqx.Module):
    """The `y_error` of a solver that holds more than an `error` estimate."""

    error: AbstractVar[PyTree]


class Crossing(AbstractErrorWithMore):
    """The `y_error` that a solver passes to an `EventController`; flags are 1 or 0, as diffrax expects.

    **Fields:** the `error` for the controller inside; `target`: the time of the first zero in the step; `within`: 1 if
    a guard is negative within the step; the `lowest` guard at its end; `falling`: 1 if a guard falls through zero
    there; `lost`: 1 if an event at its start led to no state, and the state is infinite; `coarse`: above 1 if the step
    is too long for guards that vary in it; `touch` and `near` of the guards; `retry`: the factor by which a multistep
    method could retry the step, infinite for methods without restarts; `idle`: 1 if the jump at its start changed
    nothing.
    """

    error: PyTree
    target: Any
    within: Float[Array, ""]
    lowest: Float[Array, ""]
    falling: Float[Array, ""]
    lost: Float[Array, ""]
    coarse: Float[Array, ""]
    touch: Float[Array, ""]
    near: Float[Array, ""]
    retry: Float[Array, ""]
    idle: Float[Array, ""]


def error_of(y_error: Any) -> PyTree:
    """The error estimate in a solver's `y_error`."""
    return error_of(y_error.error) if isinstance(y_error, AbstractErrorWithMore) else y_error


def map_error(function: Callable[[PyTree], Any], y_error: Any) -> Any:
    """A solver's `y_error`, with a function applied to the error estimate in it."""
    if not isinstance(y_error, AbstractErrorWithMore):
        return function(y_error)
    within = map_error(function, y_error.error)
    return eqx.tree_at(lambda y_error: y_error.error, y_error, within, is_leaf=lambda x: x is None)


def cond_of_jumps(guards: AbstractGuards | None) -> Callable:
    """The `lax.cond` for a restart: members of a batch jump together, but have events at different times."""
    return cond_of_any_lane if guards is None else cond_of_lanes


# The phases of the search in a step. `_LOOK`: at its ends and middle; `_LEAST`: at the least force; `_DIP`: for the
# zero of a guard's rate; `_RISE`: for a point with positive guards before a zero; `_ZERO`: for the zero.
_LOOK, _LEAST, _DIP, _RISE, _ZERO, _DONE = range(6)
# Guards are evaluated first at these points, all at once: one point takes nearly as long. Later evaluations, which few
# steps need, repeat one point three times.
_POINTS = np.array([1.0, 0.5, 0.0])


class Bracket(NamedTuple):
    """An interval from `a` to `b` in which a function changes its sign, with its values at both ends.

    **Fields:** `moved`: the end that moved last: -1 the first, 1 the second, 0 none.
    """

    a: Any
    b: Any
    of_a: Any
    of_b: Any
    moved: Any


class _Search(NamedTuple):
    """The search for the first zero in a step. Times are fractions of the step.

    **Fields:** the `phase`; `s`: the next point of evaluation; `bracket`: of the function that changes its sign; which
    guards are `looked_at`, and which are `waiting`; the guards and their `rates` at the `end` of the step, the guards
    and their `slopes` at its `middle`, the rates at its `start`; `begins`: see `AbstractGuards`; `dips`: whether a
    guard is negative within the step; how `coarse` the step is; `count`: evaluations in this phase.
    """

    phase: Any
    s: Any
    bracket: Bracket
    looked_at: Any
    waiting: Any
    end: Any
    rates: Any
    middle: Any
    slopes: Any
    start: Any
    begins: Any
    dips: Any
    coarse: Any
    count: Any


def crossing(
    guards: AbstractGuards,
    direction: Any,
    error: PyTree,
    step: tuple[Any, Any],
    ends: tuple[Any, Any, Any],
    at: Callable,
    made_jump: Any,
    retry: Any = jnp.inf,
) -> Crossing:
    """Search for zeros of guards in a step.

    **Arguments:** `direction` of time; `step`: its first and last time, in the solver's time; `ends`: the states at its
    start before and after a jump, and at its end; `at(t)`: a state in between; `made_jump`: whether the step starts
    with a jump; `retry`: see `Crossing`.
    """
    (t0, t1), (before, y0, y1) = step, ends
    sign, forces = jnp.asarray(direction, t0.dtype), guards.forces(y0)
    none, one = jnp.zeros(forces.shape, ravel(y0).dtype), jnp.ones((), t0.dtype)
    step_data = _StepData(forces, (t1 - t0).astype(none.dtype), guards.touch, guards.near)

    def guarded(s):
        t = t0 + s * (t1 - t0)
        inside = lambda y0, y1, y: jnp.where(s == 0, y0, jnp.where(s == 1, y1, y))
        t, y = t * sign, jax.tree.map(inside, y0, y1, at(t))
        seen = guards.seen(t, y)
        return seen._replace(rates=seen.rates * sign.astype(none.dtype))

    def advance(packed):
        # One evaluation for all phases, so that the guards are compiled once.
        search = layout.unpacked(packed)
        points = jnp.where(search.phase == _LOOK, _POINTS.astype(t0.dtype), search.s)
        values, rates, begins = jax.vmap(guarded)(points)
        if begins is not None:
            # A guard grows if it rises in the middle and at the end.
            begins = begins[2] & (rates[0] > 0) & (rates[1] > 0)
            begins = jnp.where(search.phase == _LOOK, begins, search.begins)
        search = search._replace(begins=begins, count=search.count + 1)
        phases = [_looked, _least_found, _dipped, _risen, _zero_found]
        phases = [lambda *given, at_phase=at_phase: layout.packed(at_phase(*given)) for at_phase in phases]
        return lax.switch(search.phase, phases, search, values, rates, step_data)

    zero, no = jnp.zeros((), none.dtype), jnp.array(False)
    bracket = Bracket(jnp.zeros_like(one), one, zero, zero, jnp.array(0))
    begins = None if jax.eval_shape(guards.seen, t0 * sign, y0).begins is None else none > 0
    first = _Search(
        phase=jnp.array(_LOOK),
        s=one,
        bracket=bracket,
        looked_at=none > 0,
        waiting=none > 0,
        end=none,
        rates=none,
        middle=none,
        slopes=none,
        start=none,
        begins=begins,
        dips=no,
        coarse=zero,
        count=jnp.array(0),
    )
    # In few vectors, since the loop copies each array.
    layout = Layout(first)
    # Each lane evaluates its guards at a few points; few lanes have a zero to find.
    phase = lambda packed: layout.unpacked(packed).phase
    looks, goes = lambda packed: phase(packed) <= _LEAST, lambda packed: phase(packed) != _DONE
    last = layout.unpacked(loop_of_lanes(looks, goes, advance, layout.packed(first)))
    falling = jnp.any((jnp.abs(last.end) <= guards.touch) & (last.rates < 0))
    lost = jnp.any(jnp.isinf(ravel(y0)))
    idle = made_jump & ~guards.changed(before, y0)
    falling, lost, within, idle = (x.astype(none.dtype) for x in (falling, lost, last.dips, idle))
    touch, near, retry = (jnp.asarray(x, none.dtype) for x in (guards.touch, guards.near, retry))
    target = t0 + last.bracket.b * (t1 - t0)
    return Crossing(error, target, within, jnp.min(last.end), falling, lost, last.coarse, touch, near, retry, idle)


class _StepData(NamedTuple):
    """The data of a step for the search.

    **Fields:** `forces`: which guards are forces; `length` of the step; `touch`: the size that counts as zero; `near`:
    the same at the end of a step that was made to end at a zero.
    """

    forces: Any
    length: Any
    touch: Any
    near: Any


def _looked(search: _Search, values, rates, step_data):
    """The guards at the end, the middle and the start of a step.

    Looks for guards that are negative in the middle and for guards that are least within one of the halves. The step is
    coarse if forces vary, or if a guard's rate in the middle differs from the rate of a cubic polynomial. The
    polynomial follows from the rates at both ends, the value at the end and the value in the middle.
    """
    (last, values, first), (ends, rates, start) = values, rates
    search = search._replace(s=0.5 * search.s, end=last, rates=ends, middle=values, slopes=rates, start=start)
    search = search._replace(count=jnp.zeros_like(search.count))
    dips, risen = _negative_within(search, values, step_data)
    watched = jnp.isfinite(start) & jnp.isfinite(ends)
    at_start, at_end = step_data.length * start, step_data.length * ends
    cubic = 4 * (0.125 * at_start + 0.375 * at_end - (search.end - values))
    expected = at_start + 0.5 * (at_end - at_start - 3 * cubic) + 0.75 * cubic
    off = jnp.abs(expected - step_data.length * rates)
    size = jnp.maximum(jnp.minimum(jnp.abs(values), jnp.abs(search.end)), step_data.touch)
    # A guard at whose zero the step was made to end has no size there.
    counts = watched & (jnp.abs(search.end) > step_data.near)
    coarse = jnp.max(jnp.where(counts, off / (_COARSE * size), 0.0), initial=0.0)
    turns = jnp.where(rates > 0, start < 0, ends > 0)
    waiting = turns & watched & jnp.isfinite(rates) & (search.end >= -step_data.touch)
    search = search._replace(coarse=coarse, waiting=waiting)
    return _chosen(dips, risen, _next_force(search, first, step_data))


def _next_force(search: _Search, first, step_data):
    """The step is coarse where forces vary much, or not linearly. The search goes on at the least point of the force
    whose parabola is lowest there, if this is near zero. The parabola goes through the values at the start (`first`),
    in the middle and at the end.
    """
    middle, last = search.middle, search.end
    bent, sloped = 2 * (first + last - 2 * middle), 4 * middle - 3 * first - last
    least_at = jnp.where(bent > 0, -sloped / jnp.where(bent > 0, 2 * bent, 1.0), 0.0)
    inside = step_data.forces & (least_at > 0) & (least_at < 1)
    least = jnp.where(inside, first + 0.5 * sloped * least_at, jnp.inf)
    lowest = jnp.argmin(least)
    varies = jnp.maximum(jnp.abs(first - middle), jnp.abs(last - middle))
    size = jnp.maximum(jnp.max(jnp.abs(jnp.stack([first, middle, last])), axis=0), _FAINT)
    off = jnp.maximum(0.25 * jnp.abs(bent) / _BENT, _VARIES * varies) / size
    # A step that was made to end at a zero may be that long, whatever forces do.
    counts = step_data.forces & jnp.all(jnp.abs(last) > step_data.near)
    search = search._replace(coarse=jnp.maximum(search.coarse, jnp.max(jnp.where(counts, off, 0.0), initial=0.0)))
    looks = search._replace(
        phase=jnp.array(_LEAST), s=least_at[lowest].astype(search.s.dtype), looked_at=jnp.arange(least.size) == lowest
    )
    return _chosen(least[lowest] < _COARSE, looks, _next_dip(search, step_data))


def _least_found(search: _Search, values, rates, step_data):
    """At the point where a force is about least in the step."""
    del rates
    dips, risen = _negative_within(search, values[0], step_data)
    return _chosen(dips, risen, _next_dip(search, step_data))._replace(count=jnp.zeros_like(search.count))


def _negative_within(search: _Search, values, step_data):
    """Whether guards are negative at a point within the step, and if so, the search back from there."""
    below = values < -step_data.touch
    if search.begins is not None:
        below = below & ~search.begins
    bracket = search.bracket._replace(b=search.s, of_b=jnp.min(jnp.where(below, values, jnp.inf)))
    dips = jnp.any(below)
    return dips, search._replace(phase=jnp.array(_RISE), s=search.s / 2, bracket=bracket, looked_at=below, dips=dips)


def _chosen(condition, one: _Search, other: _Search) -> _Search:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def _next_dip(search: _Search, step_data):
    """The search for the zero of the rate of the next waiting guard: the guard that is lowest at the end of the step.
    Without a waiting guard, guards that are negative at the end are next, or else the search is done.
    """
    least = jnp.argmin(jnp.where(search.waiting, search.end, jnp.inf))
    guard, half = jnp.arange(search.start.size) == least, 0.5 * jnp.ones_like(search.s)
    # In the first half if the guard rises at the middle.
    middle, first = search.slopes[least], search.slopes[least] > 0
    of_a, of_b = jnp.where(first, search.start[least], middle), jnp.where(first, middle, search.rates[least])
    turn = Bracket(jnp.where(first, 0.0, half), jnp.where(first, half, 2 * half), of_a, of_b, jnp.array(0))
    dip = search._replace(
        phase=jnp.array(_DIP),
        s=0.5 * (turn.a + turn.b),
        bracket=turn,
        looked_at=guard,
        waiting=search.waiting & ~guard,
        count=jnp.array(0),
    )
    below = search.end < -step_data.touch
    of_end = Bracket(
        0 * half, 2 * half, jnp.zeros_like(of_a), jnp.min(jnp.where(below, search.end, jnp.inf)), dip.count
    )
    back = search._replace(
        phase=jnp.where(jnp.any(below), _RISE, _DONE), s=half, bracket=of_end, looked_at=below, count=jnp.array(0)
    )
    return _chosen(jnp.any(search.waiting), dip, back)


def _dipped(search: _Search, values, rates, step_data):
    """Towards the zero of a guard's rate, where the guard is least."""
    (values, _, _), (rates, _, _), guard = values, rates, jnp.argmax(search.looked_at)
    again = _narrowed(search, rates[guard])
    ends = _is_short(again)
    dips = ends & (values[guard] < -step_data.touch)
    # From rates to values of the guard.
    bracket = again.bracket._replace(a=jnp.zeros_like(search.s), b=search.s, of_b=values[guard])
    risen = again._replace(
        phase=jnp.array(_RISE), s=search.s / 2, bracket=bracket, dips=jnp.array(True), count=jnp.array(0)
    )
    return _chosen(dips, risen, _chosen(ends, _next_dip(search, step_data), again))


def _risen(search: _Search, values, rates, step_data):
    """Back from a point with negative guards to a point with positive ones, which may not exist near the start."""
    del rates
    values = values[0]
    least = jnp.min(jnp.where(search.looked_at, values, jnp.inf))
    positive, ends = least > 0, search.count >= _HALVINGS
    before = search.bracket
    forwards = before._replace(a=search.s, of_a=least, moved=jnp.array(0))
    back = before._replace(a=jnp.zeros_like(search.s), b=search.s, of_b=least)
    bracket = jax.tree.map(lambda forwards, back: jnp.where(positive, forwards, back), forwards, back)
    # Guards that were negative all the time, and have risen, have no zero here.
    overlap = search.looked_at & (values < -step_data.touch) & (values >= -_OVERLAP)
    overlap = overlap & (search.start > 0) & (search.end >= values)
    eases = ends & ~positive & jnp.all(overlap | ~search.looked_at)
    return search._replace(
        phase=jnp.where(positive, _ZERO, jnp.where(ends, _DONE, _RISE)),
        s=jnp.where(positive, 0.5 * (bracket.a + bracket.b), search.s / 2),
        bracket=bracket._replace(b=jnp.where(eases, 1.0, bracket.b)),
        end=jnp.where(eases & overlap, jnp.maximum(search.end, 0.0), search.end),
        dips=search.dips & ~eases,
        count=jnp.where(positive, 0, search.count),
    )


def _zero_found(search: _Search, values, rates, step_data):
    """Towards the first zero, between a point with positive guards and a point with a negative one."""
    del rates, step_data
    again = _narrowed(search, jnp.min(jnp.where(search.looked_at, values[0], jnp.inf)))
    return again._replace(phase=jnp.where(_is_short(again), _DONE, _ZERO))


def _is_short(search: _Search):
    width = search.bracket.b - search.bracket.a
    return (width <= _FRACTION) | (search.bracket.of_b == 0) | (search.count >= _EVALUATIONS)


def _narrowed(search: _Search, value):
    """The search with its interval shortened by a value at `s`, and with the next point of evaluation."""
    bracket, s = narrowed(search.bracket, search.s, value, search.count >= _SECANTS, 0.5 * _FRACTION)
    return search._replace(bracket=bracket, s=s)


def narrowed(bracket: Bracket, s: Any, value: Any, bisects: Any, least: float = 0.0) -> tuple[Bracket, Any]:
    """An interval shortened by a further value of the function in it, and the next point of evaluation.

    Source: M. Dowell and P. Jarratt, "A modified regula falsi method for computing the root of an equation", BIT 11,
    1971 (the Illinois method). If the same end moves twice, the value at the other end counts half.

    **Arguments:** `value` at `s`; `bisects`: whether the middle is next; `least`: the least distance of the next point
    from both ends, so that the interval becomes that short once one end is at the zero.
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

    **Fields:** `inner`: the state of the controller inside; `target`: the time of a zero at which the attempted step is
    made to end, else infinite; `length` of the attempted step before it was shortened; the `count` of events, their
    `times` and the raveled `states` before them, in buffers; `touch` of the guards; `halved`: how many times in a row a
    step was halved; `starts`: whether the method restarts with this step; `start`: the length that the error of the
    last start allows; `ended`: whether the last step ended at an event or a jump that is recorded.
    """

    inner: Any
    target: Any
    length: Any
    count: Any
    times: Float[Array, " events"]
    states: Float[Array, "events n"]
    touch: Float[Array, ""]
    halved: Any
    starts: Any
    start: Any
    ended: Any

    @property
    def intended(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return intended_step(self.inner)


class EventController(AbstractControllerAround):
    """Wraps a controller so that steps end at events, at most `most` events.

    Jumps at known times, by a `diffrax.ClipStepSizeController` around this one, are recorded as events as well, just
    after them, since contacts and friction may change there. Those without a change take no place.

    The solve ends with `diffrax.RESULTS.dt_min_reached` after too many events, and with `NO_STATE` if an event leads to
    no state.
    """

    controller: Any
    most: int = eqx.field(static=True)
    jumps: Float[Array, " jumps"] | None

    def __init__(self, controller: Any, most: int, jumps: ArrayLike | None = None):
        if not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
            raise ValueError(
                f"With contacts or dry friction steps end at events, which {type(controller).__name__} does not allow: "
                "leave out stepsize_controller, and bound steps by simulate(..., dtmax=0.01)."
            )
        self.controller = controller
        self.most = most
        self.jumps = None if jumps is None else jnp.asarray(jumps)

    def wrap(self, direction):
        jumps = None if self.jumps is None else self.jumps * direction
        return EventController(self.controller.wrap(direction), self.most, jumps)

    def _jump_after(self, t):
        """Whether the controller around this one ends a step at a time to make a jump, and the time after it."""
        if self.jumps is None:
            return jnp.array(False), t
        at = (self.jumps > t) & (self.jumps <= next_number(next_number(t, 1), 1))
        return jnp.any(at), next_number(jnp.min(jnp.where(at, self.jumps, jnp.inf)), 1)

    def init(self, terms, t0: Any, t1, y0, dt0, args, func, error_order):
        first, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        flat = ravel(y0)
        # Without an event, the last entry of the buffers is written.
        times = jnp.full(self.most + 1, jnp.inf, t0.dtype)
        states = jnp.zeros((self.most + 1, flat.size), flat.dtype)
        touch = jnp.zeros((), flat.dtype)
        none = jnp.asarray(jnp.inf, t0.dtype), jnp.zeros((), t0.dtype), jnp.array(0)
        start = jnp.array(True), jnp.asarray(jnp.inf, t0.dtype), jnp.array(False)
        return first, EventState(inner, *none, times, states, touch, jnp.array(0), *start)

    @eqx.filter_jit
    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error: Any, error_order, controller_state):
        before, crossing = controller_state, y_error
        keep, next_t0, next_t1, made_jump, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, crossing.error, error_order, before.inner
        )
        starts = jnp.asarray(made_jump), before.starts
        step = _Tried(t0, t1, crossing.target, crossing.coarse, crossing.retry, before.halved, before.inner, starts)
        plan = _Plan(
            jnp.array(False),
            jnp.array(False),
            next_t0,
            next_t1,
            # The controller inside does not learn of a step without length, between events at the same time.
            jax.tree.map(lambda new, old: jnp.where(t1 <= t0, old, new), inner, before.inner),
            jnp.full_like(before.target, jnp.inf),
            jnp.where(jnp.isinf(before.target), t1 - t0, before.length),
            jnp.zeros_like(before.halved),
            before.starts,
            before.start,
            before.ended,
        )
        # A branch, so that the compiler does not repeat the verdict at every use.
        verdict = _verdict(keep, (t0, t1), crossing, before)
        plan = switch(verdict, [_refused, _crossed, _too_coarse, _passed, _ended], step, plan)
        # The next event overwrites an event that changed nothing.
        idle = plan.accepted & before.ended & (crossing.idle > 0)
        count = before.count - idle.astype(before.count.dtype)
        jumps, after = self._jump_after(t1)
        jumps = jumps & plan.accepted & (count < self.most)
        ends = plan.ends | jumps
        place = jnp.where(ends, jnp.minimum(count, self.most), self.most)
        state = EventState(
            plan.inner,
            plan.target,
            plan.length,
            count + ends.astype(count.dtype),
            lax.dynamic_update_index_in_dim(before.times, jnp.where(jumps, after, t1), place, 0),
            lax.dynamic_update_index_in_dim(before.states, ravel(y1_candidate), place, 0),
            crossing.touch,
            plan.halved,
            plan.starts,
            plan.start,
            plan.ended | ends,
        )
        full = plan.ends & (count >= self.most)
        result = diffrax.RESULTS.where(full, diffrax.RESULTS.dt_min_reached, result)
        lost = crossing.lost > 0
        result = diffrax.RESULTS.where(lost, NO_STATE, result)
        return plan.accepted & ~lost, plan.next_t0, plan.next_t1, made_jump | plan.ends, state, result


class _Tried(NamedTuple):
    """A step from `t0` to `t1` that was tried.

    **Fields:** `target`, `coarse`, `retry`: see `Crossing`; `halved`, `inner`: of the state before it, see
    `EventState`; `starts`: whether the method restarts after the step, and whether it restarted with the step.
    """

    t0: Any
    t1: Any
    target: Any
    coarse: Any
    retry: Any
    halved: Any
    inner: Any
    starts: tuple[Any, Any]


class _Plan(NamedTuple):
    """The next step: whether this one is `accepted`, and `ends` at an event; for the other fields see `EventState`."""

    accepted: Any
    ends: Any
    next_t0: Any
    next_t1: Any
    inner: Any
    target: Any
    length: Any
    halved: Any
    starts: Any
    start: Any
    ended: Any


# Steps refused by the controller inside, over a zero, too coarse, without an event, and ending at an event.
_REFUSED, _CROSSED, _TOO_COARSE, _PASSED, _ENDED = range(5)


def _verdict(keep, step: tuple[Any, Any], crossing: Crossing, before: EventState):
    """The kind of a step, if the controller inside would `keep` it."""
    t0, t1 = step
    # Compilers may round the same value differently in two places.
    meant = jnp.abs(t1 - before.target) <= 4 * jnp.finfo(before.target.dtype).eps * jnp.abs(t1)
    close = (t1 - crossing.target) <= _END * (t1 - t0)
    at_zero = jnp.where(meant, jnp.abs(crossing.lowest) <= crossing.near, crossing.falling > 0)
    at_zero = at_zero | (close & (crossing.lowest < -crossing.touch))
    crossed = (crossing.within > 0) | ((crossing.lowest < -crossing.touch) & ~at_zero)
    coarse = (crossing.coarse > 1) & (before.halved < _HALVED)
    verdict = jnp.where(coarse, _TOO_COARSE, jnp.where(at_zero, _ENDED, _PASSED))
    return jnp.where(keep, jnp.where(crossed, _CROSSED, verdict), _REFUSED)


def _refused(step: _Tried, plan: _Plan) -> _Plan:
    return plan._replace(next_t1=jnp.where(step.t1 <= step.t0, step.t1 + _SHORTER * plan.length, plan.next_t1))


def _crossed(step: _Tried, plan: _Plan) -> _Plan:
    # The controller inside does not learn of a step that was good but too long.
    return plan._replace(next_t0=step.t0, next_t1=step.target, inner=step.inner, target=step.target)


def _too_coarse(step: _Tried, plan: _Plan) -> _Plan:
    middle = step.t0 + 0.5 * (step.t1 - step.t0)
    return plan._replace(next_t0=step.t0, next_t1=middle, inner=step.inner, halved=step.halved + 1)


def _passed(step: _Tried, plan: _Plan) -> _Plan:
    t0, t1, (starts, started) = step.t0, step.t1, step.starts
    growing = jnp.where(step.coarse > _NOT_SMOOTH, t1 + _GROWTH * (t1 - t0), jnp.inf)
    empty = t1 <= t0
    next_t1 = jnp.where(empty, t1 + _SHORTER * plan.length, jnp.minimum(plan.next_t1, growing))
    # A method that restarts, at order one, takes the longest step that its last start allowed.
    allowed = (t1 - t0) * _START_SAFETY * step.retry.astype(plan.start.dtype)
    start = jnp.where(started & ~empty, allowed, plan.start)
    yes, no = jnp.array(True), jnp.array(False)
    return plan._replace(accepted=yes, next_t1=next_t1, starts=starts, start=start, ended=no)


def _ended(step: _Tried, plan: _Plan) -> _Plan:
    plan, yes = _passed(step, plan), jnp.array(True)
    next_t1 = jnp.minimum(plan.next_t1, step.t1 + plan.start)
    return plan._replace(ends=yes, next_t1=next_t1, starts=yes, ended=yes)


def without_events(controller_state: Any) -> Any:
    """The state of a controller that has recorded no events yet."""
    events = events_found(controller_state)
    if events is None:
        return controller_state
    none = jnp.zeros_like(events.count), jnp.full_like(events.times, jnp.inf)
    found: Any = events_found
    return eqx.tree_at(lambda state: (found(state).count, found(state).times), controller_state, none)


def events_found(controller_state: Any) -> EventState | None:
    """The events that an `EventController` recorded, from the state of a controller that may be wrapped around it."""
    states = states_inside(controller_state, EventState)
    return states[0] if states else None
