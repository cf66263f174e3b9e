"""The choice of order and step size from the error estimates of neighbouring orders."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ._history import LENGTH

# The constants come from measuring evaluations against true error, on Kepler's problem, the Pleiades and Arenstorf's
# orbit. They matter little over wide ranges; a strong preference for low orders or for an unchanged step costs 10-20%.
#
# The error that a step aims at, in units of the tolerance.
_TARGET = 0.2
# How the step of the order below, and of the order above, counts against that of the present order.
_LOWER, _UPPER = 0.98, 0.95
# How much of the deviation from the target the next step is to make up for.
_GAIN = 0.85


def _responses() -> np.ndarray:
    # The local error of order k falls with the power k + 1 of the steps if all of them change, but with the power
    # 1 + sum_{m<=k} 1/m if only the last one does: it is a product of the spans h_n + ... + h_{n-m+1}.
    orders = np.arange(1, LENGTH)
    return np.append(1.0, _GAIN * (orders + 1) / (1 + np.cumsum(1 / orders)))


class StepEstimate(eqx.Module):
    """What a multistep solver tells its step size controller, as its `y_error`.

    **Fields:**

    - `error`: the weighted norm of the local error; below one the step is good.
    - `growth`: the factor by which steps may grow, all of them, with the order that the solver has chosen for the next.
    - `retry`: the same for the order just used; zero if there is no usable estimate.
    - `response`: the power of these factors by which to change the next step, when those before are what they are.
    """

    error: Float[Array, ""]
    growth: Float[Array, ""]
    retry: Float[Array, ""]
    response: Float[Array, ""]


def choose_order(
    errors: Float[Array, "3"], order: Int[Array, ""], points: Int[Array, ""], min_order: int, max_order: int
) -> tuple[Int[Array, ""], StepEstimate]:
    """Choose among the orders `k - 1`, `k`, `k + 1` the one that allows the longest next step.

    **Arguments:**

    - `errors`: weighted norms of the local errors that the three orders would have made in the step. Infinite or not a
        number if the step went wrong. Those of orders out of bounds are ignored.
    - `order`: the order `k` of the step.
    - `points`: the number of mesh points the step was built on, at least `k`. An estimate for order `k + 1` needs one
        more than `k`.
    - `min_order`, `max_order`: bounds of the order. Starting from order one, `min_order` is approached step by step.

    **Returns:** `(order of the next step, StepEstimate)`.
    """
    errors = lax.stop_gradient(errors)
    dtype = errors.dtype
    errors = jnp.where(jnp.isfinite(errors), errors, jnp.asarray(jnp.inf, dtype))
    # A method of order k has a local error of h^(k+1).
    exponents = 1 / (order[None] + np.arange(3, dtype=np.int32)).astype(dtype)
    factors = (_TARGET / jnp.maximum(errors, jnp.finfo(dtype).tiny)) ** exponents
    zero = jnp.zeros((), dtype)
    raisable = order < max_order
    lower = jnp.where(order > min_order, _LOWER * factors[0], zero)
    same = factors[1]
    higher = jnp.where(raisable & (order < points), _UPPER * factors[2], zero)
    # With every point since the start in use there is no estimate for the next order, but it is better as a rule.
    opening = raisable & (order == points) & (lower <= same)
    rise = opening | ((higher > same) & (higher > lower))
    fall = ~rise & (lower > same)
    next_order = order + rise.astype(order.dtype) - fall.astype(order.dtype)
    growth = jnp.maximum(jnp.maximum(lower, higher), same)
    response = jnp.asarray(_responses(), dtype)[order]
    return next_order, StepEstimate(error=errors[1], growth=growth, retry=same, response=response)
