"""The laws of constraint forces: ideal forces, and further forces C that may depend on the multipliers.

    M u̇ = F + C(λ) + Aᵀ λ,    A u̇ = γ

The memory of a law contains the multipliers that C depends on, of the `friction_rows`; None if there are none.
"""

import abc
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._compat import with_rest_computed
from .._types import Coordinates, Scalar, Velocities
from ..linalg.jacobian import AbstractJacobian
from ..linalg.newton import root
from ..linalg.sums import unchecked_take, with_entries
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .formulation import AbstractFormulation, check_mass, suitable_jacobian
from .friction import contracts, find_multipliers, solve_coupled

Memory: TypeAlias = Float[Array, "k"] | None


class Solution(NamedTuple):
    """Accelerations u̇ and multipliers λ; `failed`: whether they are undetermined."""

    udot: Float[Array, "nu"]
    multipliers: Float[Array, "m"]
    failed: Bool[Array, ""]


class AbstractLaws(eqx.Module):
    """The laws of a system's constraint forces; see `laws_of`."""

    @abc.abstractmethod
    def applied(self, at: Instant, memory: Memory) -> Float[Array, "nu"]:
        """`F + C`."""

    def solve(
        self, at: Instant, formulation: AbstractFormulation, jacobian: AbstractJacobian, gamma: Float[Array, "m"]
    ) -> Solution:
        """Accelerations and multipliers, from the Jacobian A and γ."""
        solved = formulation.solve(at.inertia, self.applied(at, None), jacobian, gamma)
        return Solution(*solved, jnp.array(False))

    def slopes(self, at: Instant, multipliers: Float[Array, "m"]) -> Float[Array, "k nu"]:
        """The derivatives of C by the multipliers that it depends on."""
        return jnp.zeros((0, at.u.size), multipliers.dtype)

    def coupling(self, at: Instant, formulation: AbstractFormulation) -> Float[Array, "k k"]:
        """The influence of C on the multipliers that it depends on, see `friction`; without derivative."""
        return jnp.zeros((0, 0), at.u.dtype)

    def remembered(self, at: Instant, multipliers: Float[Array, "m"]) -> Memory:
        """The memory, from all multipliers."""
        del at, multipliers
        return None

    def recalled(self, at: Instant, multipliers: Float[Array, "m"], memory: Memory) -> Float[Array, "m"]:
        """All multipliers, with the memory inserted."""
        del at, memory
        return multipliers


class IdealLaws(AbstractLaws):
    """C is zero."""

    def applied(self, at, memory):
        return at.force


class GivenLaws(AbstractLaws):
    """C does not depend on multipliers, such as viscous friction."""

    def applied(self, at, memory):
        return at.force + at.friction_force(at.u[:0])


class ReactiveLaws(AbstractLaws):
    """C depends on multipliers and changes them, so both are solved for together. If the multipliers are undetermined,
    C uses the multipliers of ideal constraints.
    """

    def applied(self, at, memory: Any):
        return at.force + at.friction_force(memory)

    def solve(self, at, formulation, jacobian, gamma):
        formulation = formulation.prepared(at.inertia, jacobian)
        start, _, failed = _friction(at, formulation, jacobian, gamma)

        def solved(memory):
            return formulation.solve(at.inertia, self.applied(at, memory), jacobian, gamma)

        memory = root(lambda memory: memory - self.remembered(at, solved(memory)[1]), start, lambda _, start: start)
        return Solution(*solved(memory), failed)

    def slopes(self, at, multipliers):
        return jax.jacfwd(at.friction_force)(self.remembered(at, multipliers)).T

    def coupling(self, at, formulation):
        at = lax.stop_gradient(at)
        jacobian = suitable_jacobian(at, formulation)
        return _friction(at, formulation.prepared(at.inertia, jacobian), jacobian, at.gamma)[1]

    def remembered(self, at, multipliers):
        return unchecked_take(multipliers, at.system.friction_rows)

    def recalled(self, at, multipliers, memory: Any):
        return with_entries(multipliers, at.system.friction_rows, memory)


