"""Compiled functions of any pytree, called from Python at little cost."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

_Argument = TypeVar("_Argument")
_Result = TypeVar("_Result")


def jitted(function: Callable[[_Argument], _Result]) -> Callable[[_Argument], _Result]:
    """`jax.jit` of a function of one pytree, whose leaves that are no arrays belong to the program; all leaves of the
    result are arrays.

    `equinox.filter_jit` does the same for any function, and takes twice as long to call one of many numbers.
    """

    def of_arrays(arrays, program):
        structure, rest = program
        left = iter(arrays)
        return function(jax.tree.unflatten(structure, [next(left) if x is None else x for x in rest]))

    # The name that profiles and logs of compilations show.
    of_arrays.__name__ = function.__name__.lstrip("_")
    compiled = jax.jit(of_arrays, static_argnums=1)

    @functools.wraps(function)
    def called(argument: _Argument) -> Any:
        leaves, structure = jax.tree.flatten(argument)
        # A pytree has no leaves that are None.
        rest = tuple(None if isinstance(x, _ARRAYS) else x for x in leaves)
        arrays = [x for x, own in zip(leaves, rest, strict=True) if own is None]
        return compiled(arrays, (structure, rest))

    return called


_ARRAYS = (jax.Array, np.ndarray, np.generic)
