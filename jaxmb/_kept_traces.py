"""Compiled programs found on disk by the hashes of their traces, so that a later process does not lower them.

JAX finds a program by a hash of its lowered text, and to lower a motion takes about as long as to trace it. Here a file
beside the program tells its hash, and how JAX calls it, under a hash of the traced program and of all else that the
lowered text depends on. The program itself is on disk once.
"""

import functools
import hashlib
import marshal
import os
import pickle
import sys
import types
import weakref
from collections.abc import Callable, Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from ._compat import (
    compile_calls_by,
    goes_anywhere,
    is_pure,
    lowering_of,
    pickled_executable,
    unpickled_executable,
)
from ._jaxpr_digest import digest_of, held_by
from ._kept_programs import KeptPrograms, asked
from ._traced_functions import is_of_jax

# Programs of fewer equations, without linear maps, are lowered as quickly as found.
_FEWEST = 100
_CHECK = hashlib.sha256().digest_size
# Packages of which the lowered text depends on more than the trace.
_PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "lineax", "optimistix", "numpy")
# How names of files begin.
TRACE = "trace"
# The executables of traces by the settings of the call, None where JAX has lowered the trace.
_executables: weakref.WeakKeyDictionary[Any, dict[Any, Any]] = weakref.WeakKeyDictionary()


@functools.cache
def find_by_traces() -> None:
    """Let JAX look for the traces of compiled functions that it calls, in a folder of `KeptPrograms`."""
    compile_calls_by(_compiled)


def _compiled(arrays: tuple[Any, ...], params: dict[str, Any], compile: Callable[[], Any]) -> Any:
    """The executable of a call of a compiled function with these parameters; `compile` is what JAX does."""
    program = params["jaxpr"]
    if not goes_anywhere(arrays, params) or not _has_many_equations(program):
        return compile()
    call = {name: params[name] for name in ("name", "donated_invars", "keep_unused", "compiler_options_kvs")}
    settings = *call.values(), tuple((name, repr(value)) for name, value in jax.config.values.items())
    executables = _executables.setdefault(program, {})
    if settings in executables:
        return executables[settings] or compile()
    executables[settings] = None
    surroundings = _surroundings(settings[-1], params["compiler_options_kvs"], _flags())
    key = None if surroundings is None else _key(program, call, surroundings[1])
    if surroundings is None or key is None:
        return compile()
    store = surroundings[0]
    executables[settings] = _read(store, key)
    if executables[settings] is None:
        executable, place = _noted(compile)
        if place is not None and is_pure(executable):
            _keep(store, key, executable, place[1])
        return executable
    for event in ("compile_requests_use_cache", "cache_hits"):
        jax.monitoring.record_event(f"/jax/compilation_cache/{event}")
    return executables[settings]


def _noted(compile: Callable[[], Any]) -> tuple[Any, tuple[KeptPrograms, str] | None]:
    """What the compiler makes, and the store and hash of the program that JAX asks for, None if it asks for none."""
    asked.program = None
    return compile(), asked.program


def _key(program: Any, call: dict[str, Any], surroundings: bytes) -> str | None:
    """The name of a program on disk; None if its lowered text may depend on code or objects of the user."""
    digest = digest_of((program, call), rules=False)
    lowered = list(map(_lowered_by, digest.operations))
    if digest.unknown or digest.calls or None in lowered:
        return None
    text = [surroundings, digest.value, sorted(filter(None, lowered))]
    return f"{TRACE}-{hashlib.sha256(marshal.dumps(text, 2)).hexdigest()}"


def _read(store: KeptPrograms, key: str) -> Any:
    """The executable of this name; None without one, and for files that cannot be read."""
    try:
        kept = store.get(key)
        if kept is None or hashlib.sha256(kept[_CHECK:]).digest() != kept[:_CHECK]:
            return None
        return unpickled_executable(kept[_CHECK:])
    except Exception:  # JAX raises anything for a program that it cannot read, and will warn of it.
        return None


def _keep(store: KeptPrograms, key: str, executable: Any, program: str) -> None:
    try:
        text = pickled_executable(executable, program)
    except (AttributeError, TypeError, pickle.PicklingError):
        return  # It holds an object of this process.
    store.put(key, hashlib.sha256(text).digest() + text)


def _has_many_equations(program: Any) -> bool:
    count, waiting = 0, [program]
    while waiting and count < _FEWEST:
        value = waiting.pop()
        if isinstance(value, tuple):
            waiting += value
        elif hasattr(value, "program_of"):
            return True
        elif hasattr(value, "eqns"):
            count += len(value.eqns)
            waiting += [x for equation in value.eqns for x in equation.params.values()]
    return count >= _FEWEST


@functools.lru_cache(16)
def _surroundings(settings: Any, options: Any, flags: Any) -> tuple[KeptPrograms, bytes] | None:
    """The folder of programs, and a hash of all that programs depend on besides their traces: of JAX's own hash of a
    program that computes nothing, of its settings, and of all versions. None without a folder.
    """
    lowered = jax.jit(lambda: 0, compiler_options=dict(options)).lower()
    _, place = _noted(lowered.compile)
    if place is None or jax.device_count() > 1 or ("jax_default_device", "None") not in settings:
        return None
    store, nothing = place
    package = Path(__file__).parent
    # Lowering calls functions of this package, also of one that is being changed.
    files = sorted((str(x), x.stat().st_mtime_ns, x.stat().st_size) for x in package.rglob("*.py"))
    versions = [(name, metadata.version(name)) for name in _PACKAGES]
    chosen = [x for x in settings if "_cache_" not in x[0]]
    text = [nothing, list(flags), chosen, files, versions, tuple(sys.version_info[:3])]
    return store, hashlib.sha256(marshal.dumps(text, 2)).digest()


def _flags() -> tuple[str, ...]:
    return tuple(os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS"))


@functools.cache
def _lowered_by(operation: Any) -> tuple[str, ...] | None:
    """The names of the functions that lower an operation, after its name; None unless all are of JAX, of packages that
    compute with it, or of this package.
    """
    rule = lowering_of(operation, jax.default_backend())
    kinds = [x if isinstance(x, types.FunctionType | type) else type(x) for x in _reached(rule)]
    if not kinds or not all(is_of_jax(x.__module__) or x.__module__ == "builtins" for x in kinds):
        return None
    return operation.name, *(f"{x.__module__}.{x.__qualname__}" for x in kinds)


def _reached(rule: Any) -> Iterable[Any]:
    """The functions that a function calls because it closes over them, and others in turn."""
    found: dict[int, Any] = {}
    waiting = [rule]
    while waiting:
        value = waiting.pop()
        if isinstance(value, list | tuple):
            waiting += value
        elif isinstance(value, functools.partial):
            waiting += [value.func, *value.args, *value.keywords.values()]
        elif isinstance(value, types.MethodType):
            waiting += [value.__func__, value.__self__]
        elif callable(value) and id(value) not in found:
            found[id(value)] = value
            if isinstance(value, types.FunctionType):
                waiting += held_by(value)
            waiting += [getattr(value, "__wrapped__", None)]
    return found.values()
