"""Values and derivatives of a computation that failed."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

Tree = TypeVar("Tree")


def nan_where(failed: Bool[Array, ""], values: Tree, inputs: PyTree = None) -> Tree:
    """The values, or NaN if a computation failed. Then their derivatives by all `inputs` are NaN as well, even by
    inputs that the computation did not reach.
    """
    factor, total = jnp.where(failed, jnp.nan, 1.0), _sum(inputs)
    # Zero, with a derivative of one with respect to every input; NaN if an input is infinite.
    zero = total - lax.stop_gradient(total)
    lost = jnp.where(failed | (zero == 0), zero * jnp.where(failed, jnp.nan, 0.0), 0.0)
    spoil = lambda y: y * factor.astype(y.dtype) + lost.astype(y.dtype) if eqx.is_inexact_array(y) else y
    return jax.tree.map(spoil, values)


def _sum(inputs: PyTree) -> Float[Array, ""]:
    numbers = jax.tree.leaves(eqx.filter(inputs, eqx.is_inexact_array))
    return sum((jnp.sum(x).astype(float) for x in numbers), start=jnp.zeros(()))
