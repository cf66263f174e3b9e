"""How programs are compiled: quickly, and once a machine instead of once a process, since they are kept on disk."""

import gc
import os
import re
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import jax

from ._compat import has_started, keep_programs_as
from ._kept_programs import KeptPrograms

# What XLA is told by `compile_quickly`: one kernel of a simulation is a few numbers, for which its older way to emit
# loops gives code that is as fast and compiles in half the time; the passes pay for themselves in large arrays only. A
# loop that reads and writes less than 64 KiB in a turn, such as an elimination, becomes one kernel; it is long for
# LLVM, which at its highest level unrolls it, for nothing.
_PASSES = (
    "while-loop-invariant-code-motion",
    "while-loop-constant-sinking",
    "reshape-mover",
    "tree_reduction_rewriter",
    "simplify-sorts",
    "simplify-conditional",
)
_KERNEL_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
_COMPILE_QUICKLY = {
    "xla_cpu_use_fusion_emitters": "false",
    "xla_backend_optimization_level": "2",
    "xla_backend_extra_options": f"{_KERNEL_LOOPS}={2**16}",
    "xla_disable_hlo_passes": ",".join(_PASSES),
}
# By `run_quickly`: the loop over steps becomes one kernel too, unless it contains what XLA leaves to a library, as it
# does products of matrices by one of these passes. Calling a hundred kernels takes most of the time of a step. In large
# arrays it takes none of it, and what is too long takes LLVM minutes: no loops of more than 1 MiB.
_RUN_QUICKLY = _COMPILE_QUICKLY | {
    "xla_backend_extra_options": f"{_KERNEL_LOOPS}={2**20}",
    "xla_disable_hlo_passes": ",".join((*_PASSES, "dot-library-rewriter")),
}
# Python looks for garbage after so many more new objects than have gone. A program is traced into a million of them,
# among which there is little, and the search takes a sixth of that time when it comes after 700, as by default.
_NEW_OBJECTS = 50_000
# The folder in place of that which a program names, or `off`.
VARIABLE = "JAXMB_CACHE"
MAX_BYTES = 2**27
# What JAX is told besides the folder: to keep every program, as hundreds of small ones take seconds together too.
SETTINGS = {
    "jax_compilation_cache_max_size": MAX_BYTES,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


def compile_quickly() -> None:
    """Let programs compile in about six tenths of the time.

    ```python
    jaxmb.compile_quickly()  # At the head of a script or notebook, before anything is computed.
    ```

    It sets options of XLA in the environment variable `XLA_FLAGS`, for all of JAX in this process and in those that it
    starts; options that are set there already stay. And it lets Python look for garbage less often, by
    `gc.set_threshold`, which makes tracing a sixth faster. Importing jaxmb never does that; the command line does, but
    for reports. Steps take about as long as without, and those of a hundred bodies up to a sixth longer: use
    `run_quickly` for what runs for much longer than it compiles. Results differ in rounding. The options are meant for
    processors: leave it out where JAX computes on a GPU.

    What is compiled may be kept for later processes, by `keep_compiled`.

    A `UserWarning` tells where JAX has computed something already, after which options have no effect.
    """
    _tell(_COMPILE_QUICKLY)


def run_quickly() -> None:
    """Let programs of small machines run in a third to three quarters of the time.

    ```python
    jaxmb.run_quickly()  # At the head of a script that computes for minutes, before anything is computed.
    ```

    As `compile_quickly`, in whose place it is called, with one difference: the loop over steps becomes one kernel of
    XLA. Otherwise a step calls a hundred, which for a machine of a few bodies takes most of its time. A step takes 2.0
    instead of 6.6 µs for a four-bar, 5.3 instead of 14 for Andrews' mechanism, 9.8 instead of 18 for ten rods, and 49
    instead of 66 for Bricard's, with gradients likewise; these compile for a tenth to twice longer than with
    `compile_quickly`. A loop stays as it is where it reads and writes more than 1 MiB in a step, as that of a hundred
    bodies or of a large block of a batch does, or calls a library, as for matrices of more than 40 rows that are dense;
    a step of a hundred rods takes a fifth longer than without options.
    """
    _tell(_RUN_QUICKLY)


# What this module has set in XLA_FLAGS.
_told: dict[str, str] = {}


def _tell(flags: dict[str, str]) -> None:
    first, *others = gc.get_threshold()
    # Zero switches the search off.
    if 0 < first < _NEW_OBJECTS:
        gc.set_threshold(_NEW_OBJECTS, *others)
    given = os.environ.get("XLA_FLAGS", "").split()
    kept = [flag for flag in given if flag not in {f"--{name}={value}" for name, value in _told.items()}]
    new = {name: value for name, value in flags.items() if not any(flag.startswith(f"--{name}") for flag in kept)}
    told = [f"--{name}={value}" for name, value in new.items()]
    if set(told) <= set(given):
        return
    if has_started():
        warnings.warn(
            "JAX has computed something already, so this makes no difference to how programs compile: call "
            "jaxmb.compile_quickly() or jaxmb.run_quickly() at the head of the script or notebook.",
            stacklevel=3,
        )
        return
    _told.update(new)
    os.environ["XLA_FLAGS"] = " ".join([*kept, *told])


def bytes_of_kernel_loops() -> int:
    """The bytes in a turn below which XLA was told to make a loop one kernel; zero where it was not told."""
    found = re.search(rf"{_KERNEL_LOOPS}=(\d+)", os.environ.get("XLA_FLAGS", ""))
    return int(found[1]) if found else 0


def keep_compiled(folder: str | os.PathLike[str] | None = None, *, max_bytes: int = MAX_BYTES) -> Path | None:
    """Keep compiled programs on disk, and use those that are there: the second process does not compile again.

    ```python
    folder = jaxmb.keep_compiled()  # At the head of a script or notebook, before anything is compiled.
    ```

    The name says what is kept, which "cache" alone would not. JAX's persistent compilation cache keeps it, for all of
    JAX in this process; any number of processes share the folder, and none waits for another one. Importing jaxmb never
    switches that on; the command line does, but for reports. Call it first: what was compiled before is not kept. What
    JAX does not recognise is compiled again: another version of it or another processor, another scene or number of its
    bodies, another method; other numbers are the same program.
    Programs that call Python are not kept: those with `throw=True`, and those of second derivatives where there may be
    more than 2048 steps, as under `jit` with a `max_steps` above that.

    Other users of the machine who can write to the folder can make this process run what they like.

    **Arguments:**

    - `folder`: by default `jaxmb` in the user's cache folder: in `$XDG_CACHE_HOME` if that is set, in `~/.cache`, on
        macOS `~/Library/Caches`, on Windows `%LOCALAPPDATA%`. The environment variable `JAXMB_CACHE` takes its place:
        another folder, or `off` to keep nothing.
    - `max_bytes`: size of the folder beyond which programs that have not been used for longest are dropped [bytes].
        Each process that writes may exceed it by a 32nd.

    **Returns:** the folder that programs are kept in; None if they are not. Where JAX has a folder already, from
    `JAX_COMPILATION_CACHE_DIR` or from `jax.config`, that one stays, with its settings.

    **Raises:** a `ValueError` for a size that is not positive. A folder that cannot be written to is a warning, and
    programs are not kept.
    """
    if max_bytes <= 0:
        raise ValueError(f"max_bytes must be positive, got {max_bytes}.")
    told = os.environ.get(VARIABLE)
    if kept_in() is not None or not _setting("jax_enable_compilation_cache") or told == "off":
        return kept_in()
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
            stacklevel=2,
        )
        return None
    for name, value in (SETTINGS | {"jax_compilation_cache_max_size": max_bytes}).items():
        jax.config.update(name, value)
    jax.config.update("jax_compilation_cache_dir", str(path))
    keep_programs_as(KeptPrograms)
    return path


def kept_in() -> Path | None:
    """The folder that compiled programs are kept in; None if they are not."""
    folder = _setting("jax_compilation_cache_dir")
    return Path(folder) if folder and _setting("jax_enable_compilation_cache") else None


def _setting(name: str) -> Any:
    return getattr(jax.config, name)


def _default_folder() -> Path:
    """That of this package among the user's caches."""
    above = os.environ.get("XDG_CACHE_HOME") or (sys.platform == "win32" and os.environ.get("LOCALAPPDATA"))
    if above:
        return Path(above) / "jaxmb"
    return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "jaxmb"
