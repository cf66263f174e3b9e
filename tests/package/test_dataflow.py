"""Facts about functions, found from their data flow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb._dataflow import depends, is_analytic

ZERO = np.zeros(())
DEPENDS = {
    "a sum": (lambda x, y: x + y, True),
    "a factor of zero": (lambda x, y: x + 0.0 * y, True),
    "not at all": (lambda x, y: jnp.sin(x), False),
    "a value that is dropped": (lambda x, y: (jnp.sin(y), x)[1], False),
    "a branch": (lambda x, y: jnp.where(y > 0, x, 2 * x), True),
    # Within an inner program, one value depends on y and another does not.
    "the other value of an inner program": (lambda x, y: jax.jit(lambda x, y: (x, y))(x, y)[0], False),
    "the value of an inner program": (lambda x, y: jax.jit(lambda x, y: (x, y))(x, y)[1], True),
    "a slope that is constant": (lambda x, y: jax.jacfwd(lambda y: jnp.where(x > 0, x * y, y))(y), False),
    "a slope that varies": (lambda x, y: jax.jacfwd(lambda y: jnp.where(x > 0, x * y**2, y))(y), True),
}


@pytest.mark.parametrize("function, known", DEPENDS.values(), ids=DEPENDS)
def test_depends_follows_inner_programs(function, known):
    assert depends(function, (ZERO, ZERO), 1) is known


def test_is_analytic_follows_inner_programs():
    both = jax.jit(lambda x, y: (jnp.sin(x), jnp.abs(y)))
    assert is_analytic(lambda x, y: both(x, y)[0], (ZERO, ZERO), 0)
    assert not is_analytic(lambda x, y: both(x, y)[1], (ZERO, ZERO), 1)
