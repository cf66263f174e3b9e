"""The machine that a process runs on."""

import os
import re


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """The number of threads for computations: by the environment, as XLA reads it, or all cores."""
    return limit_of_threads() or cores()


def limit_of_threads() -> int | None:
    """The whole number in `PJRT_NPROC`, else in `NPROC`, at least one; None without a number.

    XLA reads numbers below one as one, and ignores any other text, such as `auto`.
    """
    for variable in ("PJRT_NPROC", "NPROC"):
        given = os.environ.get(variable, "").strip()
        if re.fullmatch(r"[+-]?[0-9]+", given) and abs(int(given)) < 2**31:
            return max(int(given), 1)
    return None


def use_one_thread_in_lapack() -> None:
    """Let LAPACK, which XLA calls, compute with one thread, unless the environment has a number.

    It has an effect before SciPy is loaded. OpenBLAS shares out triangular solutions from eight columns on, and its
    threads wait for each other in loops: on cores that other processes use, a motion takes a hundred times as long.
    """
    if not {"OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"} & os.environ.keys():
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
