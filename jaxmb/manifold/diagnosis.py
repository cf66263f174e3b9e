"""The reason why a simulation failed."""

from typing import Any

import diffrax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._results import RESULTS
from ..formulations import AbstractFormulation, Multipliers
from ..formulations.formulation import row_levels
from ..formulations.friction import contracts
from ..formulations.laws import laws_of
from ..linalg.elimination import full_pivot
from ..system.instant import Instant

# The result of a step whose end could not be returned to the constraints, until the simulation is diagnosed. It ends a
# run only if no error estimate shortens the step.
NOT_PROJECTED: Any = diffrax.RESULTS.nonlinear_max_steps_reached
# The same among the results of a motion.
_NOT_PROJECTED: Any = RESULTS.nonlinear_max_steps_reached
# A smallest pivot below this at the end of a failed run means that the constraints are losing rank.
_SINGULAR_PIVOT = 1e-3
# The coupling of friction with its own reactions counts as singular if a factor this close to 1 makes it singular.
_SINGULAR_COUPLING = 1e-3


def diagnose(at: Instant, singular: Bool[Array, ""], result: Any, failed: Bool[Array, ""]) -> Any:
    """Distinguish singular configurations, and failures of Newton's method, from other failures of a simulation whose
    steps end on the constraints.

    **Arguments:** `at` the last state; `singular`: whether the chart there has lost rank already; `result`: a
    `RESULTS`; `failed`: whether it is a failure.
    """
    at = lax.stop_gradient(at)
    system = at.system
    if system.velocity_rows == 0:
        return result

    def smallest_pivot():
        pivots = full_pivot(at.jacobian, scale=system.velocity_scale(), level=row_levels(system))
        return jnp.where(pivots.rank < system.acceleration_rank, 0.0, pivots.smallest)

    is_finite = failed & jnp.all(jnp.isfinite(at.q)) & jnp.all(jnp.isfinite(at.u))
    pivot = lax.cond(is_finite, smallest_pivot, lambda: jnp.ones((), at.q.dtype))
    singular = failed & ((pivot < _SINGULAR_PIVOT) | singular)
    result = RESULTS.where(singular, RESULTS.singular_configuration, result)
    return diagnose_newton(result, failed & ~singular)


def diagnose_newton(result: Any, failed: Bool[Array, ""]) -> Any:
    """Distinguish failures of Newton's method from others; arguments as in `diagnose`."""
    unsolved = (result == RESULTS.dt_min_reached) | (result == _NOT_PROJECTED)
    return RESULTS.where(failed & unsolved, RESULTS.newton_failed, result)


def diagnose_friction(
    at: Instant, formulation: AbstractFormulation, result: Any, failed: Bool[Array, ""]
) -> tuple[Any, Float[Array, "k k"]]:
    """Detect failures because friction has no solution, or more than one.

    **Arguments:** as in `diagnose`.

    **Returns:** the result, and the coupling of friction with its own reactions; zero if it is not the reason.
    """
    none = jnp.zeros((at.system.friction_rows.size,) * 2, at.q.dtype)
    # Without a search for pivots.
    formulation = Multipliers() if at.system.positive_definite_mass else formulation
    coupling = lax.cond(failed, lambda: laws_of(at.system).coupling(at, formulation), lambda: none)
    singular = failed & jnp.all(jnp.isfinite(coupling)) & ~contracts((1 + _SINGULAR_COUPLING) * coupling)
    return RESULTS.where(singular, RESULTS.friction_undetermined, result), jnp.where(singular, coupling, none)
