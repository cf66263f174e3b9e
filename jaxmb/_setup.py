"""JAX at the head of a script: its precision, the compilation of programs, and their cache on disk."""

import gc
import os
import re
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any, Literal

import jax

from ._compat import computes_on_processors, has_started, keep_programs_as, takes_option
from ._kept_programs import KeptPrograms
from ._kept_traces import find_by_traces
from ._machine import use_one_thread_in_lapack

# Options of XLA for quick compilation. One kernel of a simulation is a few numbers: XLA's older loop emitter gives code
# that is as fast and compiles in half the time. The disabled passes pay for themselves in large arrays only. A loop
# that reads and writes less than 64 KiB in a turn, such as an elimination, becomes one kernel. It is long for LLVM,
# whose highest level unrolls it without gain.
_PASSES = (
    "while-loop-invariant-code-motion",
    "while-loop-constant-sinking",
    "reshape-mover",
    "tree_reduction_rewriter",
    "simplify-sorts",
    "simplify-conditional",
)
_KERNEL_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
_QUICKLY = {
    "xla_cpu_use_fusion_emitters": "false",
    "xla_backend_optimization_level": "2",
    "xla_backend_extra_options": f"{_KERNEL_LOOPS}={2**16}",
    "xla_disable_hlo_passes": ",".join(_PASSES),
}
# For speed the loop over steps becomes one kernel too, unless it contains library calls, which one of these passes
# makes of products of matrices. Calling a hundred kernels takes most of the time of a step. With large arrays the calls
# cost nothing, and LLVM takes minutes for a long kernel: so loops of more than 1 MiB are excluded.
_FOR_SPEED = _QUICKLY | {
    "xla_backend_extra_options": f"{_KERNEL_LOOPS}={2**20}",
    "xla_disable_hlo_passes": ",".join((*_PASSES, "dot-library-rewriter")),
}
# For batches a whole block of members becomes one kernel. Its inner loops run over members, which stand side by side in
# the registers of a processor. With multi-output fusion XLA computes a value once, and not once for each use. LLVM must
# not unroll the loops over members, since it would no longer vectorise them. It vectorises these short loops also where
# it has to check at run time that operands and results do not overlap.
_VECTORS = f"{_KERNEL_LOOPS}={2**27},xla_cpu_use_multi_output_fusion=true,xla_cpu_disable_loop_unrolling=true"
_SHORT_LOOPS = "-vectorizer-min-trip-count=4"
_FOR_BATCHES = _FOR_SPEED | {
    "xla_backend_optimization_level": "3",
    "xla_backend_extra_options": f"{_VECTORS},{_SHORT_LOOPS}",
    "xla_disable_hlo_passes": f"{_FOR_SPEED['xla_disable_hlo_passes']},cpu-parallel-task-assigner",
    "xla_cpu_prefer_vector_width": "512",
}
_OPTIONS = {"quickly": _QUICKLY, "later": _QUICKLY, "for speed": _FOR_SPEED, "for batches": _FOR_BATCHES, None: {}}
# Python collects garbage when new objects outnumber deleted objects by this. Tracing a program makes a million objects
# with little garbage, and with the default of 700 the collection takes a sixth of the time.
_NEW_OBJECTS = 50_000
# The environment variable with a folder that replaces the program's choice, or `off`.
VARIABLE = "JAXMB_CACHE"
MAX_BYTES = 2**27
# Settings of JAX besides the folder: to keep every program, since hundreds of small ones take seconds together too.
SETTINGS = {
    "jax_compilation_cache_max_size": MAX_BYTES,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


def setup(
    *,
    x64: bool = True,
    compile: Literal["quickly", "for speed", "for batches", "later"] | None = "quickly",
    keep: bool | str | os.PathLike[str] = True,
    max_bytes: int = MAX_BYTES,
) -> None:
    """Prepare JAX: double precision, short waits for programs, and programs that later processes find.

    ```python
    import jaxmb

    jaxmb.setup()  # At the head of a script or notebook, before anything is computed.
    ```

    It changes settings of JAX for the whole process. Importing jaxmb changes none; the command line calls this.
    `jaxmb help compiling` has more.

    **Arguments:**

    - `x64`: whether JAX computes in double precision; False leaves its precision as it is.
    - `compile`: with `"quickly"` programs compile in about six tenths of the time. With `"for speed"` programs of small
        machines run in a third to three quarters of the time. With `"for batches"` members of `jaxmb.batch` and `sweep`
        are computed side by side, and values of a `jax.vmap`. Results differ in rounding. These set options of XLA
        for processors in the environment variable `XLA_FLAGS`; options that are set there already stay. With `None`, or
        if JAX has an accelerator, no options are set. LAPACK computes with one thread but with `None`, or where
        `OPENBLAS_NUM_THREADS` or `OMP_NUM_THREADS` is in the environment.
        With `"later"`, for modelling, no first call waits for the compiler. NumPy computes it, and the compiler works
        in the background, with the options of `"quickly"`. Digits and numbers of steps change within the tolerance when
        the program is there, so finite differences, sweeps and tests need another choice.
    - `keep`: whether compiled programs are kept on disk, for this and later processes; or the folder to keep them in,
        by default `jaxmb` in the user's cache folder: in `$XDG_CACHE_HOME`, in `~/.cache`, on macOS `~/Library/Caches`,
        on Windows `%LOCALAPPDATA%`. The environment variable `JAXMB_CACHE` takes precedence: another folder, or `off`.
        If JAX has a folder already, it stays, with its settings.
    - `max_bytes`: size of the folder beyond which the programs unused for longest are dropped [bytes].

    **Raises:** a `ValueError` for other values. `UserWarning`s tell of a folder that cannot be written to, and of a JAX
    that has computed something already, after which options of XLA have no effect.
    """
    if compile not in _OPTIONS:
        raise ValueError(f'compile must be "quickly", "for speed", "for batches", "later" or None, got {compile!r}.')
    if not isinstance(keep, bool | str | os.PathLike):
        raise ValueError(f"keep must be True, False or the folder to keep compiled programs in, got {keep!r}.")
    if not max_bytes > 0:
        raise ValueError(f"max_bytes must be positive, got {max_bytes}.")
    _later["on"] = compile == "later"
    if x64:
        jax.config.update("jax_enable_x64", True)
    if compile is not None:
        _look_for_garbage_less_often()
        use_one_thread_in_lapack()
    _tell(_OPTIONS[compile] if computes_on_processors() else {})
    if keep is not False:
        _keep_programs(None if keep is True else keep, max_bytes)


# Whether the compiler works in the background.
_later = {"on": False}


def compiles_later() -> bool:
    """Whether NumPy computes programs until the compiler has made them."""
    return _later["on"]


# The options that this module has set in XLA_FLAGS.
_told: dict[str, str] = {}


def _look_for_garbage_less_often() -> None:
    first, *older_generations = gc.get_threshold()
    # Zero switches the collection off.
    if 0 < first < _NEW_OBJECTS:
        gc.set_threshold(_NEW_OBJECTS, *older_generations)


def _tell(flags: dict[str, str]) -> None:
    """Set options of XLA, in place of the options that this module has set before."""
    given = os.environ.get("XLA_FLAGS", "").split()
    kept = [flag for flag in given if flag not in {f"--{name}={value}" for name, value in _told.items()}]
    flags = {name: _of_llvm(value) for name, value in flags.items()}
    names = [name for name in flags if takes_option(name) and not any(flag.startswith(f"--{name}") for flag in kept)]
    told = [f"--{name}={flags[name]}" for name in names]
    if set(given) == {*kept, *told}:
        return
    if has_started():
        warnings.warn(
            "JAX has computed something already, so this makes no difference to how programs compile: call "
            "jaxmb.setup() at the head of the script or notebook.",
            stacklevel=3,
        )
        return
    _told.clear()
    _told.update({name: flags[name] for name in names})
    os.environ["XLA_FLAGS"] = " ".join([*kept, *told])


def _of_llvm(value: str) -> str:
    """A value without the options of LLVM that this XLA does not take; they begin with a dash."""
    parts = value.split(",")
    return ",".join(x for x in parts if not x.startswith("-") or takes_option(x[1:].partition("=")[0]))


def computes_side_by_side() -> bool:
    """Whether XLA was told to compile batches whose members stand side by side."""
    return _VECTORS in os.environ.get("XLA_FLAGS", "")


def bytes_of_kernel_loops() -> int:
    """The bytes in a turn below which XLA was told to make a loop one kernel; zero if it was not told."""
    flag = re.search(rf"{_KERNEL_LOOPS}=(\d+)", os.environ.get("XLA_FLAGS", ""))
    return int(flag[1]) if flag else 0


def _keep_programs(folder: str | os.PathLike[str] | None, max_bytes: int) -> None:
    """Keep compiled programs on disk, by JAX's persistent compilation cache; any number of processes share the folder,
    and none waits for another.
    """
    told = os.environ.get(VARIABLE)
    if kept_in() is not None or not _setting("jax_enable_compilation_cache") or told == "off":
        return
    chosen = told or folder
    try:
        path = _default_folder() if chosen is None else Path(chosen).expanduser().absolute()
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except (OSError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        warnings.warn(
            f"compiled programs are not kept: {chosen or 'the cache folder'} cannot be written to ({reason}); "
            f"{VARIABLE} names another folder, or is off.",
            stacklevel=3,
        )
        return
    for name, value in (SETTINGS | {"jax_compilation_cache_max_size": max_bytes}).items():
        jax.config.update(name, value)
    jax.config.update("jax_compilation_cache_dir", str(path))
    keep_programs_as(KeptPrograms)
    find_by_traces()


def kept_in() -> Path | None:
    """The folder that compiled programs are kept in; None if they are not."""
    folder = _setting("jax_compilation_cache_dir")
    return Path(folder) if folder and _setting("jax_enable_compilation_cache") else None


def _setting(name: str) -> Any:
    return getattr(jax.config, name)


def _default_folder() -> Path:
    """The folder of this package among the user's caches."""
    above = os.environ.get("XDG_CACHE_HOME") or (sys.platform == "win32" and os.environ.get("LOCALAPPDATA"))
    if above:
        return Path(above) / "jaxmb"
    return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "jaxmb"
