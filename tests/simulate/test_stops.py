"""Times at which a run restarts."""

import numpy as np

from jaxmb.simulate.stops import checked_jumps


def test_stops_are_at_announced_jumps_and_at_jumps_of_inputs():
    """In the order of time, whoever knows of them."""
    assert checked_jumps(None, np.zeros(0)) is None
    np.testing.assert_array_equal(checked_jumps(None, np.array([0.3])), [0.3])
    np.testing.assert_array_equal(checked_jumps([0.7, 0.2], np.array([0.3, 0.9])), [0.2, 0.3, 0.7, 0.9])
