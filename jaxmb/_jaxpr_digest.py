"""Hashes of traced programs: equal for programs that compute the same in the same way, also in another process."""

import dataclasses
import functools
import hashlib
import marshal
import sys
import types
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ._compat import BATCH_RULE, REVERSE, RULES, ClosedJaxpr, Jaxpr, Literal, jaxpr_as_function, like_of, settings_of
from ._traced_functions import is_installed, is_of_jax

_PLAIN = {bool, int, float, complex, str, bytes, type(None), type(Ellipsis)}


class Digest(NamedTuple):
    """The hash of a program.

    **Fields:** `value`: the same in every process; `unknown`: functions of the user that the program calls from Python,
    and objects of the user's classes, or that only their address distinguishes. The hash contains their names.
    `operations` of the program; whether an operation `calls` functions of packages, besides rules of derivatives and
    batches: the hash contains their names.
    """

    value: bytes
    unknown: tuple[Any, ...]
    operations: frozenset[Any]
    calls: bool


def digest_of(value: Any, *, rules: bool) -> Digest:
    """The hash of a closed jaxpr: its equations with all their parameters, the programs within, literals and constants;
    or of nested dictionaries and tuples of arrays.

    **Arguments:** `rules`: whether derivative rules of functions count, `custom_jvp` and `custom_vjp`. A program that
    is not differentiated does not use them.
    """
    digest = _Digest()
    text = _hashed(digest.of(value))
    if rules and digest.rules:
        text = _hashed(["rules", text, digest.of_derivative(value)])
    return Digest(text, tuple(digest.unknown), frozenset(digest.operations), digest.calls)


