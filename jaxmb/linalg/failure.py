"""Values and derivatives of a computation that failed."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

Tree = TypeVar("Tree")


def not_a_number_where(failed: Bool[Array, ""], values: Tree, inputs: PyTree) -> Tree:
    """The values, not a number where a computation failed, and with them their derivatives with respect to every input,
    also to those that the computation had not come to use.
    """
    factor, lost = jnp.where(failed, jnp.nan, 1.0), _lost(failed, inputs)
    spoil = lambda y: y * factor.astype(y.dtype) + lost.astype(y.dtype) if eqx.is_inexact_array(y) else y
    return jax.tree.map(spoil, values)


@eqx.filter_custom_jvp
def _lost(failed, inputs) -> Float[Array, ""]:
    """Zero, or not a number; formally a function of every input."""
    del inputs
    return jnp.where(failed, jnp.nan, 0.0)


@_lost.def_jvp
def _lost_jvp(primals, tangents):
    lost = _lost(*primals)
    along = sum((jnp.sum(dx).astype(lost.dtype) for dx in jax.tree.leaves(tangents[1])), start=jnp.zeros_like(lost))
    return lost, lost * along
