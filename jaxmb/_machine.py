"""The machine that a process runs on."""

import os


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """The number of threads that computations may take: `NPROC` in the environment, which XLA knows, or all cores."""
    return int(os.environ.get("NPROC") or cores())
