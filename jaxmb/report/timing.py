"""Comparable run times on a machine with other load."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax


def timed_compile(fn: Callable, *args: Any) -> tuple[Callable, float]:
    """Trace and compile a function for its arguments.

    **Returns:** the compiled function, and the time taken [s].
    """
    begin = time.perf_counter()
    compiled = eqx.filter_jit(fn).lower(*args).compile()  # pyright: ignore[reportFunctionMemberAccess]
    return compiled, time.perf_counter() - begin


def interleaved(runs: Sequence[Callable[[], Any]], repeats: int) -> list[tuple[float, ...]]:
    """Time several functions in turns, so that other load on the machine affects all of them alike.

    Each is first called once without being timed.

    **Returns:** for every function its `repeats` times [s].
    """
    for run in runs:
        jax.block_until_ready(run())
    times: list[list[float]] = [[] for _ in runs]
    for _ in range(repeats):
        for durations, run in zip(times, runs, strict=True):
            begin = time.perf_counter()
            jax.block_until_ready(run())
            durations.append(time.perf_counter() - begin)
    return [tuple(durations) for durations in times]
