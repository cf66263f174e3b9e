"""Points that fill a cube evenly."""

import numpy as np
from jaxtyping import Float


def sobol_points(count: int, size: int, seed: int) -> Float[np.ndarray, "count size"]:
    """The first points of a scrambled Sobol sequence in the unit cube, from `scipy.stats.qmc`."""
    from scipy.stats import qmc

    # SciPy warns if the number is not a power of two.
    sequence = qmc.Sobol(size, rng=np.random.default_rng(seed))
    return sequence.random_base2((count - 1).bit_length())[:count]
