"""One chunk of a sweep: all members at once, those that take long once more in small batches."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from .cases import Cases
from .outputs import OK, Outputs, Returned, check_same, outputs_of, returned, statuses

# The members that a budget of steps is chosen from, and by how much it exceeds the steps of those that it is to suit.
_PROBES, _MARGIN = 16, 1.1


@dataclasses.dataclass(frozen=True)
class Batch:
    """How to compute a chunk; the same wherever it is computed, so that it gives the same bits.

    `budget` is the number of steps that members of a whole chunk may take. Those that are cut off are computed anew
    with `max_steps`, in batches of `small`: all lanes of a batch run as long as its slowest, and so a few members that
    take ten times as long would hold up all others. Without a budget all have `max_steps`, or what the function says.
    """

    function: Callable[..., Any]
    outputs: Outputs
    chunk: int
    max_steps: int | None = None
    budget: int | None = None
    devices: tuple[Any, ...] = ()

    @property
    def small(self) -> int:
        """The size of the batches of members that take long; a sixty-fourth of a chunk."""
        return _multiple(max(4, self.chunk // 64), len(self.devices))

    def compiled(self) -> Callable[[Mapping[str, np.ndarray]], Returned]:
        """A function that computes one chunk, and compiles at its first call."""
        programs = {steps: _program(self, steps) for steps in {self.budget, self.max_steps}}

        def run(columns: Mapping[str, np.ndarray]) -> Returned:
            if self.budget is None:
                return _padded(programs[self.max_steps], columns, self.chunk)
            found = jax.tree.map(np.array, _padded(programs[self.budget], columns, self.chunk))
            cut_off = np.flatnonzero(self._cut_off(found))
            for start in range(0, cut_off.size, self.small):
                own = cut_off[start : start + self.small]
                again = _padded(programs[self.max_steps], {k: v[own] for k, v in columns.items()}, self.small)
                for old, new in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
                    old[own] = new
            return found

        return run

    def _cut_off(self, found: Returned) -> np.ndarray:
        names = [name for name, _ in self.outputs.statuses]
        return statuses(found) == names.index("max_steps_reached")

    def with_budget(self, cases: Cases) -> "Batch":
        """The same with the budget that is expected to cost least, from the steps of members all over the cases.

        A member costs the budget, as all lanes of its chunk run on to it, and one beyond it its own steps once more.
        """
        members = (np.arange(_PROBES) + 0.5) * ((np.sqrt(5) - 1) / 2) % 1 * len(cases)
        columns, run = cases[np.unique(members.astype(int))], _program(self, self.max_steps)
        count = next(iter(columns.values())).shape[0]
        steps = np.zeros(0, int)
        for start in range(0, count, self.small):
            some = {name: column[start : start + self.small] for name, column in columns.items()}
            found = _padded(run, some, self.small)
            steps = np.append(steps, np.asarray(found.steps)[statuses(found) == OK])
        if steps.size == 0:
            return self
        budgets = np.ceil(_MARGIN * np.unique(steps)).astype(int)
        costs = [budget + np.sum(steps, where=steps > budget) / steps.size for budget in budgets]
        return self.limited(int(budgets[np.argmin(costs)]))

    def limited(self, budget: int) -> "Batch":
        """The same with a budget."""
        return dataclasses.replace(self, budget=min(budget, self.max_steps or budget))


def whole_chunk(chunk: int, devices: tuple[Any, ...]) -> int:
    """The next number of members that divides evenly among the devices."""
    return _multiple(chunk, len(devices))


def _multiple(size: int, devices: int) -> int:
    each = max(devices, 1)
    return -(-size // each) * each


def _program(batch: Batch, steps: int | None) -> Callable[[Mapping[str, Any]], Returned]:
    fixed = {} if steps is None else {"max_steps": steps}

    def member(parameters):
        found = returned(batch.function, parameters, **fixed)
        check_same(batch.outputs, outputs_of(found))
        return found

    members = jax.vmap(member)
    if batch.devices:
        mesh, along = Mesh(np.array(batch.devices), ("member",)), PartitionSpec("member")
        # Each device leaves its loops when its own members have ended; the check would ask diffrax's loops for values
        # that are the same on all devices.
        members = jax.shard_map(members, mesh=mesh, in_specs=along, out_specs=along, check_vma=False)
    return jax.jit(members)


def _padded(program: Callable[..., Returned], columns: Mapping[str, np.ndarray], size: int) -> Returned:
    """The program's outputs for some members, filled up to its size with the last of them."""
    count = next(iter(columns.values())).shape[0]
    places = np.minimum(np.arange(size), count - 1)
    found = program({name: column[places] for name, column in columns.items()})
    return jax.tree.map(lambda x: np.asarray(x)[:count], found)
