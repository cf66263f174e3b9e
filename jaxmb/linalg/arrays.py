"""Choose NumPy for concrete values, where nothing is compiled, and JAX for tracers and JAX arrays."""

import functools
import operator
from collections.abc import Iterable
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

# Types of arrays.
ARRAYS = (jax.Array, np.ndarray, np.generic)
# Types of values that hold no tracers.
_CONCRETE = (float, int, np.ndarray, np.generic)


def namespace(*arrays: Any) -> ModuleType:
    """`numpy` if all arrays are NumPy's, else `jax.numpy`."""
    return np if all(isinstance(array, np.ndarray | np.generic) for array in arrays) else jnp


def is_traced(tree: Any) -> bool:
    """Whether any leaf of a pytree is traced."""
    if isinstance(tree, _CONCRETE):
        return False
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


class Derivatives(NamedTuple):
    """The derivatives that are being taken by each leaf of a pytree.

    **Fields:** `orders` of the derivatives, which are unknown under a `jax.jit` that is differentiated as a whole;
    `known`: whether the values of all leaves are known, as for derivatives outside of `jax.jit` and `jax.vmap`;
    `levels`: how many derivatives are nested, two also for a mixed one, of one order by each of two leaves.
    """

    orders: tuple[int, ...]
    known: bool
    levels: int


def derivatives_of(tree: Any) -> Derivatives:
    """The derivatives that are being taken by each leaf of a pytree."""
    leaves = jax.tree.leaves(tree)
    tracers = [k for k, x in enumerate(leaves) if isinstance(x, Tracer)]
    traced = [k for k in tracers if jnp.issubdtype(leaves[k].dtype, jnp.inexact)]
    orders, is_concrete, levels = [0] * len(leaves), not tracers, 0

    # JAX calls the rule when it takes a derivative, with the values of outer derivatives.
    @jax.custom_jvp
    def probe(*leaves):
        return leaves[0]

    def rule(primals, tangents):
        nonlocal is_concrete, levels
        outer, is_concrete, levels = derivatives_of(primals)
        levels += 1
        is_concrete = is_concrete and traced == tracers
        for k, order, tangent in zip(traced, outer, tangents, strict=True):
            orders[k] = order + (not isinstance(tangent, SymbolicZero))
        first = tangents[0]
        return primals[0], jnp.zeros_like(primals[0]) if isinstance(first, SymbolicZero) else first

    probe.defjvp(rule, symbolic_zeros=True)
    if traced:
        probe(*(leaves[k] for k in traced))
    return Derivatives(tuple(orders), is_concrete, levels)


def as_array(value: Any, dtype: Any) -> Any:
    """A new NumPy array, or a JAX array if any entry is traced.

    The values are copied, since `jax.device_put` may alias NumPy memory that the caller changes later.
    """
    return jnp.asarray(value, dtype) if is_traced(value) else np.array(value, dtype)


def replaced(array: Array, index: Any, value: Any) -> Array:
    """A copy of the array with new entries at an index."""
    if is_traced((array, value)):
        return _set(array, tuple(index.tolist()) if isinstance(index, np.ndarray) else index, value)
    new = np.array(array)
    new[index] = value
    return jax.device_put(new)


# One program: outside of `jit`, under a derivative, this would be a dozen programs.
@functools.partial(jax.jit, static_argnums=1)
def _set(array, index, value):
    return array.at[np.array(index)].set(value)


def add_up(terms: Iterable[Any]) -> Any:
    """The sum of at least one array, term by term; Python's `sum` would add a zero."""
    return functools.reduce(operator.add, terms)
