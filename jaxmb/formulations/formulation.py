"""A formulation: a method of solving one linear-quadratic problem for accelerations and multipliers.

    minimise ½ (u̇ − M⁻¹F)ᵀ M (u̇ − M⁻¹F)  subject to  A u̇ = γ,    M u̇ = F + Aᵀ λ

All formulations give the same u̇, and the same constraint force Aᵀλ; they differ in cost and requirements.
"""

import abc
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar, Velocities
from ..linalg.elimination import full_pivot
from ..linalg.inertia import AbstractInertia
from ..linalg.jacobian import AbstractJacobian, DenseJacobian
from ..system.equation import AbstractEquation
from ..system.instant import Instant

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractFormulation(eqx.Module):
    """A method of solving for accelerations and multipliers.

    **Fields:**

    - `inverts_mass`: whether it needs the inverse of the mass matrix, which some systems do not have.
    - `partitions`: whether it needs the velocities split into dependent and independent ones. Other formulations need
        only the independent rows, so no pivots are searched if no row is redundant.
    - `takes_blocks`: whether it takes a Jacobian in blocks as it is; others make one dense matrix of it.
    """

    partitions: AbstractVar[bool]
    inverts_mass: AbstractVar[bool]
    takes_blocks: ClassVar[bool] = False

    @abc.abstractmethod
    def solve(
        self,
        inertia: AbstractInertia,
        force: Float[Array, "n"],
        jacobian: AbstractJacobian,
        gamma: Float[Array, "m"],
    ) -> tuple[Float[Array, "n"], Float[Array, "m"]]:
        """Accelerations u̇ and multipliers λ; multipliers of implied rows are zero.

        **Arguments:** M, F, A and γ of the equation. A formulation that needs A as one matrix takes `jacobian.dense()`.
        """

    def prepared(self, inertia: AbstractInertia, jacobian: AbstractJacobian) -> "AbstractFormulation":
        """The same method for several F and γ, with its results for M and A alone."""
        del inertia, jacobian
        return self


def pivoted_jacobian(system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> DenseJacobian:
    """The Jacobian A at a state as one matrix, with its factor after a search for pivots."""
    return _pivoted(Instant(system, t, q, u))


def _pivoted(at):
    system = at.system
    pivots = full_pivot(at.jacobian, scale=system.velocity_scale(), level=row_levels(system))
    return DenseJacobian(at.jacobian).eliminated(pivots.order, system.acceleration_rank)


def suitable_jacobian(at: Instant, formulation: AbstractFormulation) -> AbstractJacobian:
    """The Jacobian A with the independent rows, and columns, that a formulation needs."""
    if formulation.partitions:
        return _pivoted(at)
    system = at.system
    return at.structured_jacobian.selected(system.acceleration_rank, system.velocity_scale(), row_levels(system))


def row_levels(system: AbstractEquation) -> Any:
    """Levels for elimination: 0 for holonomic rows, 1 for nonholonomic rows, 2 for rows of accelerations only.
    `full_pivot` eliminates level 0 first, so that the dependent velocities nest.
    """
    row = np.arange(system.acceleration_rows)
    return (row >= system.position_rows).astype(int) + (row >= system.velocity_rows).astype(int)


def check_mass(system: AbstractEquation, formulation: AbstractFormulation) -> None:
    """Raise a `ValueError` for a formulation that needs the inverse of a singular mass matrix."""
    if formulation.inverts_mass and not system.positive_definite_mass:
        raise ValueError(
            f"{type(formulation).__name__} needs the inverse of the mass matrix, which is singular in these "
            "velocities. Use Partitioned(), NullSpace(), or UdwadiaKalaba('singular_mass')."
        )
