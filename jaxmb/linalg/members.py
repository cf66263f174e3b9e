"""Functions of many members, computed in blocks that fit in the cache of a core."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import lax
from jaxtyping import PyTree

# The matrices of a block of states fit in `_CACHE` bytes, but a block has at least `_FEWEST` states. (Projecting 512
# states on the constraints, µs for each with 1, 8, 64 and all at once: four-bar 5.4, 2.8, 2.1, 2.7; Andrews' mechanism
# 20, 18, 20, 36; a chain of 100 links 100, 83, 122, 340; a tree of 300 links 246, 247, 446, 1222.)
_CACHE, _FEWEST = 2**17, 8


def in_blocks(function: Callable[[PyTree], PyTree], members: PyTree, most: int) -> PyTree:
    """Apply a function of members along axis 0 of all arrays, such as a `jax.vmap`, block by block, to at most `most`
    members at once. Copies of the last member fill up the last block.
    """
    count = jax.tree.leaves(members)[0].shape[0]
    number = -(-count // most)
    if number <= 1:
        return function(members)
    together = -(-count // number)
    places = np.minimum(np.arange(number * together), count - 1)
    blocks = jax.tree.map(lambda x: x[places].reshape(number, together, *x.shape[1:]), members)
    results = lax.map(function, blocks)
    return jax.tree.map(lambda x: x.reshape(number * together, *x.shape[2:])[:count], results)


def vmap_states(function: Callable[..., Any], numbers: int) -> Callable[..., Any]:
    """`jax.vmap` of a function of the states of a motion, along axis 0 of all arrays; on a CPU in blocks of the cache's
    size.

    A loop over blocks takes a tenth longer to compile in a derivative, so few states are not divided.

    **Arguments:** `numbers`: the size of the largest matrix of a state.
    """
    together, most = jax.vmap(function), max(_CACHE // (8 * max(numbers, 1)), _FEWEST)

    def of_all(*states):
        if jax.default_backend() != "cpu":
            return together(*states)
        return in_blocks(lambda block: together(*block), states, most)

    return of_all
