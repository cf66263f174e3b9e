"""The choice of order and step size from the error estimates of neighbouring orders."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

# The error per step that the next step aims at, in units of the tolerance.
_TARGET = 0.5
# What the step of a neighbouring order counts, compared with that of the present order.
_LOWER, _UPPER = 1.0, 1.0


class StepEstimate(eqx.Module):
    """What a multistep solver tells its step size controller, as its `y_error`.

    **Fields:**

    - `error`: the weighted norm of the local error; the step is acceptable up to one.
    - `growth`: the factor to the longest next step that any order allows (the solver will use that order).
    - `retry`: the factor to the step that the order just used would allow.
    """

    error: Float[Array, ""]
    growth: Float[Array, ""]
    retry: Float[Array, ""]


def choose_order(
    errors: Float[Array, "3"], order: Int[Array, ""], points: Int[Array, ""], min_order: int, max_order: int
) -> tuple[Int[Array, ""], StepEstimate]:
    """Choose among the orders `k - 1, k, k + 1` the one that allows the longest next step.

    **Arguments:**

    - `errors`: weighted norms of the local errors of the orders `k - 1, k, k + 1`; the first is used if `k - 1` is at least
        `min_order`, the last if `k + 1` is at most `max_order` and is smaller than `points + 1`.
    - `order`: the order `k` of the step just made.
    - `points`: the number of mesh points the step was built on.
    - `min_order`, `max_order`: bounds of the order. `min_order` yields as long as there are too few points.

    **Returns:** `(order of the next step, StepEstimate)`.
    """
    errors = lax.stop_gradient(errors)
    dtype = errors.dtype
    errors = jnp.where(jnp.isfinite(errors), errors, jnp.asarray(jnp.inf, dtype))
    tiny = jnp.finfo(dtype).tiny
    orders = order[None] + np.arange(-1, 2, dtype=np.int32)
    factors = (_TARGET / jnp.maximum(errors, tiny)) ** (1 / (orders + 1).astype(dtype))
    bias = jnp.stack([_LOWER, 1.0, _UPPER]).astype(dtype)
    raisable = order < max_order
    allowed = jnp.stack([order > min_order, jnp.asarray(True), raisable & (order < points)])
    merits = jnp.where(allowed, factors * bias, jnp.zeros((), dtype))
    lower, same, upper = merits[0], merits[1], merits[2]
    # As long as every point since the start is in use there is no estimate for the next order; it is better, as a rule.
    opening = raisable & (order == points) & (lower <= same)
    change = jnp.where(
        opening | ((upper > same) & (upper >= lower)), 1, jnp.where((lower > same) & (lower > upper), -1, 0)
    )
    growth = jnp.where(change == 0, factors[1], jnp.where(change > 0, jnp.maximum(upper, same), lower))
    estimate = StepEstimate(error=errors[1], growth=growth, retry=factors[1])
    return order + change.astype(order.dtype), estimate
