"""Compiled functions of any pytree, called from Python at little cost."""

import contextlib
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import numpy as np

from .._compat import current_trace
from ..interpreted.later import Later
from .arrays import ARRAYS, is_traced

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


_NO_TRACE = current_trace()
# Programs that are called a few times then compile in half the time.
FOR_FEW_CALLS = {"xla_backend_optimization_level": 0}


class Split(NamedTuple):
    """A pytree as its `arrays` and the rest, which is `static`: the structure, and the leaves that are not arrays."""

    arrays: list[Any]
    static: tuple[Any, tuple[Any, ...]]

    @classmethod
    def of(cls, tree: Any) -> "Split":
        leaves, structure = jax.tree.flatten(tree)
        # A pytree has no leaves that are None.
        rest = tuple(None if isinstance(x, ARRAYS) else x for x in leaves)
        return cls([x for x, static in zip(leaves, rest, strict=True) if static is None], (structure, rest))

    def whole(self) -> Any:
        """The pytree."""
        (structure, rest), remaining = self.static, iter(self.arrays)
        return jax.tree.unflatten(structure, [next(remaining) if x is None else x for x in rest])

    def kinds(self) -> tuple[Any, ...]:
        """The shapes and types of the arrays."""
        return tuple((np.shape(x), x.dtype) for x in self.arrays)


def jitted(
    function: Callable[_Arguments, _Result], options: dict[str, Any] | None = None
) -> Callable[_Arguments, _Result]:
    """`jax.jit` of a function of pytrees. Leaves that are not arrays are static; results contain only arrays.

    `equinox.filter_jit` does the same for any function, and takes twice as long to call a program of many numbers.

    **Arguments:** `options` of the compiler.
    """

    any_function: Callable[..., _Result] = function

    def of_arrays(arrays, static):
        arguments, named = Split(arrays, static).whole()
        return any_function(*arguments, **named)

    # The name in profiles and logs of compilations.
    of_arrays.__name__ = function.__name__.lstrip("_")
    program = Later(jax.jit(of_arrays, static_argnums=1, compiler_options=options))

    @functools.wraps(function)
    def called(*arguments: _Arguments.args, **named: _Arguments.kwargs) -> Any:
        return program(*Split.of((arguments, named)))

    return called


def shapes_of(function: Callable[[Any], Any]) -> Callable[[Split], Any]:
    """A function of a split pytree: the result of `function` with zeros for its numbers, all of which are arrays."""

    @functools.lru_cache(64)
    def zeros(kinds, static):
        arrays = [jax.ShapeDtypeStruct(*kind) for kind in kinds]
        shapes = jax.eval_shape(lambda arrays: function(Split(arrays, static).whole()), arrays)
        return jax.tree.map(lambda x: jax.device_put(np.zeros(x.shape, x.dtype)), shapes)

    return lambda split: zeros(split.kinds(), split.static)


def on_host(function: Callable[_Arguments, Any]) -> Callable[_Arguments, Any]:
    """`jitted` for concrete numbers and a few calls, with a result in NumPy, even while JAX traces something else."""
    program = jitted(function, FOR_FEW_CALLS)

    @functools.wraps(function)
    def called(*arguments: _Arguments.args, **named: _Arguments.kwargs) -> Any:
        with computed_at_once():
            return jax.tree.map(np.asarray, program(*arguments, **named))

    return called


def computed_at_once() -> contextlib.AbstractContextManager[None]:
    """A context in which concrete numbers stay so, even while JAX traces something else."""
    # Under `jit` JAX would trace these numbers as well. The context costs a program for each constant.
    traces = current_trace() != _NO_TRACE and is_traced(jax.device_put(0.0))
    return jax.ensure_compile_time_eval() if traces else contextlib.nullcontext()
