"""How the zero of a guard is found in a step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from jaxmb.solvers import AbstractGuards, events

FUNCTIONS = {
    "line": (lambda s: 0.37 - s, 8),
    "curve": (lambda s: (0.37 - s) * (1 + 0.8 * (s - 0.37) + 4 * (s - 0.37) ** 2), 12),
    "one side slow": (lambda s: 1 - np.exp(8 * (s - 0.37)), 14),
    "kink": (lambda s: (0.37 - s) * (1.0 if s < 0.37 else 100.0), 50),
    "triple": (lambda s: (0.37 - s) ** 3, 58),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_zero_is_found_in_few_evaluations(name):
    function, most = FUNCTIONS[name]
    ends = (jnp.asarray(x) for x in (0.0, 1.0, function(0.0), function(1.0)))
    bracket, s = events.Bracket(*ends, 0), 0.5
    for count in range(1, most + 1):
        bracket, s = events.narrowed(
            bracket, s, function(s), jnp.asarray(count >= events._SECANTS), 0.5 * events._FRACTION
        )
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

    def values(self, t, y):
        return ((t - self.first) * (t - self.last))[None]

    def rates(self, t, y):
        return (2 * t - self.first - self.last)[None]

    def forces(self, y):
        return jnp.array([False])


@jax.jit
def first_zero(first, last):
    ends, one = (jnp.array(0.0), jnp.array(1.0)), jnp.ones(1)
    found = events.crossing(Dip(first, last, jnp.array(1e-13)), 1, None, ends, (0 * one, one), lambda t: t * one)
    return found.target, found.within


@pytest.mark.parametrize("first, last", [(0.3, 0.4), (0.1, 0.2), (0.45, 0.47), (0.8, 0.81), (0.3, 0.3001), (0.2, 0.9)])
def test_the_first_zero_of_a_guard_that_is_negative_within_a_step(first, last):
    target, within = first_zero(jnp.array(first), jnp.array(last))
    assert within == 1 and abs(target - first) < 2e-13
