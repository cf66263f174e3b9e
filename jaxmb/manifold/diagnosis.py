"""The reason why a simulation on independent coordinates failed."""

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from .._results import RESULTS
from .._types import Scalar, State
from ..formulations.formulation import row_levels
from ..linalg.elimination import full_pivot
from ..system import AbstractSystem

# A smallest pivot below this at the end of a failed run means that the constraints are losing rank.
_SINGULAR_PIVOT = 1e-3


def diagnose(
    system: AbstractSystem, t: Scalar, y: State, singular: Bool[Array, ""], result: Any, failed: Bool[Array, ""]
) -> Any:
    """Tell singular configurations, and failures of Newton's method, from other failures.

    **Arguments:** `t`, `y`: the last state; `singular`: whether the chart there has lost rank already; `result`: a
    `RESULTS`; `failed`: whether it is a failure.
    """
    if system.velocity_rows == 0:
        return result
    system, t, y = lax.stop_gradient((system, t, y))

    def smallest_pivot():
        pivots = full_pivot(system.jacobian(t, y.q, y.u), scale=system.velocity_scale(), level=row_levels(system))
        return jnp.where(pivots.rank < system.acceleration_rank, 0.0, pivots.smallest)

    pivot = lax.cond(failed, smallest_pivot, lambda: jnp.ones((), y.q.dtype))
    singular = failed & ((pivot < _SINGULAR_PIVOT) | singular)
    newton = failed & ~singular & (result == RESULTS.dt_min_reached)
    result = RESULTS.where(singular, RESULTS.singular_configuration, result)
    return RESULTS.where(newton, RESULTS.newton_failed, result)
