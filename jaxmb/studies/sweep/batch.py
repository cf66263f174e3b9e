"""One chunk of a sweep: its members in blocks, those that take long once more in blocks of their own."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from concurrent import futures
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from ..._machine import threads
from ...linalg.members import in_blocks
from ..batch import Member, batch
from .outputs import Outputs, Returned, check_same, outputs_of, returned, statuses

# By how much a budget exceeds the steps of those that it is to suit, and how often it has to save the time in which
# its program is compiled.
_MARGIN, _PAYS = 1.1, 2.0
# Members that are computed one after the other are so many in a call of the program.
_ALONE = 8


@dataclasses.dataclass(frozen=True)
class Batch:
    """How to compute a chunk; the same wherever it is computed, so that it gives the same bits.

    `budget` is the number of steps that members may take at first. Those that are cut off are computed anew with
    `max_steps`, in blocks of their own: all lanes of a block run as long as its slowest, and so a few members that take
    ten times as long would hold up many others. With `"auto"` a budget is chosen once it pays; members have the same
    bits with any budget and without. A process that is `alone` with the cores that it may use computes blocks on all of
    them; workers of an executor of the user's, of which there may be one for each core, one after the other.
    """

    function: Callable[..., Any]
    outputs: Outputs
    chunk: int
    max_steps: int | None = None
    budget: int | Literal["auto"] | None = None
    devices: tuple[Any, ...] = ()
    alone: bool = True

    def compiled(self) -> "Chunks":
        """A function that computes one chunk, and compiles at its first call."""
        return Chunks(self)


class Chunks:
    """A function that computes chunks of a sweep in one process, and its compiled programs."""

    def __init__(self, batch: Batch):
        self._batch = batch
        self._programs: dict[int | None, _Program] = {}
        self._budget = batch.budget if isinstance(batch.budget, int) else None
        self._lost: list[float] = []

    def __call__(
        self, columns: Mapping[str, np.ndarray], left: int = 0, tell: Callable[[int], object] = lambda members: None
    ) -> Returned:
        """The outputs of a chunk's members.

        **Arguments:** `left`: the number of chunks that this process is expected to compute after this one, by which a
        budget is judged; `tell` is called with the number of members of each block that is done, and with 0 after
        compiling.
        """
        full = self._batch.max_steps
        first = self._program(full if self._budget is None else self._budget, columns)
        last = self._program(full, columns)
        tell(0)
        begin = time.perf_counter()
        found = first(columns, tell)
        if first is not last:
            own = np.flatnonzero(self._cut_off(found))
            if own.size:
                again = last({name: column[own] for name, column in columns.items()})
                found = jax.tree.map(np.array, found)
                for old, new in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
                    old[own] = new
        elif self._batch.budget == "auto" and self._budget is None and left > 0:
            budget, share = cheapest_budget(np.asarray(found.steps), last.together)
            self._lost.append(share * (time.perf_counter() - begin))
            if left * float(np.mean(self._lost)) > _PAYS * last.seconds:
                self._budget = min(budget, full or budget)
        return found

    @property
    def programs(self) -> int:
        """The number of programs that were compiled."""
        return len(self._programs)

    def _program(self, steps: int | None, columns: Mapping[str, np.ndarray]) -> "_Program":
        if steps not in self._programs:
            self._programs[steps] = _Program(self._batch, steps, columns)
        return self._programs[steps]

    def _cut_off(self, found: Returned) -> np.ndarray:
        names = [name for name, _ in self._batch.outputs.statuses]
        return statuses(found) == names.index("max_steps_reached")


def cheapest_budget(steps: np.ndarray, size: int) -> tuple[int, float]:
    """The budget with which members in blocks cost least, and the share of the time without one that it saves.

    A block costs the steps of its slowest member, and those that are cut off cost as much once more as their own
    blocks.
    """
    slowest = lambda steps: np.array([np.max(steps[k : k + size]) for k in range(0, steps.size, size)])
    of_blocks = slowest(steps)
    budgets = np.ceil(_MARGIN * np.unique(np.quantile(steps, np.linspace(0.0, 1.0, 65), method="higher"))).astype(int)
    costs = [np.sum(np.minimum(of_blocks, b)) + np.sum(slowest(steps[steps >= b])) for b in budgets]
    return int(budgets[np.argmin(costs)]), max(1.0 - float(np.min(costs) / max(np.sum(of_blocks), 1)), 0.0)


def whole_chunk(chunk: int, devices: tuple[Any, ...]) -> int:
    """The next number of members that divides evenly among the devices."""
    each = max(len(devices), 1)
    return -(-chunk // each) * each


class _Program:
    """The compiled program of `size` members with a limit of steps, on several devices of a whole chunk; `together`: of
    how many each waits for the slowest.
    """

    def __init__(self, own: Batch, steps: int | None, columns: Mapping[str, np.ndarray]):
        fixed = {} if steps is None else {"max_steps": steps}

        def of_parameters(parameters):
            found = returned(own.function, parameters, **fixed)
            check_same(own.outputs, outputs_of(found))
            return found

        begin = time.perf_counter()
        if own.devices:
            self.size = self.together = own.chunk
            mesh, along = Mesh(np.array(own.devices), ("member",)), PartitionSpec("member")
            # Each device leaves its loops when its own members have ended; the check would ask diffrax's loops for
            # values that are the same on all devices.
            members = jax.shard_map(batch(of_parameters), mesh=mesh, in_specs=along, out_specs=along, check_vma=False)
        else:
            member = Member(of_parameters, {name: jax.numpy.asarray(column[0]) for name, column in columns.items()})
            together = member.block_size(own.chunk)
            number = -(-own.chunk // min(_ALONE if together == 1 else together, own.chunk))
            self.size = -(-own.chunk // number)
            self.together = min(together, self.size)
            members = lambda parameters: in_blocks(member.block(self.together), parameters, self.together)
        self._alone = own.alone
        self._run = jax.jit(members).lower(self._block(columns, 0)).compile()
        self.seconds = time.perf_counter() - begin

    def __call__(
        self, columns: Mapping[str, np.ndarray], tell: Callable[[int], object] = lambda members: None
    ) -> Returned:
        """The outputs of some members, in blocks, as many at a time as there are threads; XLA computes one in one."""
        count = next(iter(columns.values())).shape[0]
        # Made in this thread, where a user may have changed how arrays are made.
        blocks = [self._block(columns, start) for start in range(0, count, self.size)]
        found: list[Any] = [None] * len(blocks)
        with futures.ThreadPoolExecutor(min(threads(), len(blocks)) if self._alone else 1) as pool:
            places = {pool.submit(self._computed, block): k for k, block in enumerate(blocks)}
            try:
                for done in futures.as_completed(places):
                    k = places[done]
                    found[k] = done.result()
                    tell(min(self.size, count - k * self.size))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *found)

    def _computed(self, block: dict[str, Any]) -> Returned:
        return jax.tree.map(np.asarray, self._run(block))

    def _block(self, columns: Mapping[str, np.ndarray], start: int) -> dict[str, Any]:
        """The parameters of a block, filled up to its size with the last member."""
        count = next(iter(columns.values())).shape[0]
        places = np.minimum(np.arange(start, start + self.size), count - 1)
        return {name: jax.numpy.asarray(column[places]) for name, column in columns.items()}
