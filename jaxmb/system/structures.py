"""A cache for methods whose result depends on the structure of a system alone."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ..linalg.arrays import ARRAYS

# The number of structures in the cache of each method.
_MOST = 64


def of_structure(function: Callable[[Any], dict[str, Any]]) -> Callable[[Any], dict[str, Any]]:
    """Cache a method that returns a dictionary, if the result depends only on the structure of its object's `system`.

    The method gets the system with zeros in its arrays, and without the axes of a batch. Systems with one structure
    have the same compiled programs, so a cached result is never out of date.
    """

    @functools.lru_cache(_MOST)
    def computed(kind, structure, leaves):
        zeros = lambda x: np.broadcast_to(np.zeros((), x.dtype), x.shape) if isinstance(x, jax.ShapeDtypeStruct) else x
        return function(kind(jax.tree.unflatten(structure, map(zeros, leaves))))

    @functools.wraps(function)
    def called(of: Any) -> dict[str, Any]:
        # The scales of a user's system may be plain numbers, which have no axes.
        (leaves, structure), batch = jax.tree.flatten(of.system), of.system.guess.q.ndim - 1
        shapes = (jax.ShapeDtypeStruct(x.shape[batch:], x.dtype) if isinstance(x, ARRAYS) else x for x in leaves)
        return dict(computed(type(of), structure, tuple(shapes)))

    return called
