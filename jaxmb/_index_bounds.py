"""Indices of a traced function that lie outside of their array: JAX takes the nearest entry instead, without a word."""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from ._compat import ClosedJaxpr, Jaxpr, Literal

_IN_BOUNDS = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS

# Results of known whole numbers: what JAX computes to count a negative index from the end, and to arrange indices.
_OF_NUMBERS = {
    "lt": lambda a, b: a < b,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "select_n": lambda which, *cases: np.choose(np.asarray(which, int), cases),
    "convert_element_type": lambda x, *, new_dtype, **_: np.asarray(x).astype(new_dtype),
    "broadcast_in_dim": lambda x, *, shape, broadcast_dimensions, **_: _broadcast(x, shape, broadcast_dimensions),
    "reshape": lambda x, *, new_sizes, **_: np.reshape(x, new_sizes),
    "squeeze": lambda x, *, dimensions: np.squeeze(x, dimensions),
    "concatenate": lambda *xs, dimension: np.concatenate(xs, dimension),
}


class IndexOutOfBoundsError(ValueError):
    """A function indexes outside of an array."""


def check_indices(program: Any, what: str) -> None:
    """Raise an `IndexOutOfBoundsError` if an index that is a number, not computed from the arguments, lies outside of
    its array.

    **Arguments:** `program`: a closed jaxpr; `what` it computes, for the message.
    """
    wrong = _first_wrong(program.jaxpr, list(program.consts), [None] * len(program.jaxpr.invars))[0]
    if wrong is not None:
        raise IndexOutOfBoundsError(
            f"{what} indexes out of bounds: index {wrong[0]} is out of bounds for axis {wrong[1]} with size {wrong[2]}."
        )


def _first_wrong(program: Any, constants: list[Any], given: list[Any]) -> tuple[Any, list[Any]]:
    """The first wrong index, with its axis and the size of the axis, or None; and the results that are known."""
    known: dict[Any, Any] = {}
    for v, value in zip((*program.constvars, *program.invars), (*constants, *given), strict=True):
        if value is not None and _is_whole(v) and not isinstance(value, Tracer):
            known[v] = np.asarray(value)
    value_of = lambda v: np.asarray(v.val) if isinstance(v, Literal) else known.get(v)
    for equation in program.eqns:
        values = [value_of(v) for v in equation.invars]
        wrong, out = _of_equation(equation, values)
        if wrong is not None:
            return wrong, []
        known.update({v: x for v, x in zip(equation.outvars, out, strict=False) if x is not None})
    return None, list(map(value_of, program.outvars))


def _of_equation(equation, values):
    name, shape = equation.primitive.name, getattr(equation.invars[0].aval, "shape", ()) if equation.invars else ()
    if name == "dynamic_slice":
        sizes = equation.params["slice_sizes"]
        starts = zip(values[1:], shape, sizes, strict=False)
        return _outside((axis, start, size, part) for axis, (start, size, part) in enumerate(starts)), []
    if name == "gather" and equation.params["mode"] == _IN_BOUNDS and values[1] is not None:
        axes, sizes = equation.params["dimension_numbers"].start_index_map, equation.params["slice_sizes"]
        columns = np.moveaxis(values[1], -1, 0)
        return _outside((k, column, shape[k], sizes[k]) for k, column in zip(axes, columns, strict=True)), []
    nested = [x if isinstance(x, tuple | list) else (x,) for x in equation.params.values()]
    programs = [x for several in nested for x in several if isinstance(x, ClosedJaxpr | Jaxpr)]
    for program in programs:
        constants = list(getattr(program, "consts", ()))
        inner = getattr(program, "jaxpr", program)
        # Operands of a call are the arguments of its program; of a loop they may be arranged otherwise.
        same = len(programs) == 1 and len(inner.invars) == len(values) and name in ("jit", "pjit", "closed_call")
        wrong, out = _first_wrong(inner, constants, values if same else [None] * len(inner.invars))
        if wrong is not None or same:
            return wrong, out
    if name not in _OF_NUMBERS or any(x is None for x in values) or not _is_whole(equation.outvars[0]):
        return None, []
    return None, [_OF_NUMBERS[name](*values, **_parameters(name, equation))]


def _is_whole(variable):
    dtype = getattr(variable.aval, "dtype", None)
    return isinstance(dtype, np.dtype) and dtype.kind in "iub"


def _parameters(name, equation):
    return {} if name in ("lt", "add", "sub", "mul", "select_n") else equation.params


def _outside(starts):
    """The first index outside of its axis, its axis and the size."""
    for axis, start, size, part in starts:
        if start is not None:
            outside = (start < 0) | (start > size - part)
            if np.any(outside):
                index = int(np.ravel(start)[np.argmax(np.ravel(outside))])
                return (index if index >= 0 else index - size), axis, size
    return None


def _broadcast(x, shape, dimensions):
    spread = np.ones(len(shape), int)
    spread[list(dimensions)] = np.shape(x)
    return np.broadcast_to(np.reshape(x, spread), shape)
