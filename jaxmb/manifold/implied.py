"""The watch of rows that are dropped because other rows imply them.

Dropped rows of positions and velocities are residuals of a state that satisfies the kept rows. A dropped row between
accelerations is violated if the accelerations of the kept rows do not satisfy it.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..formulations.formulation import row_levels
from ..linalg.elimination import Factor, PivotOrder, eliminate, full_pivot
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .orthogonal_projection import project_normalized

# Redundant rows may be violated by this multiple of Newton's tolerance, or of the pivots that count as zero.
_ALLOWED = 8.0
# A row whose gradient is independent of the kept rows by this power of eps, 1e-6, is not implied any more. The same
# power decides when a system is compiled. A run that fails at the fraction `_SUSPECTED` of it fails for this reason,
# since gradients are compared every few steps only.
_IMPLIED, _SUSPECTED = 3 / 8, 0.01
# A row that is not implied any more, and a row between accelerations, may be violated by the effect of this multiple of
# the tolerance of integration.
_ERRORS = 10.0


class DroppedRows(eqx.Module):
    """Numbers of the rows of ψ, by which the dropped ones are watched.

    **Fields:** the `sizes` of the rows; the largest part of the gradient of a row of Φ that is `independent` of the
    kept rows, relative to the row's size, None if it is unknown; the largest `violation` of dropped rows, in units of
    the allowed one; `suspected`: the same if rows were not implied any more at a smaller independent part already.
    """

    sizes: Float[Array, "velocity_rows"]
    independent: Float[Array, ""] | None
    violation: Float[Array, ""]
    suspected: Float[Array, ""]

    @classmethod
    def at_start(cls, at: Instant) -> "DroppedRows":
        zero = jnp.zeros((), at.q.dtype)
        sizes = at.row_sizes() if at.system.velocity_rows else jnp.zeros(0, at.q.dtype)
        return cls(sizes, zero if drops_positions(at.system) else None, zero, zero)


def drops_rows(system: AbstractEquation) -> bool:
    """Whether implied rows are dropped."""
    return system.acceleration_rank < system.acceleration_rows


def drops_positions(system: AbstractEquation) -> bool:
    """Whether implied rows of Φ are dropped."""
    return system.position_rank < system.position_rows


def drops_accelerations(system: AbstractEquation) -> bool:
    """Whether implied rows between accelerations are dropped."""
    kept = system.acceleration_rank - system.velocity_rank
    return kept < system.acceleration_rows - system.velocity_rows


def check_watched(system: AbstractEquation, policy: str) -> None:
    """Raise a `ValueError` for a policy without charts if implied rows between accelerations are dropped."""
    if drops_accelerations(system):
        raise ValueError(
            f"Of {system.acceleration_rows} constraint rows only {system.acceleration_rank} are independent, and "
            f"{policy} does not watch implied rows of servos and acceleration constraints; remove them, or use "
            "Partition()."
        )


def violated(at: Instant, rtol: Any, project: bool = False) -> Any:
    """Whether a state on the kept rows, or near them and then to `project` on them, violates dropped rows; False
    without any.
    """
    return _violated(*lax.stop_gradient((at, rtol)), project) if drops_rows(at.system) else False


@eqx.filter_jit
def _violated(at, rtol, project):
    if project:
        at = Instant.of(at.system, at.t, project_normalized(at.system, at.t, at.state))
    return violation_without_chart(at, rtol) > 1


def independent_part(
    jacobian: Float[Array, "m n"],
    sizes: Float[Array, "mv"],
    factor: Factor,
    order: PivotOrder,
    scale: Float[Array, "n"],
) -> Float[Array, ""]:
    """The largest part of a row that is independent of the kept rows, relative to the row's size.

    **Arguments:** the rows of Φ; the `sizes` of the rows of ψ; `factor`, `order` and `scale` of the columns.
    """
    n, free = factor.null_space.shape
    size = scale.at[order.columns[n - free :]].get(mode="promise_in_bounds", wrap_negative_indices=False)
    return jnp.max(jnp.abs(jacobian @ factor.null_space) @ size / sizes[: jacobian.shape[0]])


def watched(at: Instant, rows: DroppedRows, newton_tol: Any, rtol: Any) -> DroppedRows:
    """The rows with the violation of dropped rows of Φ and ψ at a state on the kept rows.

    A row that is not implied any more bounds the displacement that would satisfy it and the kept rows.
    """
    system, eps = at.system, float(jnp.finfo(at.q.dtype).eps)
    if system.velocity_rank == system.velocity_rows:
        return dataclasses.replace(rows, violation=jnp.zeros_like(rows.violation))
    positions, velocities = at.violations(rows.sizes)
    allowed = _ALLOWED * jnp.maximum(newton_tol, eps**0.5)
    suspected, bound = jnp.zeros_like(rows.violation), allowed
    if rows.independent is not None:
        displaced = jnp.clip(_ERRORS * rtol * rows.independent, newton_tol, allowed)
        suspected = jnp.where(rows.independent > _SUSPECTED * eps**_IMPLIED, jnp.max(positions) / displaced, 0.0)
        bound = jnp.where(rows.independent > eps**_IMPLIED, displaced, allowed)
    violation = jnp.max(positions, initial=0.0) / bound
    # If all dropped rows are position constraints, their velocities follow.
    if system.velocity_rank - system.position_rank < system.velocity_rows - system.position_rows:
        violation = jnp.maximum(violation, jnp.max(velocities) / allowed)
    return dataclasses.replace(rows, violation=violation, suspected=jnp.maximum(suspected, violation))


def violation_of_accelerations(at: Instant, udot: Float[Array, "nu"], rtol: Any) -> Float[Array, ""]:
    """The largest residual of rows between accelerations, in units of the effect of small errors of the motion.

    **Arguments:** `udot`: any accelerations that satisfy the kept rows; `rtol`: the relative tolerance of the motion.
    """
    system, scale = at.system, at.system.velocity_scale()
    tiny = jnp.finfo(at.u.dtype).tiny

    def residual(step, change, udot):
        return at.moved(step).with_(u=at.u + change).acceleration_residual(udot)[system.velocity_rows :]

    zero = jnp.zeros_like(at.u)
    slopes = jax.jacfwd(residual, (0, 1, 2))(zero, zero, udot)
    of_positions, of_velocities, sizes = (jnp.abs(slope) @ scale for slope in slopes)
    speed = jnp.max(jnp.abs(at.u) / scale)
    rate = jnp.maximum(jnp.max(jnp.abs(udot) / scale), speed**2)
    effect = of_positions + of_velocities * speed + sizes * rate
    unmet = jnp.abs(residual(zero, zero, udot))
    # At rest there are only rounding errors to compare.
    unmet = jnp.where(unmet > jnp.finfo(at.u.dtype).eps ** 0.75 * sizes, unmet, 0.0)
    return jnp.max(unmet / (_ERRORS * rtol * effect + tiny))


def violation_without_chart(at: Instant, rtol: Any) -> Float[Array, ""]:
    """The largest violation of dropped rows, in units of the allowed one, without a comparison of gradients."""
    rows = eqx.tree_at(lambda rows: rows.independent, DroppedRows.at_start(at), None, is_leaf=lambda x: x is None)
    violation = watched(at, rows, 0.0, rtol).violation
    return jnp.maximum(violation, contradiction_ahead(at, rtol)) if drops_accelerations(at.system) else violation


def contradiction_ahead(at: Instant, rtol: Any) -> Float[Array, ""]:
    """`violation_of_accelerations` at a time and just after it, since prescribed accelerations may jump."""
    start = jnp.asarray(at.t)
    after = start + 64 * jnp.finfo(start.dtype).eps * jnp.maximum(jnp.abs(start), 1.0)

    def violation(t):
        now, system = Instant(at.system, t, at.q, at.u, at.z), at.system
        order = full_pivot(now.jacobian, scale=system.velocity_scale(), level=row_levels(system)).order
        factor = eliminate(now.jacobian, order, system.acceleration_rank)
        return violation_of_accelerations(now, factor.right_inverse @ now.gamma, rtol)

    return jnp.max(jax.vmap(violation)(jnp.stack([start, after])))
