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
from ..system.instant import Instant
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
    return _pivoted(Instant(system, t, q, u))


def _pivoted(at):
    system = at.system
    pivots = full_pivot(at.jacobian, scale=system.velocity_scale(), level=row_levels(system))
    return DenseJacobian(at.jacobian).eliminated(pivots.order, system.acceleration_rank)


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
    return accelerations_at(Instant(system, t, q, u), formulation, gamma_shift)


def accelerations_at(
    at: Instant, formulation: AbstractFormulation, gamma_shift: Float[Array, "m"] | None = None
) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
    """The same at an instant."""
    check_mass(at.system, formulation)
    if at.system.acceleration_rows == 0:
        return at.inertia.solve(at.force), jnp.zeros(0, at.u.dtype)
    udot, multipliers, failed = solve_constrained(at, formulation, _jacobian(at, formulation), gamma_shift)
    if failed is None:
        return udot, multipliers
    return jnp.where(failed, jnp.nan, udot), jnp.where(failed, jnp.nan, multipliers)


def _jacobian(at, formulation):
    if formulation.partitions:
        return _pivoted(at)
    system = at.system
    return at.structured_jacobian.selected(system.acceleration_rank, system.velocity_scale(), row_levels(system))


class Solution(NamedTuple):
    """Accelerations u̇ and multipliers λ, and whether they `failed` to be determined; None of a system where no force
    depends on multipliers.
    """

    udot: Float[Array, "nu"]
    multipliers: Float[Array, "m"]
    failed: Bool[Array, ""] | None


def solve_constrained(
    at: Instant,
    formulation: AbstractFormulation,
    jacobian: AbstractJacobian,
    gamma_shift: Float[Array, "m"] | None = None,
) -> Solution:
    """The same as `accelerations`, from a Jacobian A that is known already.

    Where constraints are not ideal, `M u̇ = F + C + Aᵀ λ`. A force C that depends on multipliers depends on these λ, not
    on those of ideal constraints, and is solved for with them. Where it does not determine them, C is that of the
    multipliers of ideal constraints.
    """
    gamma = at.gamma if gamma_shift is None else at.gamma - gamma_shift
    if at.system.ideal:
        return Solution(*formulation.solve(at.inertia, at.force, jacobian, gamma), None)
    rows, failed, multipliers = at.system.friction_rows, None, jnp.zeros(0, at.u.dtype)
    if rows.size:
        formulation = formulation.prepared(at.inertia, jacobian)
        found, _, failed = _friction(at, formulation, jacobian, gamma)

        def residual(multipliers):
            force = at.force + at.friction_force(multipliers)
            return multipliers - unchecked_take(formulation.solve(at.inertia, force, jacobian, gamma)[1], rows)

        multipliers = root(residual, found, lambda _, found: found)
    force = at.force + at.friction_force(multipliers)
    return Solution(*formulation.solve(at.inertia, force, jacobian, gamma), failed)


def _friction(at, formulation, jacobian, gamma):
    """Multipliers of the rows that forces depend on, their coupling, and whether they are not determined; without
    derivative.
    """
    inertia, force, at = lax.stop_gradient((at.inertia, at.force, at))
    formulation, jacobian, gamma = lax.stop_gradient((formulation, jacobian, gamma))
    rows = at.system.friction_rows
    # The equations are symmetric: what a force does to a multiplier, its row does to the accelerations.
    units = jnp.asarray(np.eye(gamma.size)[rows], gamma.dtype)
    forces = jnp.concatenate([force[None], jnp.zeros((rows.size, force.size), force.dtype)])
    solve = jax.vmap(lambda force, gamma: formulation.solve(inertia, force, jacobian, gamma))
    udot, multipliers = solve(forces, jnp.concatenate([gamma[None], units]))
    start, influence = unchecked_take(multipliers[0], rows), -udot[1:]
    # Newton's method evaluates the law again and again, but only for other multipliers.
    law = with_rest_computed(at.friction_force, start)
    contacts = () if at.system.contacts is None else at.system.contacts.rows
    return find_multipliers(law, influence, start, np.isin(rows, contacts))


def friction_coupling(at: Instant, formulation: AbstractFormulation) -> Float[Array, "k k"]:
    """How much the multipliers that friction depends on change with themselves, through its force; see `friction`.
    Without derivative.
    """
    at = lax.stop_gradient(at)
    jacobian = _jacobian(at, formulation)
    return _friction(at, formulation.prepared(at.inertia, jacobian), jacobian, at.gamma)[1]
