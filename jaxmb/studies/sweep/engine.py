"""Chunks of a sweep on an executor: here, on a pool of processes, on a cluster."""

import concurrent.futures as futures
import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from ..._compat import processes_of
from ..._machine import cores, limit_of_threads
from ..._setup import SETTINGS
from .batch import Batch
from .dataset import packages
from .outputs import statuses
from .store import Store

# What a worker takes over from the session that started the sweep.
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
# Chunks that are handed to an executor whose size is not known, and to one of n workers, at a time.
_IN_FLIGHT, _PER_WORKER = 256, 2


class Task(NamedTuple):
    """One chunk: its place, the parameters of its members, and the number of chunks after it."""

    place: int
    columns: dict[str, np.ndarray]
    left: int


class Work:
    """How to compute and keep chunks, in one process; made once for all chunks that the process computes."""

    def __init__(self, batch: Batch, store: Path | None):
        self._run, self._batch = batch.compiled(), batch
        self._store = None if store is None else Store(store, batch.chunk)

    def __call__(
        self, task: Task, tell: Callable[[int], object] = lambda members: None
    ) -> tuple[int, dict[str, np.ndarray]]:
        """Compute a chunk: its place, and its outputs, or only its status if they are in the store.

        `tell` is called with the number of members of each block that is done, and with 0 after compiling.
        """
        found = self._run(task.columns, task.left, tell)
        values = {**found.values, "status": statuses(found)}
        if found.steps is not None:
            values["num_steps"] = np.asarray(found.steps, np.int64)
        if self._store is None:
            return task.place, values
        self._store.write(task.place, values)
        return task.place, {"status": values["status"]}


def here(
    batch: Batch, store: Path | None, tasks: Iterable[Task], tell: Callable[[int], object]
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Compute chunks one after another in this process, and tell of the members that are done."""
    work = Work(batch, store)
    for task in tasks:
        yield work(task, tell)


def on_executor(
    batch: Batch, store: Path | None, tasks: Iterable[Task], executor: futures.Executor, in_flight: int = _IN_FLIGHT
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Compute chunks on an executor, in the order in which they are done."""
    # A worker computes its share of the chunks that are left; of an executor, whose size is not known, at least this.
    tasks = (task._replace(left=task.left // in_flight) for task in tasks)
    submitted = _submitter(batch, store, executor)
    left, pending = iter(tasks), set()
    try:
        while True:
            while len(pending) < in_flight and (task := next(left, None)) is not None:
                pending.add(submitted(task))
            if not pending:
                return
            done, pending = futures.wait(pending, return_when=futures.FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except futures.BrokenExecutor as error:
        raise RuntimeError(f"The executor of the sweep broke: {error} The same call again goes on.") from error
    finally:
        for future in pending:
            future.cancel()


def on_processes(
    batch: Batch, store: Path | None, tasks: Iterable[Task], processes: int
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Compute chunks on a pool of processes of this machine, and on a new one for what is left if one of them dies."""
    left, breaks = {task.place: task for task in tasks}, 0
    while left:
        pool = futures.ProcessPoolExecutor(
            min(processes, len(left)),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_start_worker,
            initargs=(max(cores() // processes, 1),),
        )
        try:
            for index, values in on_executor(batch, store, list(left.values()), pool, _PER_WORKER * processes):
                del left[index]
                breaks = 0
                yield index, values
        except RuntimeError as error:
            if not isinstance(error.__cause__, futures.BrokenExecutor):
                raise
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


def _submitter(batch: Batch, store: Path | None, executor: futures.Executor) -> Callable[[Task], futures.Future]:
    (cloudpickle,) = packages("cloudpickle")
    settings = {name: getattr(jax.config, name) for name in _SETTINGS}
    try:
        work = cloudpickle.dumps((batch, store))
    except Exception as error:
        raise ValueError(
            f"The function of the sweep cannot be sent to other processes: {error}. Define it at the top level of a "
            "module, and let it hold arrays and systems only, no open files, locks or generators."
        ) from error
    return lambda task: executor.submit(_compute, settings, work, task)


# The work of the last study in this process, which has its compiled programs; an executor may compute in threads.
_work: dict[bytes, Work] = {}
_lock = threading.Lock()


def _compute(settings: dict[str, Any], work: bytes, task: Task) -> tuple[int, dict[str, np.ndarray]]:
    """Compute a chunk in a worker."""
    with _lock:
        if work not in _work:
            import cloudpickle

            for name, value in settings.items():
                jax.config.update(name, value)
            _work.clear()
            _work[work] = Work(*cloudpickle.loads(work))
        own = _work[work]
    return own(task)


def _start_worker(threads: int) -> None:
    """Share the cores, leave Ctrl-C to the session that started the sweep, and end with it."""
    # Read when JAX first computes, and so late enough here.
    if limit_of_threads() is None:
        os.environ["NPROC"] = str(threads)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    with contextlib.suppress(OSError):
        parent.join()
    os._exit(1)
