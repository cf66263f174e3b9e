"""The neighbours of the present formula in its family, and the steps at which formulas damp."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from ._damping import are_damped
from ._formulas import FAMILIES, Family
from .order import GAIN


def ladder(past_points: tuple[int, ...]) -> np.ndarray:
    """For each number of points: the next lower number, itself, and the next higher."""
    steps = [*range(1, past_points[0]), *past_points]
    out = np.zeros((past_points[-1] + 1, 3), np.int32)
    for lower, points, upper in zip([steps[0], *steps], steps, [*steps[1:], steps[-1]], strict=False):
        out[points] = lower, points, upper
    return out


def responses(family: Family) -> np.ndarray:
    """For each number of points: the power by which to change the next step alone, see `StepEstimate`."""
    # As in Adams' method, the error is a product of a power of the step and its distances from all nodes.
    k = np.arange(1, family.highest + 1)
    last = (3 if family.integrated else 2) + family.multiplicity * np.cumsum(1 / k)
    return np.append(1.0, GAIN * (family.order(k) + 1) / last)


def a_stable(family: str, past_points: tuple[int, ...]) -> int | None:
    """The A-stable formula with the most points, if formulas with more points may be chosen."""
    stable = [k for k in past_points if k <= FAMILIES[family].stable]
    return stable[-1] if stable and stable[-1] < past_points[-1] else None


def damped_growth(
    family: str,
    points: Int[Array, " formulas"],
    h: Float[Array, ""],
    spectrum: Complex[Array, " k"],
    factors: Float[Array, " formulas"],
) -> Float[Array, " formulas"]:
    """The factors by which steps may grow such that the longer steps damp all decaying components."""
    # A single change of the step lies within these bounds.
    steps = h * jnp.stack([jnp.clip(factors, 0.5, 4.0), jnp.ones_like(factors)])
    then, now = jax.vmap(lambda steps: are_damped(family, points, steps, spectrum))(steps)
    zero, one = jnp.zeros_like(factors), jnp.ones_like(factors)
    return jnp.where(then, factors, jnp.where(now, jnp.minimum(factors, one), zero))
