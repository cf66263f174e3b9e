"""How the zero of a guard is found in a step."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from jaxmb.solvers import events
from jaxmb.solvers.manifold_term import AbstractGuards, GuardsSeen

FUNCTIONS = {
    "line": (lambda s: 0.37 - s, 8),
    "curve": (lambda s: (0.37 - s) * (1 + 0.8 * (s - 0.37) + 4 * (s - 0.37) ** 2), 12),
    "one side slow": (lambda s: 1 - np.exp(8 * (s - 0.37)), 14),
    "kink": (lambda s: (0.37 - s) * (1.0 if s < 0.37 else 100.0), 50),
    "triple": (lambda s: (0.37 - s) ** 3, 58),
}


narrowed = jax.jit(lambda bracket, s, value, late: events.narrowed(bracket, s, value, late, 0.5 * events._FRACTION))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_zero_is_found_in_few_evaluations(name):
    function, most = FUNCTIONS[name]
    ends = (np.asarray(x, float) for x in (0.0, 1.0, function(0.0), function(1.0)))
    bracket, s = events.Bracket(*ends, np.asarray(0)), np.asarray(0.5)
    for count in range(1, most + 1):
        bracket, s = jax.device_get(narrowed(bracket, s, np.asarray(function(s), float), count >= events._SECANTS))
        assert bracket.a <= 0.37 + 1e-13 and bracket.b >= 0.37 - 1e-13
        if bracket.b - bracket.a <= events._FRACTION or bracket.of_b == 0:
            break
    assert abs(bracket.b - 0.37) < 2e-13, (count, bracket)


class Dip(AbstractGuards):
    """A guard that is negative between two times only."""

    first: Array
    last: Array
    touch: Array

    @property
    def near(self):
        return 100 * self.touch

    def seen(self, t, y):
        value, rate = (t - self.first) * (t - self.last), 2 * t - self.first - self.last
        return GuardsSeen(value[None], rate[None])

    def forces(self, y):
        return jnp.array([False])

    def changed(self, before, after):
        return jnp.array(True)


@jax.jit
def first_zero(first, last):
    ends, one = (jnp.array(0.0), jnp.array(1.0)), jnp.ones(1)
    guards, states = Dip(first, last, jnp.array(1e-13)), (0 * one, 0 * one, one)
    found = events.crossing(guards, 1, None, ends, states, lambda t: t * one, jnp.array(False))
    return found.target, found.within


def test_the_first_zero_of_a_guard_that_is_negative_within_a_step():
    for first, last in ((0.3, 0.4), (0.1, 0.2), (0.45, 0.47), (0.8, 0.81), (0.3, 0.3001), (0.2, 0.9)):
        target, within = first_zero(first, last)
        assert within == 1 and abs(target - first) < 2e-13


@jax.jit
def counted(idle):
    """The number of events after three steps without zeros that begin with jumps, the first at an event."""
    controller, one = events.EventController(diffrax.PIDController(1e-6, 1e-6), 5), jnp.ones(())
    state = controller.init(None, one, 9 * one, one, one, None, None, 5.0)[1]
    state = eqx.tree_at(lambda state: (state.count, state.ended), state, (jnp.array(3), jnp.array(True)))
    counts = []
    for t, idle_there in ((1.0, idle), (2.0, 1.0), (3.0, 1.0)):
        none = jnp.zeros(())
        crossing = events.Crossing(
            none, jnp.inf, none, one, none, none, none, 1e-9 * one, 1e-7 * one, jnp.inf * one, idle_there * one
        )
        step = t * one, (t + 1) * one
        state = controller.adapt_step_size(*step, one, one, None, crossing, 5.0, state)[4]
        counts.append(state.count)
    return jnp.stack(counts)


def test_an_event_counts_unless_it_changes_nothing():
    """An announced jump later may change nothing, and takes no event away."""
    np.testing.assert_array_equal(counted(0.0), [3, 3, 3])
    np.testing.assert_array_equal(counted(1.0), [2, 2, 2])


def test_a_jump_is_an_event_just_after_it_unless_it_changes_nothing():
    """Steps end just before jumps, at 2 and 4, the second of which changes nothing; 6 is no jump."""
    jumps, one = jnp.array([4.0, 2.0]), jnp.ones(())
    controller = events.EventController(diffrax.PIDController(1e-6, 1e-6), 5, jumps)
    state = controller.init(None, one, 9 * one, one, one, None, None, 5.0)[1]
    none, found = jnp.zeros(()), []
    for end, idle in ((2.0, 0.0), (4.0, 0.0), (6.0, 1.0)):
        crossing = events.Crossing(
            none, jnp.inf, none, one, none, none, none, 1e-9 * one, 1e-7 * one, jnp.inf * one, idle * one
        )
        before = jnp.nextafter(jnp.array(end), 0.0)
        state = controller.adapt_step_size(before - 1, before, one, end * one, None, crossing, 5.0, state)[4]
        found.append((int(state.count), state.times[0], state.states[0, 0]))
    after = np.nextafter(2.0, 9.0)
    assert found == [(1, after, 2.0), (2, after, 2.0), (1, after, 2.0)]


class Slip(AbstractGuards):
    """A guard that is the state, and may begin at the start of a step."""

    touch: Array
    near: Array
    is_new: bool = eqx.field(static=True)

    def seen(self, t, y):
        return GuardsSeen(y, jnp.full_like(y, jnp.inf), y <= self.touch if self.is_new else None)

    def forces(self, y):
        return jnp.zeros_like(y, bool)

    def changed(self, before, after):
        return jnp.any(before != after)


@functools.partial(jax.jit, static_argnums=0)
def found(is_new, middle, end, made_jump=False, before=0.0):
    """The search in a step from zero to one, whose interpolant passes through a point in its middle."""
    guards = Slip(jnp.asarray(1e-10), jnp.asarray(1e-8), is_new)
    at = lambda t: 4 * t * (1 - t) * jnp.array([middle]) + t * (2 * t - 1) * jnp.array([end])
    states = jnp.array([before]), jnp.zeros(1), jnp.array([end])
    times = jnp.zeros(()), jnp.ones(())
    return events.crossing(guards, 1.0, None, times, states, at, jnp.asarray(made_jump))


def test_a_guard_that_begins_counts_at_the_end_of_a_step():
    """Between its ends a step errs by more than such a guard is. An event at which nothing changes is idle."""
    assert found(True, -1e-4, 1e-4).within == 0
    # It has come back to zero before the end.
    turned = found(True, 1e-4, -1e-4)
    assert turned.lowest < -1e-5 and 0.5 < turned.target < 1
    assert [int(found(True, 1.0, 1.0, *given).idle) for given in ((True, 0.0), (True, 0.5), (False, 0.0))] == [1, 0, 0]


@pytest.mark.slow
def test_a_guard_that_goes_on_counts_within_a_step():
    assert found(False, -1e-4, 1e-4).within == 1
