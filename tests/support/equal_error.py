"""Times of several programs at equal error, and what machine they were measured on."""

import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np


class Point(NamedTuple):
    """One run: the `setting`, a tolerance or a step, its `error`, and its time [s]."""

    setting: float
    error: float
    seconds: float


def measured(
    run: Callable[[float], Any], error: Callable[[Any], float], settings: Iterable[float], repeats: int
) -> list[Point]:
    """The runs that end, with the shortest of `repeats` times of each, all of one setting after the other in turns."""
    settings = list(settings)
    errors = [error(jax.block_until_ready(run(setting))) for setting in settings]
    shortest = [np.inf] * len(settings)
    for _ in range(repeats):
        for k, setting in enumerate(settings):
            begin = time.perf_counter()
            jax.block_until_ready(run(setting))
            shortest[k] = min(shortest[k], time.perf_counter() - begin)
    return [Point(*point) for point in zip(settings, errors, shortest, strict=True) if np.isfinite(point[1])]


def seconds_at(points: Sequence[Point], error: float) -> float:
    """The time at an error, between the runs about it on the log–log curve of those that no other run beats in both; that
    of the fastest run where even it is closer, and NaN where none is close enough.
    """
    best = []
    for point in sorted(points, key=lambda p: p.seconds):
        if not best or point.error < best[-1].error:
            best.append(point)
    if not best or best[-1].error > error:
        return float("nan")
    errors, times = (np.log([getattr(p, name) for p in reversed(best)]) for name in ("error", "seconds"))
    return float(np.exp(np.interp(np.log(error), errors, times)))


def machine(packages: Iterable[str]) -> str:
    """The processor, how many of them, the load, and the versions of the packages that are installed."""
    described = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        described = names[0] if names else described
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{described}, {os.cpu_count()} cores{load}; {versions(packages)}"


def versions(packages: Iterable[str]) -> str:
    found = [f"Python {platform.python_version()}"]
    for name in packages:
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return ", ".join(found)
