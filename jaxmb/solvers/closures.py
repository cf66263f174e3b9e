"""Functions of the user that close over traced values.

JAX differentiates by such a value only if it is an argument. A custom derivative rule would treat it as a constant, and
the derivative by it would silently be zero. `opened` makes it an argument.
"""

import functools
import types
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.core import Tracer


def opened(function: Callable[..., Any]) -> Callable[..., Any]:
    """A Python function that closes over traced values, as a module with them as leaves; anything else unchanged.

    Traced values in functions that it closes over, in defaults and in `functools.partial` count as well.
    """
    return _opened(function, set())


def _opened(x: Any, inside: set[int]) -> Any:
    if isinstance(x, functools.partial):
        contents = _open_all((x.func, x.args, x.keywords), inside)
        return eqx.Partial(_calling, *contents) if _has_traced(contents) else x
    # A function that refers to itself is visited again inside.
    if not isinstance(x, types.FunctionType) or id(x) in inside:
        return x
    inside = inside | {id(x)}
    cells = tuple(_contents(cell) for cell in x.__closure__ or ())
    contents = _open_all((cells, x.__defaults__, x.__kwdefaults__), inside)
    if not _has_traced(contents):
        return x
    traced, rest = eqx.partition(contents, lambda leaf: isinstance(leaf, Tracer))
    return _Opened(traced, _Code(x, rest))


def _open_all(tree: Any, inside: set[int]) -> Any:
    return jax.tree.map(lambda x: _opened(x, inside), tree)


def _has_traced(tree: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def _contents(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:
        # A variable that has no value yet.
        return None


def _calling(func: Any, args: Any, keywords: Any, *positional: Any, **named: Any) -> Any:
    return func(*args, *positional, **(keywords | named))


class _Code:
    """The code of a function, and the contents of its closure without the traced values.

    Two are equal if they compute the same from equal traced values, so a function written anew for each call is
    compiled once.
    """

    def __init__(self, function: types.FunctionType, rest: Any):
        self.code, self.globals, self.name = function.__code__, function.__globals__, function.__name__
        self.rest = rest
        leaves, structure = jax.tree.flatten(rest)
        plain = (bool, int, float, complex, str, bytes)
        # Other objects are distinguished by identity, and this object keeps them alive.
        of_leaves = tuple((type(x), x) if type(x) in plain else id(x) for x in leaves)
        self._key = self.code, id(self.globals), structure, of_leaves

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class _Opened(eqx.Module):
    traced: Any
    known: _Code = eqx.field(static=True)

    def __call__(self, *args: Any, **keywords: Any) -> Any:
        code = self.known
        cells, defaults, of_keywords = eqx.combine(self.traced, code.rest)
        closure = tuple(types.CellType(x) for x in cells)
        function = types.FunctionType(code.code, code.globals, code.name, defaults, closure)
        function.__kwdefaults__ = of_keywords
        return function(*args, **keywords)
