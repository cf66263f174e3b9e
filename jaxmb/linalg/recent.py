"""What was found for the last arguments, for what is asked again in each call of a loop."""

import collections
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .arrays import is_traced

_NUMPY, _NUMBERS = (np.ndarray, np.generic), (bool, int, float, complex)


class Recent:
    """Results for the last few arguments.

    Arguments are the same where they are the same systems or states, which nothing changes in place, or where their
    structures are equal, their arrays of JAX are the same objects, and their other numbers are equal. What is traced is
    not kept.
    """

    def __init__(self, most: int):
        self._kept: collections.deque[tuple[tuple[Any, ...], Any]] = collections.deque(maxlen=most)

    def found(self, arguments: tuple[Any, ...], compute: Callable[[], Any]) -> Any:
        """The result that is kept for some arguments, or else the one that is computed."""
        # Modules that are the same object are looked for first: it takes long to compare others.
        for same in (_are_identical, _are_same):
            for known, result in self._kept:
                if len(known) == len(arguments) and all(map(same, arguments, known)):
                    return result
        result = compute()
        if not is_traced((arguments, result)):
            # The user may change an array of NumPy later.
            copied = (np.array(own) if isinstance(own, _NUMPY) else own for own in arguments)
            self._kept.append((tuple(copied), result))
        return result


def _are_identical(argument, known):
    return argument is known or (not isinstance(argument, eqx.Module) and _are_same(argument, known))


def _are_same(argument, known):
    if isinstance(argument, _NUMPY):
        return isinstance(known, _NUMPY) and argument.dtype == known.dtype and np.array_equal(argument, known)
    if argument is known:
        return True
    if isinstance(argument, eqx.Module) and type(argument) is type(known):
        (leaves, structure), (others, other) = jax.tree.flatten(argument), jax.tree.flatten(known)
        return len(leaves) == len(others) and all(map(_are_same, leaves, others)) and structure == other
    return isinstance(argument, _NUMBERS) and type(argument) is type(known) and argument == known
