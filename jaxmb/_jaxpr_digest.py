"""Hashes of traced programs: equal for programs that compute the same in the same way, also in another process."""

import dataclasses
import functools
import hashlib
import types
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ._compat import REVERSE, RULES, ClosedJaxpr, Jaxpr, Literal, jaxpr_as_function, like_of
from ._traced_functions import is_installed, is_of_jax

_PLAIN = {bool, int, float, complex, str, bytes, type(None), type(Ellipsis)}


class Digest(NamedTuple):
    """The hash of a program.

    **Fields:** `value`: the same in every process; `unknown`: functions of the user that the program calls from Python,
    and objects that only their address distinguishes. The hash contains their names.
    """

    value: bytes
    unknown: tuple[Any, ...]


def digest_of(value: Any, *, rules: bool) -> Digest:
    """The hash of a closed jaxpr: its equations with all their parameters, the programs within, literals and constants;
    or of nested dictionaries and tuples of arrays.

    **Arguments:** `rules`: whether derivative rules of functions count, `custom_jvp` and `custom_vjp`. A program that
    is not differentiated does not use them.
    """
    digest = _Digest()
    text = digest.of(value)
    if rules and digest.rules:
        text = _joined("rules", [text, digest.of_derivative(value)])
    return Digest(text, tuple(digest.unknown))


class _Digest:
    """Hashes of programs; `rules`: the names of the derivative rules of their equations."""

    def __init__(self):
        self.unknown: list[Any] = []
        self.rules: set[str] = set()
        # Programs that occur several times. Each hash keeps its program, so that no other program gets its address.
        self._done: dict[int, tuple[Any, bytes]] = {}
        self._shapes: dict[Any, str] = {}
        # Functions of packages, which may close over each other.
        self._functions: dict[int, Any] = {}

    def of(self, value: Any) -> bytes:
        """The hash of a program, or of a parameter of an equation."""
        kind = type(value)
        if kind in _PLAIN:
            return _joined(kind.__name__, [repr(value).encode()])
        name = f"{kind.__module__}.{kind.__qualname__}"
        if isinstance(value, ClosedJaxpr):
            # From jax 0.12 on, every program is closed.
            return _joined("closed", [self._program_once(value.jaxpr), *map(self._array, value.consts)])
        if isinstance(value, Jaxpr):
            return self._program_once(value)
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            return self._array(value)
        if isinstance(value, Mapping):
            items = sorted(value.items(), key=lambda item: repr(item[0]))
            return _joined(name, [part for item in items for part in map(self.of, item)])
        if isinstance(value, list | tuple):
            return _joined(name, list(map(self.of, value)))
        if isinstance(value, set | frozenset):
            return _joined(name, sorted(map(self.of, value)))
        if isinstance(value, jax.tree_util.PyTreeDef):
            return _joined(name, [self.of(value.node_data()), *map(self.of, value.children())])
        if isinstance(value, functools.partial):
            return _joined(name, [self.of(value.func), self.of(value.args), self.of(value.keywords)])
        if isinstance(value, types.MethodType):
            return _joined(name, [self.of(value.__func__), self.of(value.__self__)])
        if isinstance(value, types.FunctionType):
            return self._function(value)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            fields = [(entry.name, getattr(value, entry.name, None)) for entry in dataclasses.fields(value)]
            return _joined(name, [part for field in fields for part in map(self.of, field)])
        if (wrapped := getattr(value, "__wrapped__", None)) is not None:
            return _joined(name, [self.of(wrapped)])
        return _joined(name, [self._shown(value)])

    def _program_once(self, program: Any) -> bytes:
        if id(program) not in self._done:
            self._done[id(program)] = program, self._program(program)
        return self._done[id(program)][1]

    def _program(self, program: Any) -> bytes:
        numbers: dict[Any, int] = {}

        def named(variables: Iterable[Any]) -> list[bytes]:
            return [f"{numbers.setdefault(v, len(numbers))} {self._shape(v.aval)}".encode() for v in variables]

        def given(operands: Iterable[Any]) -> list[bytes]:
            return [
                _joined(self._shape(v.aval), [self._array(v.val)])
                if isinstance(v, Literal)
                else str(numbers[v]).encode()
                for v in operands
            ]

        parts = named([*program.constvars, *program.invars])
        for equation in program.eqns:
            parts += [equation.primitive.name.encode(), *given(equation.invars)]
            for name, value in sorted(equation.params.items()):
                if name in RULES:
                    self.rules.add(name)
                elif hasattr(value, "program_of"):
                    operands = [like_of(v.aval) for v in equation.invars]
                    parts += [name.encode(), self.of(value.program_of(operands))]
                else:
                    parts += [name.encode(), self.of(value)]
            parts += named(equation.outvars)
        return _joined("program", [*parts, *given(program.outvars)])

    def of_derivative(self, program: Any) -> bytes:
        """The hash of the derivative of a program, which uses the rules of its equations."""
        function = jaxpr_as_function(program)
        likes = [like_of(x) for x in program.in_avals]
        real = [k for k, like in enumerate(likes) if jnp.issubdtype(like.dtype, jnp.floating)]

        def derivative(values: list[Any]) -> Any:
            of_real = lambda *reals: function(*(dict(enumerate(values)) | dict(zip(real, reals, strict=True))).values())
            reals = [values[k] for k in real]
            if REVERSE in self.rules:
                out, pull = jax.vjp(of_real, *reals)
                return pull(jax.tree.map(jnp.ones_like, out))
            return jax.jvp(of_real, reals, [jnp.ones_like(x) for x in reals])

        try:
            return self.of(jax.make_jaxpr(derivative)(likes))
        except Exception:  # A rule may raise anything for a derivative that it does not support.
            self.unknown.append(program)
            return b""

    def _shape(self, kind: Any) -> str:
        if kind not in self._shapes:
            self._shapes[kind] = repr(kind)
        return self._shapes[kind]

    def _array(self, value: Any) -> bytes:
        if isinstance(value, Tracer):
            self.unknown.append(value)
            return b""
        if isinstance(value, jax.Array) and not isinstance(value.dtype, np.dtype):
            # A key of random numbers.
            return _joined(repr(value.dtype), [self._array(jax.random.key_data(value))])
        array = np.asarray(value)
        return _joined(f"{array.dtype} {array.shape}", [array.tobytes()])

    def _function(self, function: types.FunctionType) -> bytes:
        """A function that is called from Python, as in a callback: a package's function counts by its name and by the
        values that it closes over or has as defaults. Of JAX and its relatives only the name counts.
        """
        name = f"{function.__module__}.{function.__qualname__}".encode()
        if not is_installed(function.__code__.co_filename):
            self.unknown.append(function)
            return _joined("function", [name])
        if id(function) in self._functions or is_of_jax(function.__module__):
            return _joined("function", [name])
        self._functions[id(function)] = function
        held = [cell.cell_contents for cell in function.__closure__ or () if _is_filled(cell)]
        held += [function.__defaults__, function.__kwdefaults__]
        return _joined("function", [name, *map(self.of, held)])

    def _shown(self, value: Any) -> bytes:
        shown = repr(value)
        if " at 0x" in shown:
            self.unknown.append(value)
            return b""
        return shown.encode()


def _is_filled(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False


def _joined(tag: str, parts: list[bytes]) -> bytes:
    """A hash of parts that depends on where each part ends."""
    digest = hashlib.sha256(tag.encode())
    for part in parts:
        digest.update(len(part).to_bytes(8, "little") + part)
    return digest.digest()
