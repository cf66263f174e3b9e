"""A run with concrete numbers as several calls of one program: any number of steps needs no other program, and Ctrl-C
ends a run between two calls.
"""

import itertools
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._compat import changed
from ..linalg.arrays import is_traced
from ..linalg.jitted import Split
from ..solvers.events import without_events
from ..solvers.stepping import Carry
from ..trajectory import Trajectory
from .outcome import Flags, Outcome
from .solve import Problem, blank, call

# The number of steps of the first call. Later ones take this many times as many, as long as a call takes less than some
# time [s].
_STEPS, _MORE, _LONGEST = 512, 8, 0.5

_HIDDEN = (
    "A function that this simulation calls uses a value that JAX traces and cannot find, such as a global variable or "
    "an attribute of an object: make it a parameter, or let the function close over it."
)


class Calls(NamedTuple):
    """The motion after all calls.

    **Fields:** the `trajectory`, the `outcome` with its `flags`, and the `carry` of the last call; whether the user
    `interrupted` the run.
    """

    trajectory: Trajectory
    outcome: Outcome
    flags: Flags
    carry: Carry
    interrupted: bool


def in_calls(problem: Problem, max_steps: int, meter: Any, carry: Carry | None = None) -> Calls:
    """The motion of a problem, from its start or from a `carry`.

    **Arguments:** `meter`: a `diffrax.AbstractProgressMeter`, told the progress after each call; or None.
    """
    split, start = Split.of(problem), carry
    if start is None:
        yes = np.array(True)
        start = changed(blank(split), fresh=yes, begins=yes)
    before = steps = 0 if carry is None else int(start.progress.num_steps)
    parts: list[Trajectory] = []
    last: Any = None
    size, interrupted = _STEPS, False
    share = None if meter is None else meter.init()
    try:
        for count in itertools.count():
            # Tables of steps have so many rows.
            limit = min(before + max_steps, steps + min(size, problem.room.rows))
            began = time.monotonic()
            last = count, call(problem, split, start, np.asarray(limit))
            trajectory, outcome, start = last[1]
            if is_traced(outcome.flags):
                raise ValueError(_HIDDEN)
            flags, took = Flags(*np.asarray(outcome.flags)), time.monotonic() - began
            if meter is not None:
                share = meter.step(share, _share(problem, outcome))
            if not flags.ran_out or limit == before + max_steps:
                break
            steps = limit
            parts.append(_cut(trajectory, start))
            if took * _MORE < _LONGEST:
                size = size * _MORE
            elif took > _LONGEST and len(parts) > 1:
                # The first call may have compiled the program.
                size = max(size // 2, 1)
    except KeyboardInterrupt:
        if last is None:
            raise
        interrupted = True
    if meter is not None:
        meter.close(share)
    count, (trajectory, outcome, start) = last
    flags = Flags(*np.asarray(outcome.flags))
    return Calls(_joined(parts[:count], trajectory), outcome, flags, start, interrupted)


def carried_on(before: Problem, after: Problem, carry: Carry) -> Carry | None:
    """The carry of a run for a further one, `after` it; None if the method starts anew, since steps of either run stop
    or restart at given times.
    """
    if any(x is not None for run in (before, after) for x in (run.stops.turns, run.stops.restarts)):
        return None
    new, progress = blank(Split.of(after)), carry.progress
    progress = changed(progress, controller_state=without_events(progress.controller_state))
    carry = changed(new, fresh=np.array(False), begins=np.array(True), progress=progress)
    same = [np.shape(x) for x in jax.tree.leaves(carry)] == [np.shape(x) for x in jax.tree.leaves(new)]
    return carry if same and jax.tree.structure(carry) == jax.tree.structure(new) else None


def interruption(motion: Trajectory, t: Any) -> KeyboardInterrupt:
    """The error for a run that the user interrupted, with the motion so far."""
    at = f"The run was interrupted at t = {float(t):.6g}"
    error: Any = KeyboardInterrupt(f"{at}; the motion so far is the attribute `motion` of this error.")
    error.motion = motion
    return error


def _share(problem, outcome):
    start, end = np.asarray(problem.span.t0), np.asarray(problem.span.t1)
    return np.asarray(1.0 if start == end else (np.asarray(outcome.t) - start) / (end - start))


def _cut(trajectory, carry):
    """The part of a motion that a call has found, without the state at its end, in NumPy: for JAX each size of an array
    is another program.
    """
    take = lambda rows: lambda x: np.asarray(x)[:rows]
    of_states, interpolation = take(int(carry.written[0])), trajectory.interpolation
    if interpolation is not None:
        steps = int(interpolation.ts_size) - 1
        infos = jax.tree.map(take(steps), interpolation.infos)
        interpolation = changed(interpolation, ts=take(steps + 1)(interpolation.ts), infos=infos)
    ts, ys = of_states(trajectory.ts), jax.tree.map(of_states, trajectory.ys)
    return changed(trajectory, ts=ts, ys=ys, interpolation=interpolation)


def _joined(parts, last):
    """One motion of the parts found by several calls."""
    if not parts:
        return last
    every = [*parts, last]
    along = lambda *x: jax.device_put(np.concatenate(x))
    by_numpy = jax.device_put(np.any([part.stats["interpreted"] for part in every]))
    ts, ys = along(*(part.ts for part in every)), jax.tree.map(along, *(part.ys for part in every))
    interpolation: Any = last.interpolation
    if interpolation is not None:
        pieces: list[Any] = [part.interpolation for part in every]
        interpolation = changed(
            interpolation,
            ts=along(*(piece.ts[:-1] for piece in pieces[:-1]), interpolation.ts),
            ts_size=jnp.asarray(sum(int(piece.ts_size) - 1 for piece in pieces) + 1),
            infos=jax.tree.map(along, *(piece.infos for piece in pieces)),
            t0_if_trivial=pieces[0].t0_if_trivial,
            y0_if_trivial=pieces[0].y0_if_trivial,
        )
    stats = last.stats | {"interpreted": by_numpy}
    return changed(last, ts=ts, ys=ys, interpolation=interpolation, stats=stats)
