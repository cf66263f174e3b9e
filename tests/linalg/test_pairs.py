"""Numbers of which some are the components of vectors in planes."""

import jax
import numpy as np

from jaxmb.linalg.pairs import for_both, for_first, of_pairs, placed_pairs, sizes_of

PAIRS, VALUES = (1, 4), np.array([-1.0, 3.0, 4.0, 2.0, 5.0, -12.0])


def test_places_sizes_and_values_among_others():
    np.testing.assert_array_equal(of_pairs(PAIRS), [[1, 2], [4, 5]])
    assert of_pairs(()).shape == (0, 2)

    def all_of(singles, values):
        yield sizes_of(PAIRS, singles), [1, 5, 5, 2, 13, 13]
        yield sizes_of((), singles), np.abs(VALUES)
        yield placed_pairs(PAIRS, values, singles), [-1, 10, 20, 2, 30, 40]
        yield placed_pairs(PAIRS, values, singles, first=2), [0, 0, -1, 10, 20, 2, 30, 40]
        yield for_both(PAIRS, values[0], singles), [-1, 10, 10, 2, 20, 20]
        yield for_first(PAIRS, values[0], singles), [-1, 10, 0, 2, 20, 0]
        yield placed_pairs(PAIRS, values[:, :, None], singles[:, None])[:, 0], [-1, 10, 20, 2, 30, 40]

    values = np.array([[10.0, 20.0], [30.0, 40.0]])
    for found, expected in jax.jit(lambda *given: list(all_of(*given)))(VALUES, values):
        np.testing.assert_array_equal(found, expected)
