"""What a formulation is: a way to solve one linear-quadratic problem for accelerations and multipliers.

    minimise ½ (u̇ − M⁻¹F)ᵀ M (u̇ − M⁻¹F)  subject to  A u̇ = γ,    M u̇ = F + Aᵀ λ

All formulations give the same u̇, and the same constraint force Aᵀλ; they differ in cost and in what they need.
"""

import abc
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.elimination import Factor, factor, full_pivot
from ..system import AbstractInertia, AbstractSystem
from ..system.chain import block_jacobian

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractFormulation(eqx.Module):
    """A road from the matrices of the equation to accelerations and multipliers.

    `inverts_mass` says whether it needs the inverse of the mass matrix, which is not there for every system;
    `partitions` says whether it needs the split in dependent and independent columns; without it only the independent
    rows are needed, and no search for pivots where there is no redundancy. `assembles` says whether it takes A as one
    matrix; otherwise it takes the blocks of joints in a chain, and no factor.
    """

    partitions: AbstractVar[bool]
    inverts_mass: AbstractVar[bool]
    assembles: ClassVar[bool] = True

    @abc.abstractmethod
    def solve(
        self,
        inertia: AbstractInertia,
        force: Float[Array, "n"],
        jacobian: Float[Array, "m n"],
        gamma: Float[Array, "m"],
        factor: Factor,
    ) -> tuple[Float[Array, "n"], Float[Array, "m"]]:
        """Accelerations u̇ and multipliers λ; multipliers of implied rows are zero.

        **Arguments:** M, F, A and γ of the equation, and A's `factor` in the current chart.
        """


def linearize(system: AbstractSystem, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> tuple[Array, Factor]:
    """The Jacobian A at a state and its factor, with a search for pivots."""
    jacobian = system.jacobian(t, q, u)
    pivots = full_pivot(jacobian, scale=system.velocity_scale(), stage=stages(system))
    return jacobian, factor(jacobian, pivots.order, system.acceleration_rank)


def every_row(m: int, n: int, dtype) -> Factor:
    """A factor that keeps all rows and splits no columns, for formulations that do not partition."""
    return Factor(jnp.zeros((n, m), dtype), jnp.zeros((n, 0), dtype), jnp.arange(m))


def stages(system: AbstractSystem) -> Array:
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


def check_independent(system: AbstractSystem) -> None:
    """Raise a `ValueError` for a system with redundant rows, which block elimination cannot drop."""
    if system.acceleration_rank < system.acceleration_rows:
        raise ValueError(
            f"Of {system.acceleration_rows} constraint rows only {system.acceleration_rank} are independent, and block "
            "elimination drops none; use Partition() or Projection()."
        )


def accelerations(
    system: AbstractSystem,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    demand: Float[Array, "m"] | None = None,
) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
    """Accelerations u̇ and multipliers λ of a system at a state on its constraints; with a `demand`, those of
    `A u̇ = γ − demand`.

    **Raises:** `ValueError` for a formulation that needs the inverse of a mass matrix that is singular, and for one
    that needs a chain of independent joints where there is none.
    """
    check_mass(system, formulation)
    if system.acceleration_rows == 0:
        return system.inertia(t, q, u).solve(system.force(t, q, u)), jnp.zeros(0, u.dtype)
    jacobian: Any
    if not formulation.assembles:
        check_independent(system)
        jacobian, split = block_jacobian(system, t, q, u), None
    elif formulation.partitions or system.acceleration_rank < system.acceleration_rows:
        jacobian, split = linearize(system, t, q, u)
    else:
        jacobian, split = system.jacobian(t, q, u), every_row(system.acceleration_rows, system.nu, u.dtype)
    return solve_constrained(system, formulation, t, q, u, jacobian, split, demand)


def solve_constrained(
    system: AbstractSystem,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
    jacobian: Any,
    split: Any,
    demand: Float[Array, "m"] | None = None,
) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
    """The same from the Jacobian A and its factor, or from its blocks and none.

    Where constraints are not ideal, their force C follows from the multipliers of ideal ones, and then accelerations
    from C as from any other force (F. E. Udwadia and P. Phohomsiri, Proc. R. Soc. A 463, 2007): `M u̇ = F + C + Aᵀ λ`.
    """
    inertia, force = system.inertia(t, q, u), system.force(t, q, u)
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    gamma = gamma if demand is None else gamma - demand
    udot, multipliers = formulation.solve(inertia, force, jacobian, gamma, split)
    if system.ideal:
        return udot, multipliers
    force = force + system.nonideal_force(t, q, u, multipliers)
    return formulation.solve(inertia, force, jacobian, gamma, split)
