"""Choose NumPy for concrete values, where nothing is compiled, and JAX for tracers and JAX arrays."""

import functools
import operator
from collections.abc import Iterable
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

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


def derivative_orders(tree: Any) -> tuple[int, ...]:
    """Of what order derivatives by each leaf of a pytree are being taken, as far as that is known: a `jax.jit` that is
    differentiated as a whole does not know it.
    """
    leaves = jax.tree.leaves(tree)
    traced = [k for k, x in enumerate(leaves) if isinstance(x, Tracer) and jnp.issubdtype(x.dtype, jnp.inexact)]
    orders = [0] * len(leaves)

    # JAX calls the rule where it takes a derivative, with values by which outer ones are taken.
    @jax.custom_jvp
    def probe(*leaves):
        return leaves[0]

    def rule(primals, tangents):
        for k, outer, tangent in zip(traced, derivative_orders(primals), tangents, strict=True):
            orders[k] = outer + (not isinstance(tangent, SymbolicZero))
        first = tangents[0]
        return primals[0], jnp.zeros_like(primals[0]) if isinstance(first, SymbolicZero) else first

    probe.defjvp(rule, symbolic_zeros=True)
    if traced:
        probe(*(leaves[k] for k in traced))
    return tuple(orders)


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


# One program: outside of `jit`, under a derivative, this would be a dozen of them.
@functools.partial(jax.jit, static_argnums=1)
def _set(array, index, value):
    return array.at[np.array(index)].set(value)


def unchecked_take(values: Float[Array, "n *k"], index: Int[np.ndarray, "..."]) -> Float[Array, "..."]:
    """`values[index]` as a gather without checks: the indices are in bounds by construction."""
    return values.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def add_up(terms: Iterable[Any]) -> Any:
    """The sum of some arrays, one at least, term by term; Python's `sum` would add a zero to them."""
    return functools.reduce(operator.add, terms)
