"""NumPy for what is known, which compiles nothing; JAX for what is traced, or an array of JAX's."""

from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def namespace(*arrays: Any) -> ModuleType:
    """The module whose functions serve these arrays."""
    return np if all(isinstance(array, np.ndarray | np.generic) for array in arrays) else jnp


def is_traced(tree: Any) -> bool:
    """Whether there is anything traced in a pytree."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def as_array(value: Any, dtype: Any) -> Any:
    """An array of NumPy's, or one of JAX's if anything in it is traced."""
    return (jnp if is_traced(value) else np).asarray(value, dtype)
