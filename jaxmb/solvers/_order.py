"""The choice of order and step size from the error estimates of neighbouring orders."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

# The constants come from measuring evaluations against true error, on Kepler's problem, the Pleiades and Arenstorf's
# orbit. They matter little over wide ranges; a strong preference for low orders or for an unchanged step costs 10-20%.
# How the step of the order below, and of the order above, counts against that of the present order.
LOWER, _UPPER = 0.98, 0.95
# How much of the deviation from the target the next step is to make up for.
GAIN = 0.85


class StepEstimate(eqx.Module):
    """The error estimate that a multistep solver passes to its step size controller, as its `y_error`.

    **Fields:**

    - `error`: the weighted norm of the local error; below one the step is good.
    - `growth`: the factor by which steps may grow, all of them, with the order that the solver has chosen for the next.
    - `retry`: the same for the order just used; zero if there is no usable estimate.
    - `response`: the power of these factors by which to change the next step, when those before are what they are.
    - `limit`: the largest factor by which the next step may grow.
    - `work`: what the step took: evaluations of the vector field, and matrices made. Not integers, which diffrax does
        not expect in an error.
    """

    error: Float[Array, ""]
    growth: Float[Array, ""]
    retry: Float[Array, ""]
    response: Float[Array, ""]
    limit: Float[Array, ""]
    work: Float[Array, "2"]


def growth_factors(errors: Float[Array, " formulas"], powers: Any, target: float) -> Float[Array, " formulas"]:
    """By what factors steps may grow for the errors to be what is aimed at; zero if they are not finite."""
    errors = jnp.where(jnp.isfinite(errors), errors, jnp.asarray(jnp.inf, errors.dtype))
    return (target / jnp.maximum(errors, jnp.finfo(errors.dtype).tiny)) ** (1 / powers.astype(errors.dtype))


def choose_order(
    errors: Float[Array, "3"],
    powers: Float[Array, "3"],
    response: Float[Array, ""],
    *,
    may_fall: Bool[Array, ""],
    may_rise: Bool[Array, ""],
    known: Bool[Array, ""],
    target: float,
    work: Int[Array, "2"],
    limit: Any = np.inf,
    bounded: Callable[[Float[Array, "3"]], Float[Array, "3"]] | None = None,
) -> tuple[Int[Array, ""], StepEstimate]:
    """Choose, among the present formula and its neighbours in order, the one that allows the longest next step.

    **Arguments:**

    - `errors`: weighted norms of the local errors that the lower, the present and the higher formula would have made in
        the step. Infinite or not a number if the step went wrong. Those of formulas that are not allowed are ignored.
    - `powers`: of the steps that these errors fall with.
    - `response`: as in `StepEstimate`.
    - `may_fall`, `may_rise`: whether the lower and the higher formula are allowed.
    - `known`: whether there are points enough for the error of the higher formula.
    - `target`: the error to aim at, in units of the tolerance.
    - `work`, `limit`: as in `StepEstimate`.
    - `bounded`: makes factors by which steps may grow, for the three formulas, those that stability allows.

    **Returns:** `(-1, 0 or 1, StepEstimate)`.
    """
    errors = lax.stop_gradient(errors)
    dtype = errors.dtype
    factors = growth_factors(errors, powers, target)
    retry = factors[1]
    factors = factors if bounded is None else bounded(factors)
    zero = jnp.zeros((), dtype)
    lower = jnp.where(may_fall, LOWER * factors[0], zero)
    same = factors[1]
    higher = jnp.where(may_rise & known, _UPPER * factors[2], zero)
    # With every point since the start in use there is no estimate for the next order, but it is better as a rule.
    opening = may_rise & ~known & (lower <= same)
    rise = opening | ((higher > same) & (higher > lower))
    fall = ~rise & (lower > same)
    growth = jnp.maximum(jnp.maximum(lower, higher), same)
    change = rise.astype(jnp.int32) - fall.astype(jnp.int32)
    return change, StepEstimate(
        error=errors[1],
        growth=growth,
        retry=retry,
        response=response.astype(dtype),
        limit=jnp.asarray(limit, dtype),
        work=work.astype(dtype),
    )
