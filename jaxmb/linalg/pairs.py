"""Lists of numbers that contain pairs, the components of plane vectors. A pair is named by its first number's place."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .rotations import norm


def of_pairs(pairs: tuple[int, ...]) -> np.ndarray:
    """The places of both numbers of each pair, shape (pairs, 2)."""
    return np.array(pairs, int)[:, None] + np.arange(2)


def placed_pairs(pairs: tuple[int, ...], values: Array, singles: Array, first: int = 0) -> Array:
    """`singles` with the places of `pairs` replaced by values of shape (pairs, 2, …), after `first` zeros."""
    # A gather, which compiles faster than a scatter.
    m, paired = len(singles), of_pairs(pairs).reshape(-1)
    place = np.zeros(m, int)
    place[paired] = np.arange(paired.size)
    taken = values.reshape(-1, *values.shape[2:])[place]
    mask = np.isin(np.arange(m), paired).reshape(-1, *(1,) * (values.ndim - 2))
    placed = jnp.where(mask, taken, singles)
    return jnp.concatenate([jnp.zeros((first, *placed.shape[1:]), placed.dtype), placed]) if first else placed


def for_both(pairs: tuple[int, ...], values: Array, singles: Array) -> Array:
    """`placed_pairs` with one value for both numbers of each pair."""
    return placed_pairs(pairs, jnp.stack([values, values], axis=1), singles)


def for_first(pairs: tuple[int, ...], values: Array, singles: Array) -> Array:
    """`placed_pairs` with a value for the first number of each pair, and zero for the second."""
    return placed_pairs(pairs, jnp.stack([values, jnp.zeros_like(values)], axis=1), singles)


def sizes_of(pairs: tuple[int, ...], values: Float[Array, "m"]) -> Float[Array, "m"]:
    """The size of each number; both numbers of a pair have the norm of their vector."""
    return for_both(pairs, norm(values[of_pairs(pairs)]), jnp.abs(values)) if pairs else jnp.abs(values)
