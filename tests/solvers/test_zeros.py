"""How the zero of a guard is found in a step."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.solvers import events

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
