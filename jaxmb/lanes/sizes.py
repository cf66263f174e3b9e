"""The numbers that the loops of a program carry and write."""

import math
from collections.abc import Iterator
from typing import Any

import jax

from .._compat import ClosedJaxpr, Jaxpr, sizes_of_scan

# Arrays of several axes with at least this number of rows count as tables, of which a step writes one row.
_LONG = 1024


def loops(program: Any) -> Iterator[tuple[int, int]]:
    """For each loop of a program, the bytes carried from step to step and the bytes that the loop's equations write."""
    for equation in getattr(program, "jaxpr", program).eqns:
        inner = inner_programs(equation)
        if equation.primitive.name in ("while", "scan"):
            # A scan does not carry the results of single steps.
            yield _bytes(equation.outvars[: _loop_values(equation)]), sum(map(_written, inner))
        for inner_program in inner:
            yield from loops(inner_program)


def _loop_values(equation: Any) -> int:
    """The number of outputs that a loop carries from step to step."""
    scans = equation.primitive.name == "scan"
    return sizes_of_scan(equation.params)[1] if scans else len(equation.outvars)


def _written(program: Any) -> int:
    """The bytes that the equations of a program write, in one pass of each loop."""
    pairs = ((equation, inner_programs(equation)) for equation in getattr(program, "jaxpr", program).eqns)
    return sum(sum(map(_written, inner)) if inner else _bytes(equation.outvars) for equation, inner in pairs)


def inner_programs(equation: Any) -> list[Any]:
    """The programs within an equation."""
    return [x for x in jax.tree.leaves(list(equation.params.values()), is_leaf=_is_program) if _is_program(x)]


def _bytes(variables: list[Any]) -> int:
    return sum(_touched(x.aval.shape) * x.aval.dtype.itemsize for x in variables)


def _touched(shape: tuple[int, ...]) -> int:
    """The numbers of an array that a step touches: one row of a long table, such as the states of all steps."""
    return math.prod(shape[1:] if len(shape) > 1 and shape[0] >= _LONG else shape)


def _is_program(x: Any) -> bool:
    return isinstance(x, ClosedJaxpr | Jaxpr)
