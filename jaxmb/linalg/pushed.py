"""Tangents of values as arrays, zeros for values that do not depend on the moving numbers."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree


def push(function: Any, at: tuple[Any, ...], along: tuple[Any, ...]) -> Any:
    """The tangent of a function's value, with zeros for None."""
    return filled(*eqx.filter_jvp(function, at, along))


def filled(x: PyTree, tangent: PyTree) -> Any:
    """A tangent of x, with zeros where it has None and x has an array."""
    fill = lambda x, t: jnp.zeros(x.shape, x.dtype) if t is None and x is not None else t
    return jax.tree.map(fill, x, tangent, is_leaf=lambda x: x is None)
