"""Numbers of which some are the components of vectors in planes."""

import jax.numpy as jnp
import numpy as np

from jaxmb.linalg.pairs import for_both, for_first, of_pairs, placed_pairs, sizes_of

PAIRS, VALUES = (1, 4), jnp.array([-1.0, 3.0, 4.0, 2.0, 5.0, -12.0])


def test_places_and_sizes():
    np.testing.assert_array_equal(of_pairs(PAIRS), [[1, 2], [4, 5]])
    assert of_pairs(()).shape == (0, 2)
    np.testing.assert_array_equal(sizes_of(PAIRS, VALUES), [1, 5, 5, 2, 13, 13])
    np.testing.assert_array_equal(sizes_of((), VALUES), np.abs(VALUES))


def test_values_among_others():
    values = jnp.array([[10.0, 20.0], [30.0, 40.0]])
    np.testing.assert_array_equal(placed_pairs(PAIRS, values, VALUES), [-1, 10, 20, 2, 30, 40])
    np.testing.assert_array_equal(placed_pairs(PAIRS, values, VALUES, first=2), [0, 0, -1, 10, 20, 2, 30, 40])
    np.testing.assert_array_equal(for_both(PAIRS, values[0], VALUES), [-1, 10, 10, 2, 20, 20])
    np.testing.assert_array_equal(for_first(PAIRS, values[0], VALUES), [-1, 10, 0, 2, 20, 0])
    rows = placed_pairs(PAIRS, jnp.ones((2, 2, 3)), jnp.zeros((6, 3)))
    np.testing.assert_array_equal(rows[:, 0], [0, 1, 1, 0, 1, 1])
