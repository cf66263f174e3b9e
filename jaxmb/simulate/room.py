"""The number of steps for which the program of a run has buffers."""

import collections
import math
from typing import Any, NamedTuple

import diffrax
import jax
import numpy as np

from .._types import State

# Tables of steps take about this memory [bytes], and hold numbers of steps between these; without tables, any number.
_MEMORY, _FEWEST_STEPS, _MOST_STEPS, _ANY = 2**24, 64, 4096, 2**31 - 1
# Derivatives keep the rows of this many steps, or of fewer if they do not fit in this many bytes.
MOST_ROWS, _FEWEST_ROWS, _ROW_BYTES = 2048, 64, 2**27
# Second derivatives keep the rows of all steps, if `max_steps` is at most this.
_MOST_OF_SECOND = 2**14
# The structures of systems and solvers with long motions in this process, with or without derivatives. Long motions
# take at least as many steps as derivatives keep at once; the next derivative outside of `jit` then does not try the
# smaller program first.
# Only a few are kept, since structures hold the functions of users.
_long: collections.deque[Any] = collections.deque(maxlen=16)


class Room(NamedTuple):
    """Buffers for steps.

    **Fields:** `rows`: the number of steps that fit; `limit`: the largest number of steps; `kept`: the
    number of steps whose rows derivatives keep at once.
    """

    rows: int
    limit: Any
    kept: int

    def of(self, rows: int, max_steps: int) -> "Room":
        return self._replace(rows=rows, limit=np.asarray(min(max_steps, rows)))


def room_of_calls(saveat: diffrax.SaveAt, state: State) -> int:
    """The number of steps of one call of a program with concrete numbers, for which it has tables."""
    kept = _kept_each_step(saveat)
    if not kept:
        return _ANY
    size = kept * sum(x.nbytes for x in jax.tree.leaves(state))
    return int(np.clip(2 ** int(math.log2(_MEMORY / size)), _FEWEST_STEPS, _MOST_STEPS))


def rooms_for(max_steps: int, saveat: diffrax.SaveAt, state: State, tries: bool) -> list[int]:
    """The numbers of steps for which programs under a trace have buffers; if a motion takes more steps, the next
    program is used.

    If states of steps are kept, the number is `max_steps`. Otherwise it is the next power of 4, so that one program
    serves several numbers. Derivatives of more than `kept_steps` steps recompute rows. With `tries`, which needs
    concrete values, the first program therefore has only `kept_steps`.
    """
    if _kept_each_step(saveat):
        return [max_steps]
    room, fewer = 4 ** math.ceil(math.log(max(max_steps, 4), 4) - 1e-9), kept_steps(state)
    if room <= fewer:
        return [room]
    if max_steps <= fewer:
        return [fewer]
    return [fewer, room] if tries and fewer == MOST_ROWS else [room]


def _kept_each_step(saveat):
    """How many times the numbers of a state are kept of each step: dense output keeps the history of a multistep
    method; `steps` one state of so many.
    """
    every = int(saveat.subs[0].steps)
    return 16 if saveat.dense else 1 / every if every else 0


def kept_steps(state: State, max_steps: int = _MOST_OF_SECOND + 1) -> int:
    """The number of steps whose rows derivatives keep at once, for second derivatives of at most `max_steps` steps."""
    if max_steps <= _MOST_OF_SECOND:
        return _MOST_OF_SECOND
    size = 2 * sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))
    return max(min(MOST_ROWS, _ROW_BYTES // max(size, 1)), _FEWEST_ROWS)


def was_long(system: Any, solver: Any) -> bool:
    """Whether a motion of such a system took at least as many steps as derivatives keep at once."""
    return jax.tree.structure((system, solver)) in _long


def note_long(system: Any, solver: Any) -> None:
    if not was_long(system, solver):
        _long.append(jax.tree.structure((system, solver)))
