"""Facts about the constraints between velocities of a system that does not declare them."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._dataflow import depends, is_analytic, shaken
from ..linalg.arrays import ARRAYS
from ..linalg.jitted import on_host

# The number of sets of random numbers at which residuals at rest are compared with zero.
_LOOKS = 3


class VelocityFact:
    """The default of a class attribute: a fact about ψ, which holds for all numbers of the system."""

    def __init__(self, fact: Callable[[Any], bool]):
        self._fact, self._found = fact, {}

    def __get__(self, system, owner=None):
        if system is None:
            return self
        if not system.velocity_rows:
            return True
        leaves, structure = jax.tree.flatten(system)
        key = structure, tuple((x.shape, x.dtype) if isinstance(x, ARRAYS) else x for x in leaves)
        if key not in self._found:
            self._found[key] = self._fact(system)
        return self._found[key]


def is_linear(system: Any) -> bool:
    """Whether ψ is affine in u, by data flow."""
    arrays, rest, t, q, u = _likes(system)
    slope = lambda arrays, t, q, u: jax.jacfwd(eqx.combine(arrays, rest).velocity_residual, 2)(t, q, u)
    return not depends(slope, (arrays, t, q, u), 3)


def is_drift_free(system: Any) -> bool:
    """Whether ψ is zero at rest: it is so at independent random numbers, and analytic."""
    arrays, rest, t, q, _ = _likes(system)
    given = arrays, t, q
    if not is_analytic(lambda arrays, t, q: _at_rest(eqx.combine(arrays, rest), t, q), given, 0, 1, 2):
        return False
    looks = [shaken(given, seed) for seed in range(_LOOKS)]
    return not any(np.any(_residual(eqx.combine(arrays, rest), t, q)) for arrays, t, q in looks)


def _likes(system):
    """The system's arrays as shapes, and its other leaves; a time, coordinates and velocities."""
    arrays, rest = eqx.partition(system, lambda x: isinstance(x, ARRAYS))
    like = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype)
    sizes, dtype = ((), (system.nq,), (system.nu,)), jnp.result_type(float)
    return jax.tree.map(like, arrays), rest, *(jax.ShapeDtypeStruct(size, dtype) for size in sizes)


def _at_rest(system, t, q):
    return system.velocity_residual(t, q, jnp.zeros(system.nu, q.dtype))


_residual = on_host(_at_rest)