class _Digest:
    """Texts of programs and their parameters, of which a hash is made: plain values, tuples of texts, and lists that
    begin with the name of a type.

    **Fields:** `rules`: the names of the derivative rules of the equations; `unknown`, `operations` and `calls` of the
    `Digest`.
    """

    def __init__(self):
        self.unknown: list[Any] = []
        self.rules: set[str] = set()
        self.operations: set[Any] = set()
        self.calls = False
        # Values that occur several times. Each text keeps its value, so that no other value gets its address.
        self._done: dict[int, tuple[Any, Any]] = {}
        self._contexts: dict[tuple[int, ...], str] = {}
        self._shapes: dict[Any, str] = {}
        # Functions of packages, which may close over each other.
        self._functions: dict[int, Any] = {}

    def of(self, value: Any) -> Any:
        """The text of a program, or of a parameter of an equation."""
        kind = type(value)
        if kind in _PLAIN:
            return value
        if kind is tuple:
            return tuple([x if type(x) in _PLAIN else self.of(x) for x in value])
        if kind is types.FunctionType:
            return self._function(value)
        if id(value) not in self._done:
            self._done[id(value)] = value, self._text(value, kind)
        return self._done[id(value)][1]

    def _text(self, value, kind):
        name = f"{kind.__module__}.{kind.__qualname__}"
        if isinstance(value, ClosedJaxpr):
            # From jax 0.12 on, every program is closed.
            return ["closed", self.of(value.jaxpr), *map(self._array, value.consts)]
        if isinstance(value, Jaxpr):
            return _hashed(self._program(value))
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            return self._array(value)
        if isinstance(value, Mapping):
            items = sorted(value.items(), key=lambda item: repr(item[0]))
            return [name, *(self.of(part) for item in items for part in item)]
        if isinstance(value, list | tuple):
            return [name, *map(self.of, value)]
        if isinstance(value, set | frozenset):
            return [name, *sorted(_hashed(self.of(x)) for x in value)]
        if isinstance(value, jax.tree_util.PyTreeDef):
            return [name, self.of(value.node_data()), *map(self.of, value.children())]
        if isinstance(value, functools.partial):
            return [name, self.of(value.func), self.of(value.args), self.of(value.keywords)]
        if isinstance(value, types.MethodType):
            return [name, self.of(value.__func__), self.of(value.__self__)]
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            fields = [(entry.name, getattr(value, entry.name, None)) for entry in dataclasses.fields(value)]
            return [name, *map(self.of, fields)]
        if (wrapped := getattr(value, "__wrapped__", None)) is not None:
            return [name, self.of(wrapped)]
        return [name, self._shown(value)]

    def _program(self, program: Any) -> Any:
        numbers: dict[Any, int] = {}
        shapes = self._shapes

        def named(variables: Iterable[Any]) -> list[Any]:
            return [(numbers.setdefault(v, len(numbers)), shapes.get(v.aval) or self._shape(v.aval)) for v in variables]

        def given(operands: Iterable[Any]) -> list[Any]:
            return [
                [self._shape(v.aval), self._array(v.val)] if isinstance(v, Literal) else numbers[v] for v in operands
            ]

        text = ["program", named(program.constvars), named(program.invars)]
        for equation in program.eqns:
            self.operations.add(equation.primitive)
            parts: list[Any] = [equation.primitive.name, given(equation.invars), self._context(equation)]
            for name, value in sorted(equation.params.items()):
                if name in RULES:
                    self.rules.add(name)
                elif name == BATCH_RULE:
                    rule = _Digest()
                    parts += [name, rule.of(value)]
                    self.unknown += rule.unknown
                elif hasattr(value, "program_of"):
                    operands = [like_of(v.aval) for v in equation.invars]
                    parts += [name, self.of(value.program_of(operands))]
                else:
                    parts += [name, value if type(value) in _PLAIN else self.of(value)]
            text.append([*parts, named(equation.outvars)])
        return [*text, given(program.outvars)]

    def of_derivative(self, program: Any) -> Any:
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

    def _context(self, equation: Any) -> str:
        """The settings that an equation was traced with; they live as long as the equation."""
        key = tuple(map(id, settings_of(equation)))
        if key not in self._contexts:
            self._contexts[key] = repr(equation.ctx)
        return self._contexts[key]

    def _array(self, value: Any) -> Any:
        if isinstance(value, Tracer):
            self.unknown.append(value)
            return b""
        if isinstance(value, jax.Array) and not isinstance(value.dtype, np.dtype):
            # A key of random numbers.
            return [repr(value.dtype), self._array(jax.random.key_data(value))]
        array = np.asarray(value)
        return [f"{array.dtype} {array.shape}", array.tobytes()]

    def _function(self, function: types.FunctionType) -> Any:
        """A function that is called from Python, as in a callback: a package's function counts by its name and by the
        values that it closes over or has as defaults. Of JAX and its relatives only the name counts.
        """
        name = f"{function.__module__}.{function.__qualname__}"
        if not is_installed(function.__code__.co_filename):
            self.unknown.append(function)
            return ["function", name]
        self.calls = True
        if id(function) in self._functions or is_of_jax(function.__module__):
            return ["function", name]
        self._functions[id(function)] = function
        return ["function", name, *map(self.of, held_by(function))]

    def _shown(self, value: Any) -> str:
        shown = repr(value)
        if " at 0x" in shown or not _is_of_package(value if isinstance(value, type) else type(value)):
            self.unknown.append(value)
            return ""
        return shown


def held_by(function: types.FunctionType) -> list[Any]:
    """The values that a function closes over or has as defaults."""
    held = [cell.cell_contents for cell in function.__closure__ or () if _is_filled(cell)]
    return [*held, function.__defaults__, function.__kwdefaults__]


def _is_filled(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is not cell
    except ValueError:
        return False


def _is_of_package(kind: type) -> bool:
    module = sys.modules.get(kind.__module__)
    file = getattr(module, "__file__", None)
    # Modules of the interpreter have no file, and neither has what a user types.
    return is_installed(file) if file else module is not None and kind.__module__ != "__main__"


def _hashed(text: Any) -> bytes:
    # The second format has no references, which would depend on the identity of objects.
    return hashlib.sha256(marshal.dumps(text, 2)).digest()
