"""A function of named parameters over many cases."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from ..._arguments import whole_number
from ..._machine import threads
from ..._version import __version__
from ...parts.names import names_arguments
from . import dataset, store as stores
from .batch import Batch, whole_chunk
from .cases import Cases, table
from .engine import Task, here, on_executor, on_processes
from .identity import identity_of_cases, identity_of_outputs
from .labels import described
from .load import load_sweep
from .outputs import OK, RESERVED, check_parameters, declared, step_limit

# Large enough that what a chunk costs besides its members, 5 ms, does not count, and that each core has at least two of
# its blocks, small enough that little is lost. A graphics processor computes thousands of members in the time of a few.
_CHUNK, _OF_THREAD, _OF_ACCELERATOR = 512, 128, 8192
# What a sweep is known by, where the name of the attribute does not say it.
_WORDS = {"jaxmb_version": "version of jaxmb", "jax_version": "version of JAX", "version": "argument version"}


@names_arguments
def sweep(
    function: Callable[..., Mapping[str, Any]],
    cases: Any,
    store: str | Path | None = None,
    *,
    dims: Mapping[str, Sequence[str]] | None = None,
    coords: Mapping[str, Any] | None = None,
    units: Mapping[str, str] | None = None,
    chunk: int | None = None,
    budget: int | Literal["auto"] | None = "auto",
    processes: int = 1,
    executor: Executor | None = None,
    devices: int | Sequence[Any] | None = None,
    progress: bool = True,
    overwrite: bool = False,
    version: str | int | None = None,
) -> Any:
    """Compute a function for many cases of its parameters.

    ```python
    def motion(inertia, speed):
        changed = jaxmb.with_parameters(system, {"bar.inertia": inertia})
        start = jaxmb.assemble(changed, rates={"pin.angle": speed}, throw=False)
        sol = jaxmb.simulate(changed, start, t1=1.0, saveat=ts, throw=False)
        return {"angle": sol["bar"].angle, "result": sol}

    ts = np.linspace(0.0, 1.0, 11)
    cases = jaxmb.cases.grid(inertia=np.linspace(0.05, 0.2, 4), speed=np.linspace(0.0, 5.0, 6))
    runs = jaxmb.sweep(motion, cases, "runs.zarr", dims={"angle": ["time"]}, coords={"time": ts})
    runs["angle"].sel(inertia=0.1, method="nearest").plot()
    ```

    **Main arguments:**

    - `function`: gets the parameters of one member by keyword, as JAX arrays, and returns a dictionary of outputs by
        name: arrays of any shape; a dictionary within it gives `outer.inner`. Under the name `result` it may return a
        `Trajectory` (of `simulate(..., throw=False)`), or its `result`, which becomes the member's status and message,
        and its number of steps. The function is pure and traced by JAX: parameters are not known as numbers in it, so
        that `if` and `float()` do not work on what depends on them; `jnp.where` and `jax.lax.cond` do.
    - `cases`: from `jaxmb.cases.grid`, `table` or `sobol`; or whatever `table` takes: columns of equal length by
        name, a pandas DataFrame, an xarray Dataset.
    - `store`: a folder to write to, as zarr format 3; it must be seen by all processes. Without it the result is in
        memory only. If it holds a part of this very sweep, only what is missing is computed, so that a sweep that was
        killed goes on with the same call, and ends with the same bits. It can be read at any time: `load_sweep`.
    - `dims`, `coords`, `units`: names of the dimensions of an output by its name, default `angle_0`, `angle_1`, …;
        values along a dimension by its name; and units by the name of a parameter, output or dimension.

    **Other arguments:**

    - `chunk`: members that are written together, default 512, or 128 for each core where that is more, 8192 on a GPU,
        or fewer where there are not as many; what is lost when a process is killed, and what takes memory. The store
        keeps it. They are computed in blocks as by `jaxmb.batch`.
    - `budget`: most steps of a member at first. Members of a block run together and take as long as the slowest of
        them. So if the function has an argument `max_steps`, which it hands to `simulate`, and returns its `result`,
        members that use up the budget are computed anew with the default of `max_steps`, in blocks of their own, by a
        second program. Default `"auto"`: none, until the chunks so far show by their steps that the rest of the sweep
        will save twice the time in which that program is compiled. None: no budget.
    - `processes`: on this machine, each with its share of the cores, default one. A process computes as many blocks of
        a chunk at a time as it has cores, or as the environment variable `NPROC` allows; the bits are the same. Several
        of them, each of which compiles for itself, survive a crash: a process that dies is replaced.
    - `executor`: any `concurrent.futures.Executor` instead: Dask's `client.get_executor()`,
        `mpi4py.futures.MPIPoolExecutor()`, and others of this interface. Its workers write their chunks themselves, and
        compute their blocks one after the other.
    - `devices`: a number of `jax.local_devices()`, or a list of them, among which the members of a chunk are divided,
        each device with loops of its own. Several devices that are parts of one CPU need two threads each, `NPROC=4` in
        the environment for two of them. On several hosts, each with devices, start the same script on every host with
        `jax.distributed.initialize()`, give each call its own part of the cases and its own store, and
        `devices=jax.local_devices()`; a sweep needs no communication.
    - `progress`: whether to show in one line that the function is being compiled, then what is done and the time that
        is left.
    - `overwrite`: whether to replace a store that holds another sweep. A sweep is known by its cases, its outputs and
        the program that JAX traces of its function, with all numbers in it, whatever the function reads them from; and
        by the versions of jaxmb and of JAX. Names, comments and docstrings in the function make no difference.
    - `version`: a text or number of your own, by which the sweep is known besides. It stands for functions that the
        program calls from Python, as by `jax.pure_callback`: change it when what they compute changes.

    **Returns:** an `xarray.Dataset`, with a dimension for each parameter of a grid, or else with the dimension
    `member`; parameters are coordinates. With the outputs there are `status`: 0 pending, 1 ok, 2 an output is not
    finite, and further numbers by `flag_meanings` of its attributes; `message`, empty if ok; and `num_steps` if it is
    known. A member that fails does not spoil the others. With a store, a list of members is read when it is looked
    at.

    **Raises:** `ValueError` for names that are unknown, missing, or there twice, for values that do not fit, for a
    function that returns no dictionary of arrays or is not pure or needs the number of a parameter, for a store of
    another sweep, and for a function whose program calls Python, of which no store can know whether it has changed,
    without `version`;
    `OSError` if the store cannot be written, as on a full disk: what is done is kept, and the same call again goes
    on; `RuntimeError` if processes die again and again, and if another process writes the store; `ImportError`
    without the packages of `jaxmb[studies]`. An interruption (Ctrl-C) keeps what is done as well.

    That a sweep ends with the same bits however often it was interrupted holds for one kind of processor, one version
    of the packages and one `chunk`, also between processes and executors.
    """
    dataset.packages(*(("xarray",) if store is None else ("xarray", "zarr")))
    cases = table(cases)
    for name in cases.columns:
        if name in RESERVED:
            raise ValueError(f"A parameter cannot have the name {name!r}, which the result of a sweep uses.")
    check_parameters(function, cases.columns)
    _check_engine(processes, executor, devices)
    found = _devices(devices)
    limit = step_limit(function, cases.columns)
    outputs, program = declared(
        function, {n: c[0] for n, c in cases.columns.items()}, **({} if limit is None else {"max_steps": limit})
    )
    variables = described(cases, outputs, dims or {}, coords or {}, units or {})
    path = None if store is None else Path(store)
    _check_version(version, () if path is None else program.unknown)
    known = {
        "jaxmb_version": __version__,
        "jax_version": jax.__version__,
        "x64": str(jnp.result_type(float) == jnp.float64),
        "version": "" if version is None else str(version),
        "function": program.value.hex(),
        "cases": identity_of_cases(cases),
        "outputs": identity_of_outputs(variables, cases),
    }
    before = None if path is None or overwrite else stores.study_of(path)
    if before is not None:
        _check_same_study(path, before, known, chunk, budget)
        chunk, budget = before["chunk"], budget if before["budget"] is None else before["budget"]
    size = _chunk(chunk, len(cases), processes)
    batch = Batch(function, outputs, whole_chunk(size, found), limit, None, found)
    if before is not None and batch.chunk != chunk:
        raise ValueError(f"The chunk of {chunk} of the store {path} cannot be divided among {len(found)} devices.")
    batch = dataclasses.replace(batch, budget=_checked_budget(batch, budget))
    # One that is chosen on the way changes no results, and is not kept.
    kept = None if batch.budget == "auto" else batch.budget
    attrs = dataset.attributes(cases, {**known, "chunk": batch.chunk, "budget": kept})
    if path is None:
        computed = _empty(variables)
        for members, values in _results(batch, None, cases, {}, progress, processes, executor):
            for name, value in values.items():
                computed[name][members] = value
        return dataset.in_memory(variables, attrs, computed)
    with _clear_errors(path):
        if before is None:
            if overwrite and stores.study_of(path) is not None:
                stores.remove(path)
            stores.create(path, variables, attrs, batch.chunk)
        with stores.alone(path):
            stores.mend(path, variables, batch.chunk)
            count = -(-len(cases) // batch.chunk)
            done = {index: values["status"] for index, values in stores.chunks(stores.Store(path, batch.chunk), count)}
            for _ in _results(batch, path, cases, done, progress, processes, executor):
                pass
            stores.remove_leftovers(path)
    return load_sweep(path)


def _results(
    batch: Batch,
    path: Path | None,
    cases: Cases,
    done: Mapping[int, np.ndarray],
    progress: bool,
    processes: int,
    executor: Executor | None,
) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """The members and outputs of each chunk that is not done, as they are computed."""
    own = lambda index: slice(index * batch.chunk, (index + 1) * batch.chunk)
    count = -(-len(cases) // batch.chunk)
    indices = [index for index in range(count) if index not in done]
    tasks = (Task(index, cases[own(index)], len(indices) - 1 - k) for k, index in enumerate(indices))
    shown = _Progress(progress, cases, done)
    with shown.bar:
        for index, values in _chunks(batch, path, tasks, processes, executor, shown):
            yield own(index), values
            shown.count(values["status"])


class _Progress:
    """A line with the members that are done, the time that is left, and the number of failed members.

    Until the first of them, or the program that computes them, is there, it says that it compiles.
    """

    def __init__(self, shown: bool, cases: Cases, done: Mapping[int, np.ndarray]):
        from tqdm import tqdm

        statuses = list(done.values())
        self._failed = sum(int(np.sum(own != OK)) for own in statuses)
        there = sum(own.size for own in statuses)
        self.bar = tqdm(desc="compiling", total=len(cases), initial=there, unit="member", disable=not shown)

    def advance(self, members: int) -> None:
        """Some members more are done; none after compiling, whose time is left out of the rate."""
        self.bar.set_description_str("", refresh=False)
        if members == 0:
            self.bar.unpause()
        self.bar.update(members)

    def count(self, own: np.ndarray) -> None:
        """Count those of a chunk that failed."""
        self._failed += int(np.sum(own != OK))
        if self._failed:
            self.bar.set_postfix_str(f"{self._failed} failed", refresh=False)


def _chunks(
    batch: Batch,
    path: Path | None,
    tasks: Iterator[Task],
    processes: int,
    executor: Executor | None,
    progress: _Progress,
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Each chunk, as it is computed: its place and values."""
    if executor is None and processes == 1:
        yield from here(batch, path, tasks, progress.advance)
        return
    if executor is None:
        run = on_processes(batch, path, tasks, processes)
    else:
        run = on_executor(dataclasses.replace(batch, alone=False), path, tasks, executor)
    for index, values in run:
        yield index, values
        progress.advance(values["status"].size)


