"""Identity of a study, as hashes: whether a store holds the results of this one or of another."""

import dis
import functools
import hashlib
import importlib.util
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..._traced_functions import is_installed
from .cases import Cases

# What jaxmb itself rests on. A new version of these is no other study.
_FOUNDATION = {"jaxmb", "jax", "jaxlib", "numpy", "scipy", "equinox", "diffrax", "lineax", "optimistix", "jaxtyping"}
# What `functools.wraps` and `jax.jit` write on a function, which says nothing that the function does not.
_OF_WRAPPERS = {"__wrapped__", *functools.WRAPPER_ASSIGNMENTS, "_jit_info"}


def identity_of_function(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """A hash of a function and of all that it uses, and what cannot be hashed: types by the path to it.

    Functions count by their compiled code, default arguments, closed-over values and the globals that they read;
    objects by their type and all their attributes, also those that are static; classes by their methods. What an
    installed package defines under a name counts by this name; unless jaxmb itself rests on the package, the file that
    defines it counts as well. The hash is the same in every process.
    """
    hashed = _Hash()
    found = hashed.of(function, (getattr(function, "__name__", type(function).__name__),))
    return found.hex(), hashed.unknown


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


class _Hash:
    """Hashes of values, each of a tag and of the hashes of the value's parts.

    An object within itself counts by the number of levels up to it, never by its address.
    """

    def __init__(self):
        self.unknown: dict[str, str] = {}
        # With each hash the value itself, so that no other value gets its address.
        self._done: dict[int, tuple[Any, bytes]] = {}
        self._open: list[int] = []

    def of(self, value: Any, path: tuple[str, ...]) -> bytes:
        """The hash of a value, at a path that errors name."""
        if type(value) in (bool, int, float, complex, str, bytes, type(None), type(Ellipsis)):
            return _joined(type(value).__name__, [repr(value).encode()])
        key = id(value)
        if key in self._done:
            return self._done[key][1]
        if key in self._open:
            return _joined("within itself", [str(len(self._open) - self._open.index(key)).encode()])
        self._open.append(key)
        tag, parts = self._parts(value, path)
        self._open.pop()
        self._done[key] = (value, _joined(tag, parts))
        return self._done[key][1]

    def _parts(self, value: Any, path: tuple[str, ...]) -> tuple[str, list[bytes]]:
        """A tag, and the hashes of what a value consists of."""
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            return self._array(value, path)
        if isinstance(value, types.ModuleType):
            return "module", [value.__name__.encode(), *_file_of(value.__name__)]
        if (name := _installed_name(value)) is not None:
            return "name", [name.encode(), *_file_of(value.__module__)]
        if isinstance(value, Mapping):
            items = [(self.of(k, path), self.of(item, (*path, f"[{k!r}]"))) for k, item in value.items()]
            return "mapping", [self.of(type(value), path), *(part for item in items for part in item)]
        if isinstance(value, list | tuple):
            items = [self.of(item, (*path, f"[{k}]")) for k, item in enumerate(value)]
            return "sequence", [self.of(type(value), path), *items]
        if isinstance(value, set | frozenset):
            return "set", sorted(self.of(item, path) for item in value)
        if isinstance(value, types.FunctionType):
            return "function", self._function(value, path)
        if isinstance(value, types.CodeType):
            return "code", self._code(value, path)
        if isinstance(value, types.MethodType):
            return "method", [self.of(value.__func__, path), self.of(value.__self__, (*path, ".__self__"))]
        if isinstance(value, jax.tree_util.PyTreeDef):
            return "tree", [self.of(value.node_data(), path), self.of(value.children(), path)]
        if isinstance(value, property):
            return "property", [self.of(f, path) for f in (value.fget, value.fset, value.fdel)]
        if isinstance(value, functools.cached_property):
            return "property", [self.of(value.func, path)]
        if isinstance(value, type):
            return "class", self._class(value, path)
        if not isinstance(value, types.BuiltinFunctionType) and hasattr(value, "__wrapped__"):
            # Functions that are compiled, cached, or have derivatives of their own.
            own = {k: v for k, v in getattr(value, "__dict__", {}).items() if k not in _OF_WRAPPERS}
            return "wrapper", [
                self.of(type(value), path),
                self.of(value.__wrapped__, path),
                *self._attributes(own, path),
            ]
        return "object", self._object(value, path)

    def _array(self, value: Any, path: tuple[str, ...]) -> tuple[str, list[bytes]]:
        if isinstance(value, Tracer):
            return "traced", self._not_known(value, path)
        if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            return "key", [repr(value.dtype).encode(), self.of(jax.random.key_data(value), path)]
        array = np.asarray(value)
        if array.dtype.hasobject:
            return "objects", [self.of([array.shape, array.ravel().tolist()], path)]
        return "array", [f"{array.dtype} {array.shape}".encode(), array.tobytes()]

    def _function(self, function: types.FunctionType, path: tuple[str, ...]) -> list[bytes]:
        code = function.__code__
        defaults = function.__defaults__ or ()
        positional = code.co_varnames[: code.co_argcount]
        used = dict(zip(positional[len(positional) - len(defaults) :], defaults, strict=True))
        used |= function.__kwdefaults__ or {}
        for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
            try:
                used[name] = cell.cell_contents
            except ValueError:  # A cell that holds nothing yet.
                continue
        if not is_installed(code.co_filename):
            used |= {f"global {name}": value for name, value in _globals(function, code)}
        return [self.of(code, path), *self._attributes(used, path)]

    def _code(self, code: types.CodeType, path: tuple[str, ...]) -> list[bytes]:
        counts = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
        names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
        return [self.of(part, path) for part in (code.co_code, code.co_exceptiontable, code.co_consts, counts, names)]

    def _class(self, kind: type, path: tuple[str, ...]) -> list[bytes]:
        own = {
            name: value
            for name, value in vars(kind).items()
            if name != "_abc_impl"
            and not isinstance(value, types.GetSetDescriptorType | types.MemberDescriptorType)
            and (callable(value) or not name.startswith("__"))
        }
        return [
            kind.__name__.encode(),
            self.of(type(kind), path),
            self.of(kind.__bases__, path),
            *self._attributes(own, (*path, f".{kind.__name__}")),
        ]

    def _object(self, value: Any, path: tuple[str, ...]) -> list[bytes]:
        """By what a copy of it would be made from."""
        try:
            reduced = value.__reduce_ex__(4)
        except Exception:  # Whatever the type raises that cannot be copied.
            return self._not_known(value, path)
        if isinstance(reduced, str):
            # The name of something that its module holds; that of a package has been found already.
            return self._not_known(value, path)
        make, arguments, state, *items = (*reduced, None, None, None)[:5]
        parts = [self.of(type(value), path), self.of(make, path), self.of(arguments, path)]
        if isinstance(state, dict):
            # A value that is computed when it is first asked for says nothing new.
            lazy = lambda name: isinstance(getattr(type(value), name, None), functools.cached_property)
            parts += self._attributes({k: v for k, v in state.items() if not lazy(str(k))}, path)
        else:
            parts.append(self.of(state, path))
        return parts + [self.of(None if item is None else list(item), path) for item in items]

    def _attributes(self, values: Mapping[Any, Any], path: tuple[str, ...]) -> list[bytes]:
        """Names and values in the order of names, whatever the order in which they were set."""
        ordered = sorted(values.items(), key=lambda item: str(item[0]))
        return [part for k, v in ordered for part in (str(k).encode(), self.of(v, (*path, f".{_shown(k)}")))]

    def _not_known(self, value: Any, path: tuple[str, ...]) -> list[bytes]:
        kind = type(value)
        self.unknown["".join(path)] = f"{kind.__module__}.{kind.__qualname__}"
        return [self.unknown["".join(path)].encode()]


def _joined(tag: str, parts: list[bytes]) -> bytes:
    """A hash of parts that tells where one ends and the next begins."""
    digest = hashlib.sha256(tag.encode())
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.digest()


def _shown(name: Any) -> str:
    return str(name).removeprefix("global ")


def _installed_name(value: Any) -> str | None:
    """The name under which a module of an installed package holds just this value."""
    module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", getattr(value, "__name__", None))
    if not (isinstance(module, str) and isinstance(name, str) and _is_of_package(module)):
        return None
    found: Any = sys.modules[module]
    for part in name.split("."):
        found = getattr(found, part, None)
    # Modules do not hold all their types; that of functions is not in `builtins`.
    is_type = isinstance(value, type) and "<locals>" not in name
    return f"{module}.{name}" if found is value or is_type else None


@functools.cache
def _is_of_package(module: str) -> bool:
    found = sys.modules.get(module)
    if found is None or module == "__main__":
        return False
    return module.partition(".")[0] in sys.stdlib_module_names or is_installed(getattr(found, "__file__", None))


def _file_of(module: str) -> list[bytes]:
    """The file of a module that may change while its names do not."""
    top = module.partition(".")[0]
    if top in _FOUNDATION or top in sys.stdlib_module_names:
        return []
    return [_bytes_of(getattr(sys.modules.get(module), "__file__", None))]


def _bytes_of(file: str | None) -> bytes:
    return hashlib.sha256(Path(file).read_bytes()).digest() if file is not None and Path(file).is_file() else b""


def _globals(function: types.FunctionType, code: types.CodeType) -> Iterator[tuple[str, Any]]:
    """The global names that a function and those within it read, with their values.

    Of a user's module what is read from it, `machine.spring`, or the whole module where this cannot be told.
    """
    steps = [step for step in dis.get_instructions(code) if step.opname not in ("CACHE", "PRECALL", "PUSH_NULL")]
    for k, step in enumerate(steps):
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME") and step.argval in function.__globals__:
            name, value = step.argval, function.__globals__[step.argval]
            for after in steps[k + 1 :]:
                own = isinstance(value, types.ModuleType) and not _is_of_package(value.__name__)
                if not (own and after.opname in ("LOAD_ATTR", "LOAD_METHOD") and hasattr(value, after.argval)):
                    break
                name, value = f"{name}.{after.argval}", getattr(value, after.argval)
            yield name, value
        elif step.opname == "IMPORT_NAME":
            level = steps[k - 2].argval
            package = function.__globals__.get("__package__") if level else None
            name = importlib.util.resolve_name("." * level + step.argval, package)
            if name in sys.modules:
                yield f"import {name}", sys.modules[name]
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            yield from _globals(function, inner)
