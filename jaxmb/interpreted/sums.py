"""Rules of sums, products and other operations along axes, and of matrices."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from .translate import Translator, Value, rule

_REDUCED = {
    "reduce_sum": "add",
    "reduce_prod": "multiply",
    "reduce_max": "maximum",
    "reduce_min": "minimum",
    "reduce_and": "bitwise_and",
    "reduce_or": "bitwise_or",
    "reduce_xor": "bitwise_xor",
}
# So many numbers are added one by one.
_FEW = 3


@rule(*_REDUCED)
def _reduce(t, e, values):
    (x,), out, name = values, e.outvars[0].aval, e.primitive.name
    axes = tuple(int(axis) for axis in e.params["axes"])
    if math.prod(x.shape[k] for k in axes) == 1:
        return t.reshaped(x, out.shape)
    repeats = name in ("reduce_max", "reduce_min", "reduce_and", "reduce_or")
    if x.is_scalar and repeats and math.prod(x.shape[k] for k in axes):
        return x._replace(shape=out.shape)
    x = t.full(x)
    if name == "reduce_sum" and len(x.shape) == 1 and 0 < x.shape[0] <= _FEW:
        text = " + ".join(f"{x.name}[{k}]" for k in range(x.shape[0]))
        return t.put(text, [x], (), x.dtype)
    along = axes[0] if len(axes) == 1 else axes
    initial = ""
    if name in ("reduce_max", "reduce_min"):
        initial = f", None, False, {t.constant(_least(x.dtype, name == 'reduce_max')).name}"
    text = f"np.{_REDUCED[name]}.reduce({x.name}, {along}, {t.type(x.dtype)}{initial})"
    return t.put(text, [x], out.shape, x.dtype)


def _least(dtype: Any, of_largest: bool) -> Any:
    """The extreme of no numbers."""
    kind = np.dtype(dtype).kind
    if kind == "f":
        return np.asarray(-np.inf if of_largest else np.inf, dtype)
    if kind == "b":
        return np.asarray(not of_largest)
    return np.asarray(np.iinfo(dtype).min if of_largest else np.iinfo(dtype).max, dtype)


@rule("argmax", "argmin")
def _arg(t, e, values):
    x, out, axis = t.full(values[0]), e.outvars[0].aval, int(e.params["axes"][0])
    found = t.put(f"{x.name}.{e.primitive.name}({axis})", [x], out.shape, np.dtype(np.intp))
    return t.converted(found, out.dtype)


_ACCUMULATED = {"cumsum": "add", "cumprod": "multiply", "cummax": "maximum", "cummin": "minimum"}


@rule(*_ACCUMULATED)
def _accumulate(t, e, values):
    x, p = t.full(values[0]), e.params
    function = f"np.{_ACCUMULATED[e.primitive.name]}"
    text = f"accumulated({x.name}, {function}, {int(p['axis'])}, {bool(p['reverse'])})"
    return t.put(text, [x], x.shape, x.dtype)


@rule("sort")
def _sort(t, e, values):
    values, p = [t.full(x) for x in values], e.params
    names = ", ".join(x.name for x in values)
    every = t.put(f"ordered(({names},), {int(p['dimension'])}, {int(p['num_keys'])})", values, None, None)
    return [t.put(f"{every.name}[{k}]", [every], x.shape, x.dtype) for k, x in enumerate(values)]


@rule("dot_general")
def _dot(t, e, values):
    out = e.outvars[0].aval
    a, b = (t.full(t.converted(x, out.dtype)) for x in values)
    (of_a, of_b), (stack_a, stack_b) = e.params["dimension_numbers"]
    if not stack_a and len(of_a) == 1 and len(a.shape) <= 2 and len(b.shape) <= 2:
        first = f"{a.name}.T" if len(a.shape) == 2 and of_a[0] == 0 else a.name
        other = f"{b.name}.T" if len(b.shape) == 2 and of_b[0] == 1 else b.name
        return t.put(f"{first}.dot({other})", [a, b], out.shape, out.dtype)
    rest_a, rest_b = _others(a, of_a, stack_a), _others(b, of_b, stack_b)
    first = _matrices(t, a, stack_a, rest_a, of_a)
    other = _matrices(t, b, stack_b, of_b, rest_b)
    shape = *first.shape[:-1], other.shape[-1]
    return t.reshaped(t.put(f"{first.name} @ {other.name}", [first, other], shape, out.dtype), out.shape)


def _others(x: Value, *taken: Sequence[int]) -> list[int]:
    return [k for k in range(len(x.shape)) if not any(k in axes for axes in taken)]


def _matrices(t: Translator, x: Value, stack: Sequence[int], rows: Sequence[int], columns: Sequence[int]) -> Value:
    """A stack of matrices with these axes."""
    size = lambda axes: math.prod(x.shape[k] for k in axes)
    shape = *(x.shape[k] for k in stack), size(rows), size(columns)
    return t.full(t.reshaped(t.transposed(x, (*stack, *rows, *columns)), shape))


@rule("lu")
def _lu(t, e, values):
    x = t.full(values[0])
    every = t.put(f"factored({x.name})", [x], None, None)
    kinds = [variable.aval for variable in e.outvars]
    return [t.put(f"{every.name}[{k}]", [every], kind.shape, kind.dtype) for k, kind in enumerate(kinds)]


@rule("triangular_solve")
def _triangular_solve(t, e, values):
    (a, b), p = (t.full(x) for x in values), e.params
    flags = ", ".join(str(bool(p[name])) for name in ("left_side", "lower", "transpose_a", "unit_diagonal"))
    return t.put(f"solved({a.name}, {b.name}, {flags})", [a, b], b.shape, b.dtype)


@rule("cholesky")
def _cholesky(t, e, values):
    x = t.full(values[0])
    return t.put(f"rooted({x.name})", [x], x.shape, x.dtype)
