"""The program of a sweep, which computes the members of a chunk in blocks."""

from collections.abc import Callable, Mapping
from concurrent import futures
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._machine import threads
from ...linalg.members import in_blocks
from ..batch import Member
from .outputs import Outputs, Returned, check_same, outputs_of, returned

# The members in a call of the program where they are computed one after the other.
_ALONE = 8


class Program:
    """The compiled function of a block of members.

    **Arguments:** the `function`, its `outputs`, and the size of a `chunk`; `columns`: parameters, as an example.
    """

    def __init__(self, function: Callable[..., Any], outputs: Outputs, chunk: int, columns: Mapping[str, np.ndarray]):
        def of_parameters(parameters):
            found = returned(function, parameters)
            check_same(outputs, outputs_of(found))
            return found

        member = Member(of_parameters, {name: jnp.asarray(column[0]) for name, column in columns.items()})
        together = member.block_size(chunk)
        number = -(-chunk // min(_ALONE if together == 1 else together, chunk))
        self._size = -(-chunk // number)
        together = min(together, self._size)
        of_block = lambda parameters: in_blocks(member.block(together), parameters, together)
        self._run = jax.jit(of_block).lower(self._block(columns, 0)).compile()

    def __call__(self, columns: Mapping[str, np.ndarray], on_cores: bool, tell: Callable[[int], object]) -> Returned:
        """The outputs of some members.

        **Arguments:** `on_cores`: whether as many blocks are computed at a time as there are threads, of which each
        uses one core; `tell` is called with the number of members of each block that is done.
        """
        count = next(iter(columns.values())).shape[0]
        # Made in this thread, where a user may have changed how arrays are made.
        blocks = [self._block(columns, start) for start in range(0, count, self._size)]
        found: list[Any] = [None] * len(blocks)
        with futures.ThreadPoolExecutor(min(threads(), len(blocks)) if on_cores else 1) as pool:
            places = {pool.submit(self._computed, block): k for k, block in enumerate(blocks)}
            try:
                for done in futures.as_completed(places):
                    k = places[done]
                    found[k] = done.result()
                    tell(min(self._size, count - k * self._size))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *found)

    def _computed(self, block: dict[str, Any]) -> Returned:
        return jax.tree.map(np.asarray, self._run(block))

    def _block(self, columns: Mapping[str, np.ndarray], start: int) -> dict[str, Any]:
        """The parameters of a block, filled up to its size with the last member."""
        count = next(iter(columns.values())).shape[0]
        places = np.minimum(np.arange(start, start + self._size), count - 1)
        return {name: jnp.asarray(column[places]) for name, column in columns.items()}
