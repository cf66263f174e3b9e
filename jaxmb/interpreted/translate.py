"""The translation of a traced program to lines of Python, equation by equation."""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from .._compat import Literal, is_of_jax, like_of
from ..lanes.calls import called, entered_in
from . import values
from .lines import Let, Line, of_first

# The types of numbers that NumPy computes with as XLA does.
_INTEGERS = [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
_TYPES = {np.dtype(name) for name in ("bool", "float64", "float32", *_INTEGERS)}
# The type of tangents of integers, without numbers.
_NONE = jax.dtypes.float0
# Constants up to this size are compared by their entries; so many entries at most are computed beforehand.
_SMALL, _MOST = 4096, 100_000


class Unsupported(Exception):
    """A program with an operation that only the compiler knows."""


class Value(NamedTuple):
    """A value of a program.

    **Fields:** the `name` in the source; `shape` and `dtype`, None for a value that is no array; the `real` shape of
    the array in NumPy, which broadcasts to `shape` (an array without axes is a scalar of NumPy); the `level`: how many
    loops it stands in at most; the `constant` itself, None if it is computed.
    """

    name: str
    shape: Any
    dtype: Any
    real: Any
    level: int
    constant: Any = None

    @property
    def is_scalar(self) -> bool:
        """Whether NumPy holds a single number."""
        return self.real == ()


class Block:
    """The lines of a block of source within an `outer` one, in `level` loops; and values by the text they come from."""

    def __init__(self, level: int = 0, outer: "Block | None" = None):
        self.level, self.outer = level, outer
        self.lines: list[Line] = []
        self.known: dict[str, Value] = {}


# `rule(translator, equation, values)` gives the value of the only output, or the values of all outputs.
Rule = Callable[["Translator", Any, list[Value]], Any]
RULES: dict[str, Rule] = {}
rule = entered_in(RULES)


class Translator:
    """A translation on its way.

    **Fields:** the `globals` of the source; the `block` that lines go to; the block around each loop that the block
    stands in; `truths`: the truth value that an integer was made from, by the name of the integer.
    """

    def __init__(self):
        self.globals: dict[str, Any] = dict(values.GLOBALS)
        self.block = Block()
        self.truths: dict[str, Value] = {}
        self._around: list[Block] = []
        self._count = 0
        self._constants: dict[Any, Value] = {}
        self._programs: dict[Any, Any] = {}
        self._source_info: Any = None

    # Names and lines

    def variable(self, aval: Any, level: int) -> Value:
        """A new name, for lines that are written by the caller."""
        return Value(self._name("v"), aval.shape, aval.dtype, aval.shape, level)

    def bind(self, value: Any) -> str:
        """The name of an object that the source uses."""
        name = self._name("k")
        self.globals[name] = value
        return name

    def constant(self, value: Any) -> Value:
        """An array that is known."""
        value = np.asarray(value)
        key = (value.dtype.str, value.shape, value.tobytes()) if value.size < _SMALL else id(value)
        if key not in self._constants:
            held = value if value.ndim else value[()]
            self._constants[key] = Value(self.bind(held), value.shape, value.dtype, value.shape, 0, value)
        return self._constants[key]

    def type(self, dtype: Any) -> str:
        """The name of a type of numbers, which converts a scalar."""
        name = f"np.{np.dtype(dtype).name}"
        return "np.bool_" if name == "np.bool" else name

    def put(
        self, text: str, uses: Sequence[Value], shape: Any, dtype: Any, real: Any = None, updates: str = ""
    ) -> Value:
        """The value of an expression.

        **Arguments:** `uses`: the values in it; `real`: the shape in NumPy, by default `shape`; `updates`: the name of
        the array that is changed in place if nothing else uses it.
        """
        real = shape if real is None else real
        if uses and all(value.constant is not None for value in uses) and math.prod(real or ()) < _MOST:
            with np.errstate(all="ignore"):
                held = eval(of_first(text, updates, f"{updates}.copy()"), self.globals)
            if real is None:
                return Value(self.bind(held), None, None, None, 0, held)
            return self.constant(np.asarray(held, dtype))._replace(shape=shape)
        level = max((value.level for value in uses), default=0)
        # Values that stay the same in a loop are computed before it.
        block = self.block if level >= self.block.level else self._around[level]
        around: Block | None = block
        while around is not None:
            if text in around.known:
                return around.known[text]._replace(shape=shape, dtype=dtype, real=real)
            around = around.outer
        value = Value(self._name("v"), shape, dtype, real, block.level)
        block.lines.append(Let(value.name, text, [x.name for x in uses], updates, self._source_info))
        block.known[text] = value
        return value

    def _name(self, letter):
        self._count += 1
        return f"{letter}{self._count}"

    @contextlib.contextmanager
    def within(self, loop: bool) -> Iterator[Block]:
        """A context in which lines go to a new block, of a loop or of a condition."""
        outer, around = self.block, self._around
        if loop:
            self._around = [*around[: outer.level], outer]
        self.block = Block(outer.level + loop, outer)
        yield self.block
        self.block, self._around = outer, around

    # Equations

    def program(self, closed: Any, given: Sequence[Value]) -> list[Value]:
        """The outputs of a closed program."""
        jaxpr = closed.jaxpr
        of_variable = dict(zip(jaxpr.constvars, map(self.constant, closed.consts), strict=True))
        of_variable |= zip(jaxpr.invars, given, strict=True)

        def read(atom):
            return (
                self.constant(np.asarray(atom.val, like_of(atom.aval).dtype))
                if isinstance(atom, Literal)
                else of_variable[atom]
            )

        for equation in jaxpr.eqns:
            operands = [read(atom) for atom in equation.invars]
            of_variable |= zip(equation.outvars, self._equation(equation, operands), strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation, operands):
        self._source_info, name = equation.source_info, equation.primitive.name
        kinds = [variable.aval for variable in equation.outvars]
        for kind in kinds:
            if getattr(kind, "dtype", None) not in (*_TYPES, _NONE):
                raise Unsupported(f"{name} with results {kind}")
        if kinds and all(kind.dtype == _NONE for kind in kinds):
            return [self.constant(np.zeros(kind.shape, _NONE)) for kind in kinds]
        inner = called(equation)
        if inner is not None:
            return self.program(inner, operands)
        if name not in RULES:
            return self.program(self._written_out(equation), operands)
        found = RULES[name](self, equation, operands)
        found = found if isinstance(found, list) else [found]
        assert [(x.shape, x.dtype) for x in kinds] == [(x.shape, x.dtype) for x in found], equation
        return found

    def _written_out(self, equation):
        """The program that an operation of another package than JAX stands for."""
        primitive, params = equation.primitive, equation.params
        if is_of_jax(primitive):
            raise Unsupported(primitive.name)
        like = [like_of(atom.aval) for atom in equation.invars]
        try:
            key = (primitive, tuple(repr(x) for x in like), tuple(sorted(params.items())))
            found = self._programs.get(key)
        except TypeError:
            key = found = None
        if found is None:
            found = jax.make_jaxpr(lambda *x: primitive.impl(*x, **params))(*like)
            if any(inner.primitive is primitive for inner in found.jaxpr.eqns):
                raise Unsupported(primitive.name)
            if key is not None:
                self._programs[key] = found
        return found

    # Values that several rules need

    def elementwise(self, text: str, uses: Sequence[Value], dtype: Any) -> Value:
        """The value of an expression that computes entry by entry."""
        shape, real = (np.broadcast_shapes(*shapes) for shapes in zip(*((x.shape, x.real) for x in uses), strict=True))
        return self.put(text, uses, shape, dtype, real)

    def full(self, value: Value) -> Value:
        """The value with all its entries in memory."""
        if value.real == value.shape:
            return value
        if value.real and math.prod(value.real) == math.prod(value.shape):
            text = f"{value.name}.reshape({value.shape})"
        else:
            text = f"full({value.name}, {value.shape}, {self.type(value.dtype)})"
        return self.put(text, [value], value.shape, value.dtype)

    def converted(self, value: Value, dtype: Any) -> Value:
        """The value in another type, rounded as in C."""
        if value.dtype == dtype:
            return value
        old, new = np.dtype(value.dtype), np.dtype(dtype)
        if new.kind == "b":
            text = f"{value.name} != 0"
        elif old.kind == "f" and new.kind in "iu":
            text = f"to_integer({value.name}, {self.type(new)})"
        elif value.is_scalar and not (old.kind in "iu" and new.kind in "iu"):
            text = f"{self.type(new)}({value.name})"
        else:
            text = f"{value.name}.astype({self.type(new)})"
        out = self.put(text, [value], value.shape, new, value.real)
        if old.kind == "b" and value.is_scalar:
            self.truths[out.name] = value
        return out

    def reshaped(self, value: Value, shape: tuple[int, ...]) -> Value:
        """The value in another shape of as many entries."""
        shape = tuple(map(int, shape))
        if value.shape == shape:
            return value
        if value.is_scalar:
            return value._replace(shape=shape)
        value = self.full(value)
        if shape == ():
            return self.put(f"{value.name}[{', '.join('0' for _ in value.shape)}]", [value], shape, value.dtype)
        return self.put(f"{value.name}.reshape({shape})", [value], shape, value.dtype)

    def transposed(self, value: Value, axes: Sequence[int]) -> Value:
        """The value with its axes in another order."""
        axes = tuple(map(int, axes))
        shape = tuple(value.shape[k] for k in axes)
        if axes == tuple(range(len(axes))):
            return value
        if value.is_scalar:
            return value._replace(shape=shape)
        value = self.full(value)
        return self.put(f"{value.name}.transpose({axes})", [value], shape, value.dtype)
