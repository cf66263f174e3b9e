"""For how many steps the program of a run has room."""

import collections
import math
from typing import Any, NamedTuple

import diffrax
import jax
import numpy as np

from .._types import State

# What is kept of steps takes this memory at first [bytes], or that of so many steps.
_MEMORY, _FEWEST_STEPS = 2**24, 1024
# A motion that takes more steps than there was room for is computed again with so many times as much.
_MORE = 8
# Derivatives keep numbers of this many steps, of fewer where they do not fit in this many bytes.
MOST_ROWS, _FEWEST_ROWS, _ROW_BYTES = 2048, 64, 2**27
# The structures of the last systems and solvers of which a motion in this process, with or without derivatives, took as
# many steps as derivatives keep at once: the next derivative outside of `jit` does not try with room for no more. Only
# so many are kept, since structures hold the functions of their users.
_long: collections.deque[Any] = collections.deque(maxlen=16)


class Room(NamedTuple):
    """Room for steps.

    **Fields:** `rows`: as many as the program has room for; `limit`: the largest number of steps; the user's
    `adjoint`, None for derivatives on the mesh.
    """

    rows: int
    limit: Any
    adjoint: diffrax.AbstractAdjoint | None

    def of(self, rows: int, max_steps: int) -> "Room":
        return self._replace(rows=rows, limit=np.asarray(min(max_steps, rows)))


def rooms_for(max_steps: int, saveat: diffrax.SaveAt, state: State, traced: bool, tries: bool) -> list[int]:
    """How many steps programs have room for, of which the next is used where a motion takes more steps than the last.

    If nothing is kept of each step, the next power of 4 from `max_steps`, so that one program serves several numbers.
    Derivatives keep numbers of each step; a derivative of more steps than `kept_steps` has a program that finds them
    again, so where one `tries`, as it can where values are known, the first has room for no more.

    If states are kept, `max_steps` in a program that is traced, and else first as many as take little memory.
    """
    # Of dense output as many numbers for each of the state as a multistep method has in its history.
    kept = 16 if saveat.dense else int(saveat.subs[0].steps)
    if not kept:
        room, fewer = 4 ** math.ceil(math.log(max(max_steps, 4), 4) - 1e-9), kept_steps(state)
        if room <= fewer:
            return [room]
        if max_steps <= fewer:
            return [fewer]
        return [fewer, room] if traced and tries and fewer == MOST_ROWS else [room]
    if traced:
        return [max_steps]
    size = sum(x.nbytes for x in jax.tree.leaves(state))
    rooms = [max(2 ** int(math.log2(_MEMORY / (kept * size))), _FEWEST_STEPS)]
    while rooms[-1] < max_steps:
        rooms.append(_MORE * rooms[-1])
    return [*rooms[:-1], max_steps]


def kept_steps(state: State) -> int:
    """Of how many steps derivatives keep numbers at once."""
    size = 2 * sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))
    return max(min(MOST_ROWS, _ROW_BYTES // max(size, 1)), _FEWEST_ROWS)


def was_long(system: Any, solver: Any) -> bool:
    """Whether a motion of a system like this took as many steps as derivatives keep at once."""
    return jax.tree.structure((system, solver)) in _long


def note_long(system: Any, solver: Any) -> None:
    if not was_long(system, solver):
        _long.append(jax.tree.structure((system, solver)))
