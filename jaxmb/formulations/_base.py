"""What a formulation is: a way to solve one linear-quadratic problem for accelerations and multipliers.

    minimise ½ (u̇ − M⁻¹F)ᵀ M (u̇ − M⁻¹F)  subject to  A u̇ = γ,    M u̇ = F + Aᵀ λ

All formulations give the same u̇, and the same constraint force Aᵀλ; they differ in cost and in what they need.
"""

import abc
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Scalar
from ..elimination import Factor, factor, full_pivot
from ..system import AbstractInertia, AbstractSystem

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractFormulation(eqx.Module):
    """A road from the matrices of the equation to accelerations and multipliers.

    `partitions` says whether it needs the split in dependent and independent columns; without it only the independent
    rows are needed, and no search for pivots where there is no redundancy.
    """

    partitions: AbstractVar[bool]

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
    return jacobian, factor(jacobian, pivots.order, system.velocity_rank)


def every_row(m: int, n: int, dtype) -> Factor:
    """A factor that keeps all rows and splits no columns, for formulations that do not partition."""
    return Factor(jnp.zeros((n, m), dtype), jnp.zeros((n, 0), dtype), jnp.arange(m))


def stages(system: AbstractSystem) -> Array:
    """Holonomic rows before nonholonomic ones, so that the dependent velocities nest."""
    return (jnp.arange(system.velocity_rows) >= system.position_rows).astype(int)


def accelerations(
    system: AbstractSystem,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Float[Array, "nq"],
    u: Float[Array, "nu"],
) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
    """Accelerations u̇ and multipliers λ of a system at a state on its constraints."""
    inertia, force = system.inertia(t, q), system.force(t, q, u)
    if system.velocity_rows == 0:
        return inertia.solve(force), jnp.zeros(0, u.dtype)
    if formulation.partitions or system.velocity_rank < system.velocity_rows:
        jacobian, split = linearize(system, t, q, u)
    else:
        jacobian, split = system.jacobian(t, q, u), every_row(system.velocity_rows, system.nu, u.dtype)
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    return formulation.solve(inertia, force, jacobian, gamma, split)
