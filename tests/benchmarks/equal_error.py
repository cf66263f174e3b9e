"""Times of several programs at equal error, and what machine they were measured on.

Times are those of the processor, summed over the threads of the process, which other processes on the machine do not
lengthen as they do the time that passes.
"""

import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmb.report.table import aligned

ERRORS = (1e-4, 1e-6, 1e-8)


class Point(NamedTuple):
    """One run: the `setting`, a tolerance or a step, its `error`, and its processor time [s]."""

    setting: float
    error: float
    seconds: float


class Curve(NamedTuple):
    """The runs of a `program`; `kind` is what was computed in the `case`."""

    case: str
    kind: str
    program: str
    points: list[Point]


def measured(
    run: Callable[[float], Any],
    error: Callable[[Any], float],
    settings: Iterable[float],
    repeats: int,
    seconds: Callable[[Any], float] | None = None,
) -> list[Point]:
    """The runs that end, with the shortest of `repeats` times of each, all settings in turns; with `seconds(result)`
    instead of the time of the whole run.
    """
    settings = list(settings)
    errors = [error(jax.block_until_ready(run(setting))) for setting in settings]
    shortest = [np.inf] * len(settings)
    for _ in range(repeats):
        for k, setting in enumerate(settings):
            begin = time.process_time()
            result = jax.block_until_ready(run(setting))
            passed = time.process_time() - begin
            shortest[k] = min(shortest[k], passed if seconds is None else seconds(result))
    return [Point(*point) for point in zip(settings, errors, shortest, strict=True) if np.isfinite(point[1])]


def seconds_at(points: Sequence[Point], error: float) -> float:
    """The time at an error, interpolated on the log–log curve of the runs that no other run beats in both. It is that
    of the fastest run where even this is closer, and NaN where none is close enough.
    """
    best = []
    for point in sorted(points, key=lambda p: p.seconds):
        if not best or point.error < best[-1].error:
            best.append(point)
    if not best or best[-1].error > error:
        return float("nan")
    errors, times = (np.log([getattr(p, name) for p in reversed(best)]) for name in ("error", "seconds"))
    return float(np.exp(np.interp(np.log(error), errors, times)))


def table(curves: Iterable[Curve], errors: Sequence[float] = ERRORS) -> str:
    """Times of each case at equal errors, and over those of jaxmb: more than one where jaxmb is faster."""
    lines, curves = [], list(curves)
    for case, kind in dict.fromkeys((curve.case, curve.kind) for curve in curves):
        own = [curve for curve in curves if (curve.case, curve.kind) == (case, kind)]
        base = next(curve for curve in own if curve.program == "jaxmb").points
        rows = [(f"{case}, {kind}", *(f"at {error:.0e} [ms]  ×" for error in errors), "least error")]
        for curve in own:
            times = [(seconds_at(curve.points, error), seconds_at(base, error)) for error in errors]
            cells = ["–" if np.isnan(a) else f"{1e3 * a:.2f}  {a / b:6.2f}" for a, b in times]
            rows.append((curve.program, *cells, f"{min((p.error for p in curve.points), default=np.nan):.0e}"))
        lines += ["", *aligned(rows)]
    return "\n".join(lines[1:])


def record(path: Path, key: str, described: str, curves: Iterable[Curve]) -> None:
    """Write curves, with the machine, under their key into a JSON file, which keeps those under other keys."""
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    shown = [{**curve._asdict(), "points": [list(point) for point in curve.points]} for curve in curves]
    known[key] = {"machine": described, "curves": shown}
    path.write_text(json.dumps(known, ensure_ascii=False) + "\n", encoding="utf-8")


def machine(packages: Iterable[str]) -> str:
    """The processor, how many of them, the load, and the versions of the packages that are installed."""
    described = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
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
