"""One chunk of a sweep: its members in blocks, computed and kept."""

from collections.abc import Callable, Mapping
from concurrent import futures
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..._machine import threads
from ...linalg.members import in_blocks
from ..batch import Member
from .outputs import Outputs, Returned, check_same, outputs_of, returned, statuses
from .store import Store

# The members in a call of the program that computes members one after the other.
_ALONE = 8


class Task(NamedTuple):
    """One chunk: its place, and the parameters of its members."""

    place: int
    columns: dict[str, np.ndarray]


class Job(NamedTuple):
    """What a process needs to compute chunks; equal for all processes, so that the bits are the same.

    **Fields:** the `function` and its `outputs`; `chunk`: the number of members of each; the folder of the `store`, if
    there is one; `on_cores`: whether a process computes blocks on all its cores. Workers of a user's executor do not,
    since there may be a worker for each core.
    """

    function: Callable[..., Any]
    outputs: Outputs
    chunk: int
    store: Path | None
    on_cores: bool = True


class Work:
    """Computes and keeps chunks in one process, by a program compiled for members like those of a first task."""

    def __init__(self, job: Job, first: Task):
        def of_parameters(parameters):
            found = returned(job.function, parameters)
            check_same(job.outputs, outputs_of(found))
            return found

        member = Member(of_parameters, {name: jnp.asarray(column[0]) for name, column in first.columns.items()})
        together = member.block_size(job.chunk)
        number = -(-job.chunk // min(_ALONE if together == 1 else together, job.chunk))
        self._size = -(-job.chunk // number)
        together = min(together, self._size)
        of_block = lambda parameters: in_blocks(member.block(together), parameters, together)
        self._run = jax.jit(of_block).lower(self._block(first.columns, 0)).compile()
        self._on_cores = job.on_cores
        self._store = None if job.store is None else Store(job.store, job.chunk)

    def __call__(self, task: Task, tell: Callable[[int], object] = lambda members: None) -> dict[str, np.ndarray]:
        """The outputs of a chunk, or only its status if they are in the store.

        **Arguments:** `tell` is called with the number of members of each block that is done.
        """
        found = self._in_blocks(task.columns, tell)
        steps = {} if found.steps is None else {"num_steps": np.asarray(found.steps, np.int64)}
        # The status is written last, as the mark that a chunk is done.
        values = {**found.values, **steps, "status": statuses(found)}
        if self._store is None:
            return values
        self._store.write(task.place, values)
        return {"status": values["status"]}

    def _in_blocks(self, columns: Mapping[str, np.ndarray], tell: Callable[[int], object]) -> Returned:
        """The outputs of some members, as many blocks at a time as there are threads; each block uses one core."""
        count = next(iter(columns.values())).shape[0]
        # Made in this thread, where a user may have changed how arrays are made.
        blocks = [self._block(columns, start) for start in range(0, count, self._size)]
        found: list[Any] = [None] * len(blocks)
        with futures.ThreadPoolExecutor(min(threads(), len(blocks)) if self._on_cores else 1) as pool:
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
