"""Chunks of a sweep, computed in this process, in several of this machine, or by an executor."""

import concurrent.futures as futures
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from ..._compat import processes_of
from ..._machine import cores, limit_of_threads, use_one_thread_in_lapack
from ..._setup import SETTINGS
from .chunk import Job, Task, Work
from .dataset import packages

# Settings that a worker takes over from the session that started the sweep.
_SETTINGS = (
    "jax_enable_x64",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_default_matmul_precision",
    "jax_compilation_cache_dir",
    *SETTINGS,
)
# A pool whose workers die this often, without a chunk done in between, is given up.
_BREAKS = 3
# Chunks in progress at a time on an executor of unknown size, and on each of our own processes.
_IN_FLIGHT, _PER_WORKER = 256, 2


# The place of each chunk, and its outputs, or only its status if they are in the store.
Chunks = Iterator[tuple[int, dict[str, np.ndarray]]]


def here(job: Job, tasks: list[Task], tell: Callable[[int], object]) -> Chunks:
    """Compute chunks in turn in this process; `tell` gets the number of members done, and 0 after compiling."""
    if not tasks:
        return
    work = Work(job, tasks[0])
    tell(0)
    for task in tasks:
        yield task.place, work(task, tell)


def on_executor(job: Job, tasks: list[Task], executor: futures.Executor, in_flight: int = _IN_FLIGHT) -> Chunks:
    """Compute chunks on an executor, in the order in which they are done."""
    (cloudpickle,) = packages("cloudpickle")
    settings = {name: getattr(jax.config, name) for name in _SETTINGS}
    try:
        pickled = cloudpickle.dumps(job)
    except Exception as error:
        raise ValueError(
            f"The function of the sweep cannot be sent to other processes: {error}. Define it at the top level of a "
            "module, and let it hold arrays and systems only, no open files, locks or generators."
        ) from error
    left, pending = iter(tasks), {}
    try:
        while True:
            while len(pending) < in_flight and (task := next(left, None)) is not None:
                pending[executor.submit(_compute, settings, pickled, task)] = task.place
            if not pending:
                return
            for future in futures.wait(pending, return_when=futures.FIRST_COMPLETED).done:
                yield pending.pop(future), future.result()
    except futures.BrokenExecutor as error:
        raise futures.BrokenExecutor(
            f"The executor of the sweep broke: {error} The same call again goes on."
        ) from error
    finally:
        for future in pending:
            future.cancel()


def on_processes(job: Job, tasks: list[Task], processes: int) -> Chunks:
    """Compute chunks on a pool of processes of this machine; if a process dies, a new pool computes what is left."""
    left, breaks = {task.place: task for task in tasks}, 0
    while left:
        pool = futures.ProcessPoolExecutor(
            min(processes, len(left)),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_start_worker,
            initargs=(max(cores() // processes, 1),),
        )
        try:
            for place, values in on_executor(job, list(left.values()), pool, _PER_WORKER * processes):
                del left[place]
                breaks = 0
                yield place, values
        except futures.BrokenExecutor:
            breaks += 1
            if breaks == _BREAKS:
                raise RuntimeError(
                    "The processes of the sweep died again and again. They may be out of memory (a smaller chunk needs "
                    "less), or killed; a script that starts a sweep needs its calls below if __name__ == '__main__':. "
                    "What is in the store is kept, and the same call again goes on."
                ) from None
        finally:
            # Chunks that have begun are of no use when the sweep is interrupted or has failed.
            for worker in processes_of(pool):
                worker.terminate()
            pool.shutdown(wait=False, cancel_futures=True)


# The work of the last sweep in this process, which has its compiled program; an executor may compute in threads.
_work: dict[bytes, Work] = {}
_lock = threading.Lock()


def _compute(settings: dict[str, Any], pickled: bytes, task: Task) -> dict[str, np.ndarray]:
    """Compute a chunk in a worker."""
    import cloudpickle

    with _lock:
        if pickled not in _work:
            for name, value in settings.items():
                jax.config.update(name, value)
            _work.clear()
            _work[pickled] = Work(cloudpickle.loads(pickled), task)
        work = _work[pickled]
    return work(task)


def _start_worker(threads: int) -> None:
    """Share the cores, leave Ctrl-C to the session that started the sweep, and end with that session."""
    # Read when JAX first computes, and so late enough here.
    if limit_of_threads() is None:
        os.environ["NPROC"] = str(threads)
    use_one_thread_in_lapack()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker with its session. If the session was killed, it would wait for ever for its next task."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
