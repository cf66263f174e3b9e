"""States at times that move."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.simulate.span import at_frozen_start, at_moving_times

RATE, AT, VALUE = -0.7, 0.4, 1.5
# The motion x' = RATE x cos t and its closed form.
TERM = diffrax.ODETerm(lambda t, y, args: RATE * y * jnp.cos(t))
# Its first two rates.
FIRST = RATE * VALUE * np.cos(AT)
SECOND = RATE * VALUE * (RATE * np.cos(AT) ** 2 - np.sin(AT))


def derivatives(function):
    return jax.jit(lambda t: (function(t), jax.jacfwd(function)(t), jax.jacfwd(jax.jacfwd(function))(t)))


def test_span_that_starts_later_has_its_motion_earlier():
    """With the state given at the moving start, that at the present value of this time is behind."""
    found = derivatives(lambda t: at_frozen_start(TERM, t, jnp.array(VALUE)))(AT)
    # The second derivative of VALUE exp(RATE (sin AT − sin t)).
    second = VALUE * (RATE**2 * np.cos(AT) ** 2 + RATE * np.sin(AT))
    np.testing.assert_allclose(found, [VALUE, -FIRST, second], rtol=1e-12)


def test_span_that_ends_later_goes_on():
    ts, ys = jnp.array([AT, jnp.inf]), jnp.array([VALUE, 0.0])
    found = derivatives(lambda move: at_moving_times(TERM, ts, move * jnp.ones(2), ys)[0])(0.0)
    np.testing.assert_allclose(found, [VALUE, FIRST, SECOND], rtol=1e-12)
