"""Steps over which a direction would turn to its opposite, through zero.

Beyond such a state the equations are others, without anything in a vector field that shows it: the lowest point of a
disc that falls flat jumps to the other side of its rim.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .gaps import AbstractWithoutJumps
from .order import StepEstimate, refuse

# Directions that turn by more than 148° in a step are opposite: steps resolve turns that are less fast.
_OPPOSITE = -0.85


class HeadingController(AbstractWithoutJumps):
    """Wraps a controller so that no heading turns to its opposite in a step: such steps count as failed, so that they
    become shorter, up to the state at which the heading vanishes.

    **Arguments:** `headings(t, y)`: vectors that must not vanish, shape (k, d), at a time and state; `sign` of the
    direction of time.
    """

    controller: Any
    headings: Callable[[Any, Any], Float[Array, "k d"]]
    sign: Any

    def __init__(self, controller: Any, headings: Callable[[Any, Any], Float[Array, "k d"]]):
        self.controller, self.headings, self.sign = controller, headings, 1

    def wrap(self, direction):
        inner = self.controller.wrap(direction)
        return eqx.tree_at(lambda c: (c.controller, c.sign), self, (inner, direction))

    def init(self, terms, t0: Any, t1, y0, dt0, args, func, error_order):
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error: Any, error_order, controller_state):
        # Both ends at once, since XLA would compile the headings twice.
        ends = jax.tree.map(lambda *x: jnp.stack(x), (t0 * self.sign, y0), (t1 * self.sign, y1_candidate))
        before, after = lax.stop_gradient(jax.vmap(self.headings)(*ends))
        square = lambda v: jnp.sum(v * v, axis=1)
        opposite = jnp.sum(before * after, axis=1) < _OPPOSITE * jnp.sqrt(square(before) * square(after))
        turned = jnp.any(opposite)
        if isinstance(y_error, StepEstimate):
            y_error = refuse(y_error, turned)
        else:
            y_error = jax.tree.map(lambda x: jnp.where(turned, jnp.asarray(jnp.inf, x.dtype), x), y_error)
        return self.controller.adapt_step_size(t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state)
