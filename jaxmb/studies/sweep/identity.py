"""What a study is, as hashes: whether a store holds the results of this one or of another."""

import contextlib
import functools
import hashlib
import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from .cases import Cases


def identity_of_function(function: Callable[..., Any]) -> str:
    """A hash of the source of a function and of all that it uses: defaults, closed-over and global values, functions
    of the same module, the numbers of systems. Functions of other modules count by their names.
    """
    digest = hashlib.sha256()
    _add(digest, function, getattr(function, "__module__", None), set())
    return digest.hexdigest()


def identity_of_cases(cases: Cases) -> str:
    """A hash of all parameters of all members."""
    digest = hashlib.sha256(repr(cases.grid).encode())
    for values in (cases.columns, cases.labels):
        for name, column in values.items():
            digest.update(f"{name} {column.dtype} {column.shape}".encode() + np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()


def identity_of_outputs(variables: Mapping[str, Any], cases: Cases) -> str:
    """A hash of the names, dimensions, types, shapes and units of all outputs, and of the values along dimensions."""
    digest = hashlib.sha256()
    for name, (dims, values, shape, attributes) in variables.items():
        digest.update(f"{name} {attributes}".encode())
        if isinstance(values, np.dtype):
            digest.update(f"{dims} {values} {shape[1:]}".encode())
        elif name not in cases.columns:
            digest.update(f"{dims} {values.dtype} {shape}".encode() + np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _add(digest: Any, value: Any, module: str | None, seen: set[int]) -> None:
    """Add a value to a hash, functions by their source and by what they refer to."""
    if isinstance(value, bool | int | float | complex | str | bytes | type(None)):
        digest.update(f"{type(value).__name__} {value!r}".encode())
    elif isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    elif id(value) in seen:
        return
    elif isinstance(value, Mapping):
        seen.add(id(value))
        for key, item in value.items():
            _add(digest, key, module, seen)
            _add(digest, item, module, seen)
    elif isinstance(value, list | tuple):
        digest.update(f"{type(value).__name__} {len(value)}".encode())
        for item in value:
            _add(digest, item, module, seen)
    elif isinstance(value, set | frozenset):
        digest.update(" ".join(sorted(map(repr, value))).encode())
    elif isinstance(value, functools.partial):
        _add(digest, [value.func, value.args, value.keywords], module, seen)
    elif inspect.ismethod(value):
        _add(digest, [value.__func__, value.__self__], module, seen)
    elif inspect.isfunction(value) or inspect.isfunction(getattr(value, "__wrapped__", None)):
        seen.add(id(value))
        _add_function(digest, inspect.unwrap(value), module, seen)
    elif inspect.ismodule(value) or inspect.isclass(value) or inspect.isbuiltin(value):
        digest.update(getattr(value, "__qualname__", getattr(value, "__name__", "")).encode())
        if inspect.isclass(value) and value.__module__ == module:
            digest.update(_source(value) or b"")
    else:
        # Systems and other objects: their numbers, and what they consist of.
        seen.add(id(value))
        digest.update(type(value).__module__.encode())
        _add(digest, type(value), module, seen)
        leaves = jax.tree.leaves(value)
        if len(leaves) == 1 and leaves[0] is value:
            for name, item in sorted(getattr(value, "__dict__", {}).items()):
                _add(digest, name, module, seen)
                _add(digest, item, module, seen)
        else:
            _add(digest, leaves, module, seen)


def _add_function(digest: Any, function: Any, module: str | None, seen: set[int]) -> None:
    if function.__module__ != module:
        digest.update(f"{function.__module__}.{function.__qualname__}".encode())
        return
    code = function.__code__
    digest.update(_source(function) or code.co_code + repr(_constants(code)).encode())
    _add(digest, function.__defaults__, module, seen)
    _add(digest, function.__kwdefaults__, module, seen)
    for cell in function.__closure__ or ():
        with contextlib.suppress(ValueError):  # A cell that holds nothing yet.
            _add(digest, cell.cell_contents, module, seen)
    for name in sorted(_names(code)):
        if name in function.__globals__:
            digest.update(name.encode())
            _add(digest, function.__globals__[name], module, seen)


def _source(value: Any) -> bytes | None:
    try:
        return inspect.getsource(value).strip().encode()
    except (OSError, TypeError):
        return None


def _names(code: Any) -> set[str]:
    """The global names that a function uses, and the functions within it."""
    return set(code.co_names).union(*(_names(inner) for inner in code.co_consts if inspect.iscode(inner)))


def _constants(code: Any) -> list[str]:
    def plain(constant):
        if inspect.iscode(constant):
            return _constants(constant)
        return sorted(map(repr, constant)) if isinstance(constant, frozenset) else constant

    return [re.sub("0x[0-9a-f]+", "", repr(plain(constant))) for constant in code.co_consts]
