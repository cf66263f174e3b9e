"""Times at which a run restarts."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.simulate.stops import Stops, checked_jumps


def test_stops_are_at_announced_jumps_and_at_jumps_of_inputs():
    """In the order of time, whoever knows of them."""
    assert checked_jumps(None, np.zeros(0)) is None
    np.testing.assert_array_equal(checked_jumps(None, np.array([0.3])), [0.3])
    np.testing.assert_array_equal(checked_jumps([0.7, 0.2], np.array([0.3, 0.9])), [0.2, 0.3, 0.7, 0.9])


def test_events_at_jumps_move_with_them():
    """The time just after a jump has the derivative of the jump, another time has none."""
    times = jnp.array([np.nextafter(0.5, 1.0), 0.7, jnp.inf])
    moving = lambda jumps: Stops(jumps, None, None, 8).moving(times)
    value, change = jax.jvp(moving, (jnp.array([0.5, 0.9]),), (jnp.array([2.0, 3.0]),))
    np.testing.assert_array_equal(value, times)
    np.testing.assert_array_equal(change, [2.0, 0.0, 0.0])
