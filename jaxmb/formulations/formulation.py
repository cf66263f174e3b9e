"""A formulation: a method of solving one linear-quadratic problem for accelerations and multipliers.

    minimise ½ (u̇ − M⁻¹F)ᵀ M (u̇ − M⁻¹F)  subject to  A u̇ = γ,    M u̇ = F + Aᵀ λ

All formulations give the same u̇, and the same constraint force Aᵀλ; they differ in cost and in what they need.
"""

import abc
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._compat import with_rest_computed
from .._types import Coordinates, Scalar, Velocities
from ..linalg.elimination import full_pivot
from ..linalg.inertia import AbstractInertia
from ..linalg.jacobian import AbstractJacobian, DenseJacobian
from ..linalg.newton import root
from ..linalg.sums import unchecked_take
from ..system import AbstractEquation
from ..system.residuals import friction_force
from .friction import find_multipliers

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

    def prepared(self, inertia: AbstractInertia, jacobian: AbstractJacobian) -> "AbstractFormulation":
        """The same method for several F and γ, with what it computes of M and A alone."""
        del inertia, jacobian
        return self


def pivoted_jacobian(system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities) -> DenseJacobian:
    """The Jacobian A at a state as one matrix, with its factor after a search for pivots."""
    jacobian = system.jacobian(t, q, u)
    pivots = full_pivot(jacobian, scale=system.velocity_scale(), level=row_levels(system))
    return DenseJacobian(jacobian).eliminated(pivots.order, system.acceleration_rank)


def row_levels(system: AbstractEquation) -> Array:
    """Holonomic rows before nonholonomic ones before those of accelerations, so that the dependent velocities nest."""
    row = jnp.arange(system.acceleration_rows)
    return (row >= system.position_rows).astype(int) + (row >= system.velocity_rows).astype(int)


def check_mass(system: AbstractEquation, formulation: AbstractFormulation) -> None:
    """Raise a `ValueError` for a formulation that needs the inverse of a mass matrix that is singular."""
    if formulation.inverts_mass and not system.positive_definite_mass:
        raise ValueError(
            f"{type(formulation).__name__} needs the inverse of the mass matrix, which is singular in these "
            "velocities. Use Partitioned(), NullSpace(), or UdwadiaKalaba('singular_mass')."
        )


def accelerations(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Coordinates,
    u: Velocities,
    gamma_shift: Float[Array, "m"] | None = None,
) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
    """Accelerations u̇ and multipliers λ of a system at a state on its constraints; with a `gamma_shift`, those of
    `A u̇ = γ − gamma_shift`. NaN where friction does not determine them.

    ```python
    method = jaxmb.formulations.Multipliers()
    udot, multipliers = jaxmb.formulations.accelerations(system, method, 0.0, state.q, state.u)
    ```

    **Raises:** `ValueError` for a formulation that needs the inverse of a mass matrix that is singular.
    """
    check_mass(system, formulation)
    if system.acceleration_rows == 0:
        return system.inertia(t, q, u).solve(system.force(t, q, u)), jnp.zeros(0, u.dtype)
    jacobian = _jacobian(system, formulation, t, q, u)
    udot, multipliers, failed = solve_constrained(system, formulation, t, q, u, jacobian, gamma_shift)
    if failed is None:
        return udot, multipliers
    return jnp.where(failed, jnp.nan, udot), jnp.where(failed, jnp.nan, multipliers)


def _jacobian(system, formulation, t, q, u):
    if formulation.partitions:
        return pivoted_jacobian(system, t, q, u)
    jacobian = system.structured_jacobian(t, q, u)
    return jacobian.selected(system.acceleration_rank, system.velocity_scale(), row_levels(system))


class Solution(NamedTuple):
    """Accelerations u̇ and multipliers λ, and whether they `failed` to be determined; None of a system where no force
    depends on multipliers.
    """

    udot: Float[Array, "nu"]
    multipliers: Float[Array, "m"]
    failed: Bool[Array, ""] | None


def solve_constrained(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Coordinates,
    u: Velocities,
    jacobian: AbstractJacobian,
    gamma_shift: Float[Array, "m"] | None = None,
) -> Solution:
    """The same as `accelerations`, from a Jacobian A that is known already.

    Where constraints are not ideal, `M u̇ = F + C + Aᵀ λ`. A force C that depends on multipliers depends on these λ, not
    on those of ideal constraints, and is solved for with them. Where it does not determine them, C is that of the
    multipliers of ideal constraints.
    """
    inertia, force = system.inertia(t, q, u), system.force(t, q, u)
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    gamma = gamma if gamma_shift is None else gamma - gamma_shift
    if system.ideal:
        return Solution(*formulation.solve(inertia, force, jacobian, gamma), None)
    rows, failed, own = system.friction_rows, None, jnp.zeros(0, u.dtype)
    if rows.size:
        formulation = formulation.prepared(inertia, jacobian)
        known = lax.stop_gradient((system, t, q, u, inertia, force, jacobian, gamma, formulation))
        found, _, failed = _friction(*known)

        def residual(own):
            law = friction_force(system, t, q, u, own)
            return own - unchecked_take(formulation.solve(inertia, force + law, jacobian, gamma)[1], rows)

        own = root(residual, found, lambda _, found: found)
    force = force + friction_force(system, t, q, u, own)
    return Solution(*formulation.solve(inertia, force, jacobian, gamma), failed)


def _friction(system, t, q, u, inertia, force, jacobian, gamma, formulation):
    """Multipliers of the rows that forces depend on, their coupling, and whether they are not determined."""
    rows = system.friction_rows
    # The equations are symmetric: what a force does to a multiplier, its row does to the accelerations.
    units = jnp.asarray(np.eye(gamma.size)[rows], gamma.dtype)
    forces = jnp.concatenate([force[None], jnp.zeros((rows.size, force.size), force.dtype)])
    solve = jax.vmap(lambda force, gamma: formulation.solve(inertia, force, jacobian, gamma))
    udot, multipliers = solve(forces, jnp.concatenate([gamma[None], units]))
    start, influence = unchecked_take(multipliers[0], rows), -udot[1:]
    # Newton's method evaluates the law again and again, but only for other multipliers.
    law = with_rest_computed(lambda own: friction_force(system, t, q, u, own), start)
    contacts = system.contacts
    return find_multipliers(law, influence, start, np.isin(rows, contacts.rows[: contacts.n]))


def friction_coupling(
    system: AbstractEquation, formulation: AbstractFormulation, t: Scalar, q: Coordinates, u: Velocities
) -> Float[Array, "k k"]:
    """How much the multipliers that friction depends on change with themselves, through its force, at a state; see
    `friction`. Without derivative.
    """
    system, t, q, u = lax.stop_gradient((system, t, q, u))
    jacobian, inertia = _jacobian(system, formulation, t, q, u), system.inertia(t, q, u)
    formulation = formulation.prepared(inertia, jacobian)
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    return _friction(system, t, q, u, inertia, system.force(t, q, u), jacobian, gamma, formulation)[1]
