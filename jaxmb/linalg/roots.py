"""Reciprocal square roots whose derivatives, of any order, are products.

XLA compiles a root or a quotient that several numbers need as a separate kernel. JAX's rules for `sqrt` and quotients
add another quotient in every derivative; here one root serves the value and all derivatives.
"""

from typing import Any

import jax
import numpy as np


def reciprocal_root(x: Any) -> Any:
    """`1/√x` for x > 0. NumPy in, NumPy out."""
    return 1.0 / np.sqrt(x) if isinstance(x, np.ndarray | np.generic) else _reciprocal_root(x)


@jax.custom_jvp
def _reciprocal_root(x):
    return jax.lax.rsqrt(x)


@_reciprocal_root.defjvp
def _reciprocal_root_jvp(primals, tangents):
    y = _reciprocal_root(*primals)
    return y, -0.5 * y * y * y * tangents[0]