def _check_engine(processes: Any, executor: Any, devices: Any) -> None:
    whole_number("processes", processes)
    if executor is not None and not isinstance(executor, Executor):
        raise ValueError(
            f"executor must be a concurrent.futures.Executor, got {executor!r}; Dask's is client.get_executor()."
        )
    if (processes > 1) + (executor is not None) + (devices is not None) > 1:
        raise ValueError("Give one of processes, executor and devices; the others have no effect beside it.")


def _devices(given: Any) -> tuple[Any, ...]:
    if given is None:
        return ()
    there = jax.local_devices()
    if isinstance(given, int | np.integer):
        if not 1 <= given <= len(there):
            raise ValueError(f"devices must be between 1 and the {len(there)} that JAX has here, got {given}.")
        given = there[:given]
    if not (isinstance(given, Sequence) and given and all(isinstance(device, jax.Device) for device in given)):
        raise ValueError(f"devices must be a number or a list of jax.local_devices(), got {given!r}.")
    _check_threads(given)
    return tuple(given)


def _check_threads(devices: Sequence[Any]) -> None:
    """Refuse devices that are this processor, in parts, with too few threads for them.

    Each holds a thread of XLA while its program runs, and waits for others, for ever if there are none.
    """
    available, parts = threads(), len(devices)
    if parts > 1 and devices[0].platform == "cpu" and available < 2 * parts:
        raise ValueError(
            f"{parts} devices of a CPU need {2 * parts} threads, and JAX has {available}: set NPROC={2 * parts} in the "
            "environment before JAX starts, or use processes=."
        )


