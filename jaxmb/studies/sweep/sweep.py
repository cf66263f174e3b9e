"""A function of named parameters over many cases."""

import contextlib
import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..._arguments import whole_number
from ..._jaxpr_digest import digest_of
from ..._machine import threads
from ..._version import __version__
from ...parts.names import names_arguments
from . import dataset, store as stores
from .cases import Cases, table
from .chunk import Job, Task
from .dataset import Variable
from .engine import here, on_executor, on_processes
from .load import load_sweep, opened
from .outputs import OK, PENDING, RESERVED, check_parameters, declared

# Default chunks are so large that the cost of a chunk besides its members, 5 ms, is negligible and that each core has
# at least two blocks; and so small that an interruption loses little. A graphics processor computes thousands of
# members in the time of a few.
_CHUNK, _OF_THREAD, _OF_ACCELERATOR = 512, 128, 8192
# The marks of a sweep, where the name of the attribute does not say them.
_WORDS = {"jaxmb_version": "version of jaxmb", "jax_version": "version of JAX", "version": "argument version"}


# Arguments of the last release, with the new way.
_GONE = {
    "budget": 'leave it out; jaxmb.setup(compile="for speed") computes members that do not wait for slow ones',
    "devices": "give executor= an executor with one worker for each device",
}


@functools.partial(names_arguments, gone=_GONE)
def sweep(
    function: Callable[..., Mapping[str, Any]],
    cases: Any,
    store: str | Path | None = None,
    *,
    dims: Mapping[str, Sequence[str]] | None = None,
    coords: Mapping[str, Any] | None = None,
    units: Mapping[str, str] | None = None,
    chunk: int | None = None,
    processes: int = 1,
    executor: Executor | None = None,
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

    - `function`: gets the parameters of one member by keyword, as JAX arrays, and returns a dictionary of outputs:
        arrays of any shape by name. A nested dictionary gives `outer.inner`. The output named `result` may be a
        `Trajectory` (of `simulate(..., throw=False)`), which gives the member's status, message and number of steps, or
        its `result`, without steps. The function is pure and traced by JAX: use `jnp.where` or `jax.lax.cond` for `if`.
    - `cases`: from `jaxmb.cases.grid`, `table` or `sobol`; or an argument of `table`: columns of equal length by name,
        a pandas DataFrame, an xarray Dataset.
    - `store`: a folder to write to, in zarr format 3, which all processes can reach. Without a store the result is in
        memory only. Where the store holds a part of this sweep, only the missing part is computed: after an
        interruption, the same call goes on, to a result with the same bits. `load_sweep` reads it at any time.
    - `dims`: names of the dimensions of an output by its name, default `angle_0`, `angle_1`, …
    - `coords`: values along a dimension by its name.
    - `units`: units by the name of a parameter, output or dimension.

    **Other arguments:**

    - `chunk`: the number of members that are written together; a killed process loses an unfinished chunk. Default 512,
        or 128 for each core if that is more; 8192 on a GPU. The store keeps it. Members are computed in blocks as by
        `jaxmb.batch`.
    - `processes`: on this machine, each with its share of the cores, default one. One process computes a block of
        members on each core, or on `NPROC` cores where the environment has this variable. Several processes compile
        each for itself, and survive a crash: a process that dies is replaced. The bits are the same.
    - `executor`: any `concurrent.futures.Executor` instead: Dask's `client.get_executor()`,
        `mpi4py.futures.MPIPoolExecutor()`, and others. Its workers write their chunks themselves. For several GPUs, use
        an executor with a worker for each of them.
    - `progress`: whether one line shows that the function is compiled, then the members that are done and the time that
        is left.
    - `overwrite`: whether to replace a store that holds another sweep. A sweep is identified by a hash of its cases,
        its outputs, and the program that JAX traces of the function, with all numbers in it; and by the versions of
        jaxmb and JAX. Names, comments and docstrings in the function make no difference.
    - `version`: a text or integer that also identifies the sweep. It stands for functions that the program calls from
        Python, as by `jax.pure_callback`: change it when these functions change.

    **Returns:** an `xarray.Dataset`. It has a dimension for each parameter of a grid, or else the dimension `member`;
    parameters are coordinates. Besides the outputs it has `status`: 0 pending, 1 ok, 2 an output is not finite, and
    further numbers by `flag_meanings` of its attributes; `message`, empty if ok; and `num_steps` if it is known. A
    member that fails leaves the others unchanged. With a store, a list of members is read on access.

    **Raises:**

    - `ValueError` for names that are unknown, missing or repeated, and for values that do not fit; for a function that
        does not return a dictionary of arrays, is not pure, needs a parameter as a number, or, with a store, calls
        Python without `version`; and for a store that is damaged or holds another sweep.
    - `OSError` if the store cannot be written, as on a full disk: the same call again goes on.
    - `RuntimeError` if processes die again and again, and if another process writes the store.
    - `ImportError` without the packages of `jaxmb[studies]`.


    The bits of a result are the same for one kind of processor, one version of the packages and one `chunk`, however
    often a sweep is interrupted, and also between processes and executors.
    """
    dataset.packages(*(("xarray",) if store is None else ("xarray", "zarr")))
    cases = table(cases)
    for name in cases.columns:
        if name in RESERVED:
            raise ValueError(f"A parameter cannot have the name {name!r}, which the result of a sweep uses.")
    check_parameters(function, cases.columns)
    _check_engine(processes, executor)
    outputs, program = declared(function, {name: column[0] for name, column in cases.columns.items()})
    variables = dataset.variables(cases, outputs, dims or {}, coords or {}, units or {})
    path = None if store is None else Path(store)
    _check_version(version, () if path is None else program.unknown)
    known = _marks(cases, variables, program.value, version)
    before = None if path is None or overwrite else stores.study_of(path)
    if path is not None and before is not None:
        _check_same_study(path, before, known, chunk)
        chunk = before["chunk"]
    size = _chunk(chunk, len(cases), processes)
    job = Job(function, outputs, size, path, on_cores=executor is None)
    attrs = {**known, "chunk": size, "grid": json.dumps(cases.grid), "coordinates": " ".join(cases.columns)}
    run = lambda status: _computed(job, cases, status, progress, processes, executor)
    if path is None:
        computed = {name: np.zeros(own.shape, own.values) for name, own in variables.items() if own.is_output}
        for members, values in run(computed["status"]):
            for name, value in values.items():
                computed[name][members] = value
        return dataset.in_memory(variables, attrs, computed)
    with _clear_errors(path):
        if before is None:
            if overwrite and stores.study_of(path) is not None:
                stores.remove(path)
            stores.create(path, variables, attrs, size)
        with stores.alone(path):
            with stores.readable(path):
                status = opened(path, read=True)["status"].to_numpy()
            for _ in run(status):
                pass
            stores.remove_leftovers(path)
    return load_sweep(path)


def _marks(cases: Cases, variables: Mapping[str, Variable], program: bytes, version: Any) -> dict[str, str]:
    """The marks by which a store identifies a sweep."""
    digest = lambda value: digest_of(value, rules=False).value.hex()
    columns = {name: own for name, own in variables.items() if name in cases.columns}
    # The number of members is left out; the cases tell it.
    others = {name: own._replace(shape=own.shape[1:]) for name, own in variables.items() if name not in columns}
    return {
        "jaxmb_version": __version__,
        "jax_version": jax.__version__,
        "x64": str(jnp.result_type(float) == jnp.float64),
        "version": "" if version is None else str(version),
        "function": program.hex(),
        "cases": digest((cases.grid, columns)),
        "outputs": digest(others),
    }


def _computed(
    job: Job, cases: Cases, status: np.ndarray, progress: bool, processes: int, executor: Executor | None
) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """Compute the chunks whose `status` is pending: their members and outputs, in the order in which they are done.

    A line shows the members that are done, the time that is left, and the number of failed members. Until the program
    is there, or the first chunk of other processes, it says that the function compiles.
    """
    from tqdm import tqdm

    places = range(-(-len(cases) // job.chunk))
    members = [slice(place * job.chunk, (place + 1) * job.chunk) for place in places]
    tasks = [Task(place, cases[members[place]]) for place in places if np.all(status[members[place]] == PENDING)]
    there, failed = int(np.sum(status != PENDING)), int(np.sum(status > OK))
    with tqdm(desc="compiling", total=len(cases), initial=there, unit="member", disable=not progress) as bar:

        def advance(count: int) -> None:
            bar.set_description_str("", refresh=False)
            if count == 0:
                bar.unpause()  # The time of compiling is left out of the rate.
            bar.update(count)

        if executor is not None:
            chunks = on_executor(job, tasks, executor)
        elif processes > 1:
            chunks = on_processes(job, tasks, processes)
        else:
            chunks = here(job, tasks, advance)
        for place, values in chunks:
            yield members[place], values
            failed += int(np.sum(values["status"] > OK))
            if failed:
                bar.set_postfix_str(f"{failed} failed", refresh=False)
            if executor is not None or processes > 1:
                advance(values["status"].size)


def _check_engine(processes: Any, executor: Any) -> None:
    whole_number("processes", processes)
    if executor is not None and not isinstance(executor, Executor):
        raise ValueError(
            f"executor must be a concurrent.futures.Executor, got {executor!r}; Dask's is client.get_executor()."
        )
    if processes > 1 and executor is not None:
        raise ValueError("Give either processes or an executor.")


def _chunk(given: Any, members: int, processes: int) -> int:
    if given is None:
        on_cpu = jax.default_backend() == "cpu"
        most = _CHUNK if processes > 1 else max(_CHUNK, _OF_THREAD * threads())
        return min(most if on_cpu else _OF_ACCELERATOR, -(-members // processes))
    return min(whole_number("chunk", given), members)


def _check_version(version: Any, unknown: Sequence[Any]) -> None:
    """Refuse a program that a store cannot identify, unless a version stands for it."""
    if isinstance(version, bool) or not isinstance(version, str | int | np.integer | None):
        raise ValueError(f"version must be a text or an integer, got {version!r}.")
    if unknown and version is None:
        name = getattr(unknown[0], "__qualname__", repr(unknown[0]))
        more = f" (and {len(unknown) - 1} more like it)" if len(unknown) > 1 else ""
        raise ValueError(
            f"The program of the sweep calls {name}{more} from Python, and a store cannot tell whether that has "
            "changed. Give version=, a text or integer that you change when it changes, or leave out the store."
        )


def _check_same_study(path: Any, before: Mapping[str, Any], known: Mapping[str, str], chunk: Any) -> None:
    if "jax_version" not in before:
        raise ValueError(
            f"The store {path} holds another sweep: it was made by jaxmb {before.get('jaxmb_version', '')}, which knew "
            "sweeps by other marks than this version. Read it with load_sweep; to compute, give another path, or "
            "overwrite=True to replace it."
        )
    differing = [_WORDS.get(name, name) for name in known if before.get(name) != known[name]]
    if differing:
        raise ValueError(
            f"The store {path} holds another sweep: it differs in the {' and '.join(differing)}. Give another path, or "
            "overwrite=True to replace it."
        )
    if chunk not in (None, before["chunk"]):
        raise ValueError(
            f"The store {path} was begun with chunk={before['chunk']}, got {chunk!r}; leave it out to go on."
        )


@contextlib.contextmanager
def _clear_errors(path: Path) -> Iterator[None]:
    """Add to the error of a failed write that nothing is lost."""
    try:
        yield
    except OSError as error:
        raise OSError(
            f"The store {path} cannot be written: {error}. The chunks that are done are kept; make room or give "
            "access, and the same call again goes on."
        ) from error
