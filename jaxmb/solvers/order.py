"""The choice of order and step size from the error estimates of neighbouring orders."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

# The constants were chosen by measuring evaluations against true error on Kepler's problem, the Pleiades and
# Arenstorf's orbit. Results are insensitive to them; a strong preference for low orders or for an unchanged step costs
# 10-20%. Weights of the steps of the lower and of the higher order, relative to the present order.
LOWER, _UPPER = 0.98, 0.95
# After a refused step, the step changes by this factor, times the controller's safety.
_REFUSED = 0.75
# The fraction of the deviation from the target that the next step corrects.
GAIN = 0.85


class StepEstimate(eqx.Module):
    """The error estimate that a multistep solver passes to its step size controller, as its `y_error`.

    **Fields:**

    - `error`: the weighted norm of the local error; below one the step is good.
    - `growth`: the factor by which all steps may grow, with the order chosen for the next step.
    - `retry`: the same for the order just used; zero without a usable estimate, negative if no step from this state can
        have an estimate.
    - `response`: the power of these factors by which to change the next step alone, with the earlier steps given.
    - `limit`: the largest factor by which the next step may grow.
    - `work`: evaluations of the vector field, and matrices computed; as floats, since diffrax expects these in errors.
    """

    error: Float[Array, ""]
    growth: Float[Array, ""]
    retry: Float[Array, ""]
    response: Float[Array, ""]
    limit: Float[Array, ""]
    work: Float[Array, "2"]


def refuse(error: Any, off: Bool[Array, ""]) -> Any:
    """An error estimate, changed so that the step is not accepted where `off`; a `StepEstimate` asks for a shorter
    step as well.
    """
    if not isinstance(error, StepEstimate):
        return jax.tree.map(lambda x: jnp.where(off, jnp.asarray(jnp.inf, x.dtype), x), error)
    parts = lambda e: (e.error, e.growth, e.retry, e.response)
    values = zip(parts(error), (jnp.inf, 0.0, _REFUSED, 1.0), strict=True)
    changed = [jnp.where(off, jnp.asarray(worst, value.dtype), value) for value, worst in values]
    return eqx.tree_at(parts, error, changed)


def growth_factors(errors: Float[Array, " formulas"], powers: Any, target: float) -> Float[Array, " formulas"]:
    """Factors by which steps may grow to reach the target error; zero where the error is not finite."""
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
    """Choose the formula that allows the longest next step, among the present formula and its neighbours in order.

    **Arguments:**

    - `errors`: weighted norms of the local errors of the lower, the present and the higher formula in the step,
        infinite or NaN if the step failed. The errors of formulas that are not allowed are ignored.
    - `powers`: the powers of the step that these errors are proportional to.
    - `response`: as in `StepEstimate`.
    - `may_fall`, `may_rise`: whether the lower and the higher formula are allowed.
    - `known`: whether there are enough points for the error of the higher formula.
    - `target`: the error to aim at, in units of the tolerance.
    - `work`, `limit`: as in `StepEstimate`.
    - `bounded`: limits the growth factors of the three formulas for stability.

    **Returns:** the change of order (-1, 0 or 1) and a `StepEstimate`.
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
    # While every point since the start is in use, the next order has no estimate, but is usually better.
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
