"""A formulation: a method of solving one linear-quadratic problem for accelerations and multipliers.

    minimise ½ (u̇ − M⁻¹F)ᵀ M (u̇ − M⁻¹F)  subject to  A u̇ = γ,    M u̇ = F + Aᵀ λ

All formulations give the same u̇, and the same constraint force Aᵀλ; they differ in cost and in what they need.
"""

import abc
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.elimination import eliminate, full_pivot
from ..linalg.inertia import AbstractInertia
from ..linalg.jacobian import AbstractJacobian, DenseJacobian
from ..system import AbstractSystem

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractFormulation(eqx.Module):
    """A method of solving for accelerations and multipliers.

    `inverts_mass` says whether it needs the inverse of the mass matrix, which some systems do not have; `partitions`
    says whether it needs the velocities split into dependent and independent ones. A formulation that does not
    partition needs only the independent rows, so no pivots are searched for where no row is redundant. `takes_blocks`
    says whether it takes a Jacobian in blocks as it is; others make one dense matrix of it.
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


def pivoted_jacobian(system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> DenseJacobian:
    """The Jacobian A at a state as one matrix, with its factor after a search for pivots."""
    jacobian = system.jacobian(t, q, u)
    pivots = full_pivot(jacobian, scale=system.velocity_scale(), level=row_levels(system))
    return DenseJacobian(jacobian, eliminate(jacobian, pivots.order, system.acceleration_rank))


def row_levels(system: AbstractSystem) -> Array:
    """Holonomic rows before nonholonomic ones before those of accelerations, so that the dependent velocities nest."""
    row = jnp.arange(system.acceleration_rows)
    return (row >= system.position_rows).astype(int) + (row >= system.velocity_rows).astype(int)


def check_mass(system: AbstractSystem, formulation: AbstractFormulation) -> None:
    """Raise a `ValueError` for a formulation that needs the inverse of a mass matrix that is singular."""
    if formulation.inverts_mass and not system.positive_definite_mass:
        raise ValueError(
            f"{type(formulation).__name__} needs the inverse of the mass matrix, which is singular in these "
            "velocities. Use Partitioned(), NullSpace(), or UdwadiaKalaba('singular_mass')."
        )


def accelerations(
    system: AbstractSystem,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    gamma_shift: Float[Array, "m"] | None = None,
) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
    """Accelerations u̇ and multipliers λ of a system at a state on its constraints; with a `gamma_shift`, those of
    `A u̇ = γ − gamma_shift`.

    **Raises:** `ValueError` for a formulation that needs the inverse of a mass matrix that is singular.
    """
    check_mass(system, formulation)
    if system.acceleration_rows == 0:
        return system.inertia(t, q, u).solve(system.force(t, q, u)), jnp.zeros(0, u.dtype)
    searches = formulation.partitions or system.acceleration_rank < system.acceleration_rows
    jacobian = pivoted_jacobian(system, t, q, u) if searches else system.structured_jacobian(t, q, u)
    return solve_constrained(system, formulation, t, q, u, jacobian, gamma_shift)


def solve_constrained(
    system: AbstractSystem,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    jacobian: AbstractJacobian,
    gamma_shift: Float[Array, "m"] | None = None,
) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
    """The same as `accelerations`, from a Jacobian A that is known already.

    Where constraints are not ideal, their force C follows from the multipliers of ideal ones, and then accelerations
    from C as from any other force (F. E. Udwadia and P. Phohomsiri, Proc. R. Soc. A 463, 2007): `M u̇ = F + C + Aᵀ λ`.
    """
    inertia, force = system.inertia(t, q, u), system.force(t, q, u)
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    gamma = gamma if gamma_shift is None else gamma - gamma_shift
    udot, multipliers = formulation.solve(inertia, force, jacobian, gamma)
    if system.ideal:
        return udot, multipliers
    force = force + system.nonideal_force(t, q, u, multipliers)
    return formulation.solve(inertia, force, jacobian, gamma)
