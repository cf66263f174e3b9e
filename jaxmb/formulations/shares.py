"""The multipliers of redundant rows: the equations of motion determine their constraint force, but not their shares.

The rule is the least norm, the same as in an equilibrium: multipliers count by the constraint force of their row, with
forces multiplied by the system's size. So a share depends neither on units nor on the choice of independent rows, and
it varies smoothly along a motion.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..linalg.elimination import solve_positive
from ..linalg.inertia import DiagonalInertia
from ..system.instant import Instant
from .formulation import row_levels


def least_multipliers(at: Instant, multipliers: Float[Array, "m"]) -> Float[Array, "m"]:
    """The multipliers of least norm with the same constraint force, where no contact pulls; they are the same if no row
    is redundant and no contacts imply each other.
    """
    return at.system.contacts.sharing.multipliers(at, _of_redundant_rows(at, multipliers))


def _of_redundant_rows(at, multipliers):
    system = at.system
    dropped = system.acceleration_rows - system.acceleration_rank
    if not dropped:
        return multipliers
    scale = system.velocity_scale()
    jacobian = at.structured_jacobian.selected(system.acceleration_rank, scale, row_levels(system))
    projector = jacobian.projector(DiagonalInertia(1 / scale**2))
    numbers = jnp.argsort(jacobian.active)[:dropped]
    units = jnp.zeros((dropped, multipliers.size), multipliers.dtype).at[jnp.arange(dropped), numbers].set(1.0)
    # Combinations of rows that vanish: a dropped row, without the kept rows that imply it.
    vanishing = units - jax.vmap(lambda row: projector.balancing(jacobian.transpose_product(row)))(units)
    sizes = jacobian.row_norms(scale)
    weighted = vanishing * sizes[None, :]
    shares = solve_positive(weighted @ weighted.T, weighted @ (sizes * multipliers))
    return multipliers - shares @ vanishing
