"""Functions of the user as JAX traced them, which do not change with the values that they read.

A function may read a global variable, an attribute or a dictionary. JAX keeps programs by the function alone, and would
return the old motion after a change. So a system holds traced programs in place of functions: they stay as they were
when it was compiled, and are equal if they compute the same.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ._compat import ClosedJaxpr, canonical, is_weakly_typed, jaxpr_as_function
from ._index_bounds import check_indices
from ._jaxpr_digest import digest_of
from ._traced_functions import shown_function
from .linalg.arrays import ARRAYS
from .solvers.closures import opened

_SHAPED = (*ARRAYS, jax.ShapeDtypeStruct)


class Captured:
    """A function with its traced programs, one for each set of argument shapes in calls before `keep`.

    It computes with these programs, even if the values that the function reads have changed; with arguments of other
    shapes it calls the function. Two are equal if all their programs compute the same. A function that was not called,
    or that closes over traced values, has no programs and is compared as a function.
    """

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self._programs: dict[Any, _Program | None] = {}
        self._examples: list[Any] = []
        # Its identity for comparison: until it is kept, the object itself.
        self._key: tuple[Any, ...] = ("open", id(self))
        # The hashes of its programs, the same in every process.
        self.digests: tuple[bytes, ...] = ()

    def __call__(self, *args: Any, **named: Any) -> Any:
        if self._key[0] == "open":
            self.trace(*args, **named)
        leaves, structure = jax.tree.flatten((args, named))
        # A Python number may stand for an array, such as a time.
        for values in (leaves, [_as_array(x) for x in leaves]):
            program = self._programs.get((structure, tuple(map(_kind, values))))
            if program is not None:
                return program.computed([x for x in values if isinstance(x, _SHAPED)])
        return self.function(*args, **named)

    def trace(self, *args: Any, **named: Any) -> None:
        """Trace the program for arguments of these shapes; arrays or `jax.ShapeDtypeStruct` stand for arrays."""
        leaves, structure = jax.tree.flatten((args, named))
        kinds = structure, tuple(map(_kind, leaves))
        if kinds not in self._programs:
            self._programs[kinds] = _traced(self.function, leaves, structure)
            self._examples.append(jax.tree.unflatten(structure, map(_like, leaves)))

    def keep(self) -> None:
        """From now on, compute with the present programs."""
        keys = tuple((kinds, program.key) for kinds, program in self._programs.items() if program is not None)
        has_programs = 0 < len(keys) == len(self._programs)
        self._key = ("known", keys) if has_programs else ("alone", self.function)
        self.digests = tuple(key[0] for _, key in keys)

    def __eq__(self, other: object) -> bool:
        return self is other or (type(other) is type(self) and self._key == other._key)

    def __hash__(self) -> int:
        return hash(self.digests if self._key[0] == "known" else self._key)

    def __repr__(self) -> str:
        return repr(self.function)

    def __deepcopy__(self, memo: Any) -> "Captured":
        return self

    def __reduce__(self) -> Any:
        # Traced programs cannot be sent to another process.
        return _again, (self.function, self._examples, self.digests)


class CapturedModule(eqx.Module):
    """A captured function, differentiable by the arrays of an equinox module and by closed-over traced values.

    **Fields:** `module`: the module with these arrays and values, None for a function without them; `known`: the
    function, which takes the module first if there is one.
    """

    module: Any
    known: Captured = eqx.field(static=True)

    def __init__(self, function: Callable[..., Any]):
        module = opened(function)
        is_module = isinstance(module, eqx.Module)
        self.module = module if is_module else None
        self.known = Captured(_called if is_module else function)

    def __call__(self, *args: Any, **named: Any) -> Any:
        return self.known(*self._held, *args, **named)

    def trace(self, *args: Any, **named: Any) -> None:
        """As of `Captured`."""
        self.known.trace(*self._held, *args, **named)

    @property
    def _held(self) -> tuple[Any, ...]:
        return () if self.module is None else (self.module,)


def _called(module: Callable[..., Any], *args: Any, **named: Any) -> Any:
    return module(*args, **named)


def _again(function: Callable[..., Any], examples: list[Any], digests: tuple[bytes, ...]) -> Captured:
    """A captured function in another process."""
    out = Captured(function)
    for args, named in examples:
        out.trace(*args, **named)
    out.keep()
    if out.digests != digests:
        raise ValueError(
            f"{function!r} computes something else than when the system that uses it was compiled: a value that it "
            "reads has changed since. Compile the system anew."
        )
    return out


class _Program(NamedTuple):
    """A traced function.

    **Fields:** `function` of the list of all arrays among its arguments, which returns the arrays among its results;
    the `structure` of results and their `rest`, None for each array; `key`: equal if programs compute the same; `held`:
    objects whose addresses are in the key.
    """

    function: Callable[..., list[Any]]
    structure: Any
    rest: tuple[Any, ...]
    key: tuple[Any, ...]
    held: tuple[Any, ...]

    def computed(self, arrays: list[Any]) -> Any:
        return _filled(self.rest, self.structure, self.function(*arrays))


def _traced(function: Callable[..., Any], leaves: list[Any], structure: Any) -> _Program | None:
    """The program of a function for arguments like these; None if it closes over traced values."""
    results: list[Any] = []

    # JAX keeps traces by the function: this one is new each time.
    def of_arrays(*arrays: Any) -> list[Any]:
        args, named = _filled(leaves, structure, arrays)
        out, tree = jax.tree.flatten(function(*args, **named))
        results[:] = tree, tuple(None if isinstance(x, ARRAYS) else x for x in out)
        return [x for x in out if isinstance(x, ARRAYS)]

    closed = jax.make_jaxpr(of_arrays)(*(_like(x) for x in leaves if isinstance(x, _SHAPED)))
    if any(isinstance(constant, Tracer) for constant in closed.consts):
        return None
    check_indices(closed, shown_function(function))
    tree, rest = results
    digest = digest_of(closed, rules=True)
    constants = [_own(v, constant) for v, constant in zip(closed.jaxpr.constvars, closed.consts, strict=True)]
    key = digest.value, tuple(map(id, digest.unknown)), tree, rest
    return _Program(jaxpr_as_function(ClosedJaxpr(closed.jaxpr, constants)), tree, rest, key, digest.unknown)


def _own(variable: Any, constant: Any) -> Any:
    """A copy of a constant, which may share the memory of a NumPy array that the user changes."""
    if is_weakly_typed(variable) or jnp.issubdtype(variable.aval.dtype, jax.dtypes.extended):
        return constant
    return np.array(constant)


def _as_array(leaf: Any) -> Any:
    return np.asarray(leaf, canonical()) if type(leaf) in (int, float) else leaf


def _kind(leaf: Any) -> Any:
    return (leaf.shape, _dtype(leaf)) if isinstance(leaf, _SHAPED) else (type(leaf), leaf)


def _like(leaf: Any) -> Any:
    return jax.ShapeDtypeStruct(leaf.shape, _dtype(leaf)) if isinstance(leaf, _SHAPED) else leaf


def _dtype(array: Any) -> Any:
    return canonical(array.dtype) if isinstance(array, np.ndarray | np.generic) else array.dtype


def _filled(leaves: Iterable[Any], structure: Any, arrays: Iterable[Any]) -> Any:
    """A pytree of these leaves, with other arrays, one after the other, in place of arrays and of None."""
    remaining = iter(arrays)
    filled = [next(remaining) if x is None or isinstance(x, _SHAPED) else x for x in leaves]
    return jax.tree.unflatten(structure, filled)
