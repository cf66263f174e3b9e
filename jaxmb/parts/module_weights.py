"""Modules, such as neural networks, whose weights are one parameter of a part."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._compat import canonical
from ..linalg.arrays import ARRAYS, is_traced


class ModuleWeights(eqx.Module):
    """A module split into the vector of its weights and a static rest. A call calls the module.

    The weights are all arrays of floating-point numbers, raveled one after the other in the order of `jax.tree.leaves`.

    **Fields:** `values`: the weights; `like`: the module with shapes in place of its weights.
    """

    values: Float[Array, "n"]
    like: eqx.Module = eqx.field(static=True)

    def __call__(self, *args: Any, **keywords: Any) -> Any:
        module: Any = self.module
        return module(*args, **keywords)

    @property
    def module(self) -> eqx.Module:
        """The module itself."""
        return with_weights(self.like, self.values)


@functools.singledispatch
def as_weights(module: Any) -> ModuleWeights:
    """A module as its weights and the rest; `ModuleWeights` are returned unchanged.

    **Raises:** `ValueError` for a module without weights, and for arrays of other than floating-point numbers, which
    can be neither weights nor static.
    """
    if not isinstance(module, eqx.Module):
        raise ValueError(f"expected an equinox module, such as an eqx.nn.MLP, got {module!r}")
    dtype, weights = canonical(), []

    def shape_of(path, leaf):
        if not isinstance(leaf, ARRAYS):
            return leaf
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(
                f"{_place(path)} is an array of {leaf.dtype} numbers; weights are floating-point arrays, and fixed "
                "values must not be arrays"
            )
        weights.append(leaf)
        return jax.ShapeDtypeStruct(leaf.shape, dtype)

    like = jax.tree_util.tree_map_with_path(shape_of, module)
    if not weights:
        raise ValueError(f"{type(module).__name__} has no weights: none of its fields is an array of real numbers")
    # NumPy compiles nothing.
    xp = jnp if is_traced(weights) else np
    values = xp.concatenate([xp.asarray(leaf, dtype).reshape(-1) for leaf in weights])
    return ModuleWeights(values if isinstance(values, Array) else jax.device_put(values), like)


@as_weights.register
def _(module: ModuleWeights) -> ModuleWeights:
    return module


def with_weights(like: eqx.Module, values: Float[Array, "n"]) -> eqx.Module:
    """The module with these weights.

    **Arguments:** `like`: as in `ModuleWeights`.
    """
    leaves, structure = jax.tree.flatten(like)
    sizes = [leaf.size if _is_shape(leaf) else 0 for leaf in leaves]
    pieces = jnp.split(values, np.cumsum(sizes)[:-1])
    filled = [part.reshape(leaf.shape) if _is_shape(leaf) else leaf for leaf, part in zip(leaves, pieces, strict=True)]
    return jax.tree.unflatten(structure, filled)


def weights_of(module: eqx.Module, like: eqx.Module) -> Float[Array, "n"]:
    """The weights of a module that may differ from `like` in its weights only.

    **Raises:** `ValueError` that names the difference.
    """
    weights = as_weights(module)
    if weights.like == like:
        return weights.values
    kinds = type(like).__name__, type(module).__name__
    if kinds[0] != kinds[1]:
        raise ValueError(f"expected a module {kinds[0]}, got {kinds[1]}")
    flat = lambda module: jax.tree_util.tree_flatten_with_path(module)[0]
    wanted, given = ({_place(path): leaf for path, leaf in flat(x)} for x in (like, weights.like))
    for place in wanted | given:
        old, new = (leaves.get(place) for leaves in (wanted, given))
        if old != new:
            raise ValueError(f"{place} of the module must stay {_shown(old)}, got {_shown(new)}")
    raise ValueError(f"a static field of the {kinds[0]} differs")


def _is_shape(leaf: Any) -> bool:
    return isinstance(leaf, jax.ShapeDtypeStruct)


def _place(path: Any) -> str:
    return jax.tree_util.keystr(path).removeprefix(".")


def _shown(leaf: Any) -> str:
    return f"an array of shape {leaf.shape}" if _is_shape(leaf) else repr(leaf)
