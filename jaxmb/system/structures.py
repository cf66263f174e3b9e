"""What follows from the structure of a system, found once for all systems of this structure."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ..linalg.arrays import ARRAYS

# For so many structures each function keeps what it found.
_MOST = 64


def of_structure(function: Callable[[Any], dict[str, Any]]) -> Callable[[Any], dict[str, Any]]:
    """A method that gives a dictionary, which depends on the structure of its object's `system`, and on no number in
    it.

    The method gets the system with zeros in its arrays, and without the axes of a batch. Structures are equal where
    compiled programs are the same, so what is found can never be out of date.
    """

    @functools.lru_cache(_MOST)
    def computed(kind, structure, leaves):
        zeros = lambda x: np.broadcast_to(np.zeros((), x.dtype), x.shape) if isinstance(x, jax.ShapeDtypeStruct) else x
        return function(kind(jax.tree.unflatten(structure, map(zeros, leaves))))

    @functools.wraps(function)
    def called(of: Any) -> dict[str, Any]:
        (leaves, structure), batch = jax.tree.flatten(of.system), of.system.length.ndim
        shapes = (jax.ShapeDtypeStruct(x.shape[batch:], x.dtype) if isinstance(x, ARRAYS) else x for x in leaves)
        return dict(computed(type(of), structure, tuple(shapes)))

    return called
