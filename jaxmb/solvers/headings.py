"""Steps over which a direction would turn to its opposite, through zero.

Beyond such a state the equations are others, without anything in a vector field that shows it: the lowest point of a
disc that falls flat jumps to the other side of its rim.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

# Directions that turn by more than 148° in a step are opposite: steps resolve turns that are less fast.
_OPPOSITE = -0.85


def turns_over(
    headings: Callable[[Any, Any], Float[Array, "k d"]], times: tuple[Any, Any], ends: tuple[Any, Any]
) -> Bool[Array, ""]:
    """Whether a heading turns to its opposite in a step. Such steps count as failed, so that they become shorter, up to
    the state at which the heading vanishes.

    **Arguments:** `headings(t, y)`: vectors that must not vanish, shape (k, d); times and states at the `ends`.
    """
    # Both ends at once, since XLA would compile the headings twice.
    before, after = lax.stop_gradient(
        jax.vmap(headings)(jnp.stack(times), jax.tree.map(lambda *x: jnp.stack(x), *ends))
    )
    square = lambda v: jnp.sum(v * v, axis=1)
    return jnp.any(jnp.sum(before * after, axis=1) < _OPPOSITE * jnp.sqrt(square(before) * square(after)))