def _chunk(given: Any, members: int, processes: int) -> int:
    if given is None:
        on_cpu = jax.default_backend() == "cpu"
        most = _CHUNK if processes > 1 else max(_CHUNK, _OF_THREAD * threads())
        return min(most if on_cpu else _OF_ACCELERATOR, -(-members // processes))
    return min(whole_number("chunk", given), members)


def _checked_budget(batch: Batch, budget: Any) -> int | Literal["auto"] | None:
    """The budget, at most `max_steps`; none where it is automatic and members cannot be cut off."""
    can_be_cut_off = batch.max_steps is not None and batch.outputs.can_be_cut_off
    if budget is None or budget == "auto":
        return budget if can_be_cut_off else None
    budget = whole_number("budget", budget, 1, ", 'auto' or None")
    if not can_be_cut_off:
        raise ValueError(
            "A budget needs a function with an argument max_steps that hands it to simulate(..., max_steps=max_steps) "
            "and that returns the trajectory as 'result'."
        )
    return min(budget, batch.max_steps or budget)


def _check_version(version: Any, unknown: Sequence[Any]) -> None:
    """Refuse what a store cannot know again, unless a version stands for it."""
    if isinstance(version, bool) or not isinstance(version, str | int | np.integer | None):
        raise ValueError(f"version must be a text or an integer, got {version!r}.")
    if unknown and version is None:
        name = getattr(unknown[0], "__qualname__", repr(unknown[0]))
        more = f" (and {len(unknown) - 1} more like it)" if len(unknown) > 1 else ""
        raise ValueError(
            f"The program of the sweep calls {name}{more} from Python, and a store cannot tell whether that has "
            "changed. Give version=, a text or number that you change when it changes, or leave out the store."
        )


def _check_same_study(path: Any, before: Mapping[str, Any], known: Mapping[str, str], chunk: Any, budget: Any) -> None:
    if "jax_version" not in before:
        raise ValueError(
            f"The store {path} holds another sweep: it was made by jaxmb {before.get('jaxmb_version', '')}, which knew "
            "sweeps by other marks than this version. Read it with load_sweep; to compute, give another path, or "
            "overwrite=True to replace it."
        )
    differing = [_WORDS.get(name, name) for name in known if before.get(name) != known[name]]
    if differing:
        raise ValueError(
            f"The store {path} holds another sweep: the {' and '.join(differing)} differ. Give another path, or "
            "overwrite=True to replace it."
        )
    for name, given, kept in (("chunk", chunk, before["chunk"]), ("budget", budget, before["budget"])):
        if given not in (None, "auto", kept):
            raise ValueError(f"The store {path} was begun with {name}={kept}, got {given!r}; leave it out to go on.")


def _empty(described: Mapping[str, Any]) -> dict[str, np.ndarray]:
    return {
        name: np.zeros(shape, values)
        for name, (_, values, shape, _) in described.items()
        if isinstance(values, np.dtype)
    }


@contextlib.contextmanager
def _clear_errors(path: Path | None) -> Iterator[None]:
    """Say of a write that failed that nothing is lost."""
    try:
        yield
    except OSError as error:
        if path is None:
            raise
        raise OSError(
            f"The store {path} cannot be written: {error}. The chunks that are done are kept; make room or give "
            "access, and the same call again goes on."
        ) from error
