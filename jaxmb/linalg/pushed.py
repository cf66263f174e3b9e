"""Tangents of values as arrays, zeros for values that do not depend on the moving numbers."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def push(function: Any, at: tuple[Any, ...], along: tuple[Any, ...]) -> Any:
    """The tangent of a function's value, with zeros for None."""
    value, tangent = eqx.filter_jvp(function, at, along)
    return jax.tree.map(dense, tangent, value, is_leaf=lambda x: x is None)


def dense(tangent: Float[Array, "*n"] | None, like: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """A tangent, zeros for None."""
    return jax.tree.map(jnp.zeros_like, like) if tangent is None else tangent