class LinearLaws(ReactiveLaws):
    """C is linear in the multipliers, such as friction in contacts with known directions of slip: unit multipliers give
    the columns of one linear system.
    """

    def applied(self, at, memory: Any):
        return at.force + memory @ at.friction_matrix

    def solve(self, at, formulation, jacobian, gamma):
        udot, multipliers, influence = self._by_unit(at, formulation, jacobian, gamma)
        start = self.remembered(at, multipliers[0])
        failed = ~contracts(self._coupled(at, influence))
        memory = jnp.where(failed, start, solve_coupled(jnp.eye(start.size, dtype=start.dtype) - influence, start))
        return Solution(udot[0] + memory @ udot[1:], multipliers[0] + memory @ multipliers[1:], failed)

    def slopes(self, at, multipliers):
        return at.friction_matrix

    def coupling(self, at, formulation):
        at = lax.stop_gradient(at)
        *_, influence = self._by_unit(at, formulation, suitable_jacobian(at, formulation), at.gamma)
        return self._coupled(at, influence)

    def _by_unit(self, at, formulation, jacobian, gamma):
        """Accelerations and multipliers without C, then those that unit multipliers in C add; and the additions to the
        multipliers that C depends on.
        """
        formulation = formulation.prepared(at.inertia, jacobian)
        forces = jnp.concatenate([at.force[None], at.friction_matrix])
        asked = jnp.concatenate([gamma[None], jnp.zeros((len(forces) - 1, gamma.size), gamma.dtype)])
        solve = jax.vmap(lambda force, gamma: formulation.solve(at.inertia, force, jacobian, gamma))
        udot, multipliers = solve(forces, asked)
        return udot, multipliers, unchecked_take(multipliers[1:].T, at.system.friction_rows)

    def _coupled(self, at, influence):
        return lax.stop_gradient(jnp.where(np.diag(_pushes(at.system)), influence, jnp.abs(influence)))


# The laws, made once.
_IDEAL, _GIVEN, _REACTIVE, _LINEAR = IdealLaws(), GivenLaws(), ReactiveLaws(), LinearLaws()


def laws_of(system: AbstractEquation) -> AbstractLaws:
    """The laws of a system's constraint forces."""
    if system.ideal:
        return _IDEAL
    if not system.friction_rows.size:
        return _GIVEN
    return _LINEAR if system.ideal_without_friction and not system.contacts.of_reactions else _REACTIVE


def accelerations(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Coordinates,
    u: Velocities,
    gamma_shift: Float[Array, "m"] | None = None,
) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
    """Accelerations u̇ and multipliers λ of a system at a state on its constraints; with a `gamma_shift`, for `A u̇ = γ
    − gamma_shift`. NaN where friction does not determine them.

    ```python
    method = jaxmb.formulations.Multipliers()
    udot, multipliers = jaxmb.formulations.accelerations(system, method, 0.0, state.q, state.u)
    ```

    **Raises:** `ValueError` for a formulation that needs the inverse of a singular mass matrix.
    """
    return accelerations_at(Instant(system, t, q, u), formulation, 0.0 if gamma_shift is None else gamma_shift)


def accelerations_at(
    at: Instant, formulation: AbstractFormulation, gamma_shift: Float[Array, "m"] | float = 0.0
) -> tuple[Float[Array, "nu"], Float[Array, "m"]]:
    """`accelerations` at an instant."""
    check_mass(at.system, formulation)
    if at.system.acceleration_rows == 0:
        return at.inertia.solve(at.force), jnp.zeros(0, at.u.dtype)
    jacobian = suitable_jacobian(at, formulation)
    udot, multipliers, failed = laws_of(at.system).solve(at, formulation, jacobian, at.gamma - gamma_shift)
    return jnp.where(failed, jnp.nan, udot), jnp.where(failed, jnp.nan, multipliers)


def _friction(at, formulation, jacobian, gamma):
    """Multipliers that forces depend on, their coupling, and whether they are undetermined; without derivative."""
    inertia, force, at = lax.stop_gradient((at.inertia, at.force, at))
    formulation, jacobian, gamma = lax.stop_gradient((formulation, jacobian, gamma))
    rows = at.system.friction_rows
    # The equations are symmetric: the influence of a force on a multiplier is the influence of its row on the
    # accelerations.
    units = jnp.asarray(np.eye(gamma.size)[rows], gamma.dtype)
    forces = jnp.concatenate([force[None], jnp.zeros((rows.size, force.size), force.dtype)])
    solve = jax.vmap(lambda force, gamma: formulation.solve(inertia, force, jacobian, gamma))
    udot, multipliers = solve(forces, jnp.concatenate([gamma[None], units]))
    start, influence = unchecked_take(multipliers[0], rows), -udot[1:]
    # Newton's method evaluates the law several times, but only for other multipliers.
    law = with_rest_computed(at.friction_force, start)
    return find_multipliers(law, influence, start, _pushes(at.system))


def _pushes(system):
    """Which multipliers of the `friction_rows` cannot change their sign, those of contacts."""
    return np.isin(system.friction_rows, system.contacts.rows[: system.contacts.n])
