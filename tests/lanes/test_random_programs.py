"""Random programs have the same results side by side as in a loop over members."""

import pytest
import random_programs


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_random_programs_have_the_results_of_a_loop(seed):
    random_programs.check(seed)
