"""The constraints and the equations of motion in a chart, where independent coordinates and velocities keep their
values.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Velocities
from ..formulations import AbstractFormulation
from ..formulations.friction import solve_coupled
from ..formulations.laws import Memory, laws_of
from ..formulations.partitioned import reduced_accelerations
from ..linalg.elimination import Factor, eliminate, positive_solver
from ..linalg.jacobian import DenseJacobian
from ..linalg.sums import unchecked_take
from ..system.instant import Instant
from .constraints import AbstractConstraints, RestoredState, implicitly
from .implied import drops_positions
from .split import AbstractSplit, Independent, restore_positions


class ConstrainedAcceleration(eqx.Module):
    """Velocities on the manifold of their coordinates, and accelerations.

    **Fields:** `u`, `udot`; the `factor` of the velocities' Jacobian; the factor of `every` row of A, None if no row
    binds accelerations only; the `memory` of the system's laws; `failed`: whether the laws failed to determine the
    accelerations; the `jacobian` of ψ if rows of Φ are watched by the factor here, else None. The factors have no
    derivatives.
    """

    u: Velocities
    udot: Float[Array, "nu"]
    factor: Factor
    every: Factor | None
    memory: Memory
    failed: Bool[Array, ""]
    jacobian: Float[Array, "velocity_rows nu"] | None


# A nested program, so that it is traced once for all its uses.
@eqx.filter_jit
def acceleration(at: Instant, formulation: AbstractFormulation, split: AbstractSplit) -> ConstrainedAcceleration:
    """Accelerations at coordinates on the manifold or near it.

    **Arguments:** `at`: an instant with exact independent velocities; the dependent ones are a guess.
    """
    out = _acceleration(*lax.stop_gradient((at, formulation, split)))
    linearise = eqx.Partial(_at_coordinates, split, out.factor, out.every)
    solution = implicitly(linearise, at, RestoredState(at.q, out.u, out.udot, out.memory))
    return dataclasses.replace(out, u=solution.u, udot=solution.udot, memory=solution.multipliers)


def _acceleration(at, formulation, split):
    system, before = at.system, at
    factor = eliminate(at.jacobian[: system.velocity_rows], split.velocity, system.velocity_rank)
    if system.linear and system.drift_free:
        at = at.with_(u=factor.null_space @ at.u[split.velocity.columns[system.velocity_rank :]])
    else:
        at = at.with_(u=at.u - factor.right_inverse @ at.velocity_residual)
    every, jacobian = None, DenseJacobian(before.jacobian, factor, factor.rows)
    if split.acceleration is not None:
        every = eliminate(at.jacobian, split.acceleration, system.acceleration_rank)
        jacobian = DenseJacobian(at.jacobian, every, every.rows)
    laws = laws_of(system)
    udot, multipliers, failed = laws.solve(at, formulation, jacobian, at.gamma)
    by_factor = drops_positions(system) and not split.ages
    rows = before.jacobian[: system.velocity_rows] if by_factor else None
    return ConstrainedAcceleration(at.u, udot, factor, every, laws.remembered(at, multipliers), failed, rows)


def _at_coordinates(split, factor, every, at):
    """The constraints of velocities and accelerations at fixed coordinates, by the factors of `acceleration`."""
    if not at.system.linear:
        # The given factors belong to other velocities, on which the Jacobian depends.
        here = chart_constraints(split, at)
        factor, every = here.factor, here.every
    factor = factor.for_matrix(at.jacobian[: at.system.velocity_rows])
    coordinates = Independent(split.velocity, split.acceleration)
    return ChartConstraints(factor, coordinates, None if every is None else every.for_matrix(at.jacobian))


def chart_constraints(split, at):
    """The constraints in a chart at an instant."""
    system, rows = at.system, at.system.velocity_rows
    factor = eliminate(at.jacobian[:rows], split.velocity, system.velocity_rank)
    every = None if split.acceleration is None else eliminate(at.jacobian, split.acceleration, system.acceleration_rank)
    return ChartConstraints(factor, split, every)


class ChartConstraints(AbstractConstraints):
    """The constraints in a chart: independent coordinates and velocities keep their values.

    **Fields:** the `factor` of the velocities' Jacobian at a state; the `split`, `Independent` for fixed coordinates;
    the factor of `every` row of A, None if no row binds accelerations only; `outdated`: whether the split's matrix is
    known to be useless.
    """

    factor: Factor
    split: AbstractSplit
    every: Factor | None = None
    outdated: Bool[Array, ""] | bool = False

    def restore(self, at, near, tol):
        q, iterations, failed = restore_positions(at, self.split, self.outdated, tol)
        # The factor is wrong by the distance of the two states: the first correction leaves its square, the second its
        # cube.
        right_inverse, at = self.factor.right_inverse, at.with_(q=q)
        at = at.with_(u=at.u - right_inverse @ at.velocity_residual)
        if not at.system.linear:
            step = right_inverse @ at.velocity_residual
            at = at.with_(u=at.u - step)
            failed = failed | ~(jnp.max(jnp.abs(step)) <= jnp.sqrt(tol) * (1.0 + jnp.max(jnp.abs(at.u))))
        # Residuals of the equations of motion, `A u̇ − γ` and `M u̇ − F − Aᵀ λ − C(λ)`. The accelerations are then
        # wrong by the square of the distance, or by the distance where a reaction with friction changes its sign.
        rows = at.acceleration_residual(near.udot)
        unbalanced = self._unbalanced(at, near)
        multipliers = self._of_accelerations.right_inverse.T @ unbalanced
        multipliers = laws_of(at.system).recalled(at, multipliers, near.multipliers)
        forces = unbalanced - at.constraint_force(multipliers)
        change, reactions = self.cancel_residuals(at, multipliers, rows, forces)
        memory = jax.tree.map(jnp.add, near.multipliers, reactions)
        return RestoredState(q, at.u, near.udot + change, memory, iterations, failed)

    def at(self, instant):
        return chart_constraints(self.split, instant)

    def multipliers(self, at, restored):
        return self._of_accelerations.right_inverse.T @ self._unbalanced(at, restored)

    def _unbalanced(self, at, solution):
        """`M u̇ − F − C`, the forces that ideal constraints must balance, from the memory of the laws."""
        return at.inertia.product(solution.udot) - laws_of(at.system).applied(at, solution.multipliers)

    def push_positions(self, at, along):
        return self.split.push(at, along, self.factor)

    def cancel_velocities(self, residual):
        return -(self.factor.right_inverse @ residual)

    @property
    def _of_accelerations(self) -> Factor:
        return self.factor if self.every is None else self.every

    def _cancelling(self, inertia):
        """`(rows, forces) -> change`, the function of `cancel_residuals` without C."""
        factor = self._of_accelerations
        solve = positive_solver(factor.null_space.T @ inertia.product(factor.null_space))

        def cancel(rows, forces):
            return reduced_accelerations(inertia, -forces, factor, -rows, solve)

        return cancel

    def balance(self, at, rows, forces):
        change = self._cancelling(at.inertia)(rows, forces)
        return change, self._of_accelerations.right_inverse.T @ (at.inertia.product(change) + forces)

    def cancel_residuals(self, at, multipliers, rows, forces):
        inertia, places = at.inertia, at.system.friction_rows
        cancel = self._cancelling(inertia)
        change = cancel(rows, forces)
        if places.size == 0:
            return change, None
        # Friction responds to a change of the multipliers that it depends on, and so changes them again.
        frictions = laws_of(at.system).slopes(at, multipliers)
        responses = jax.vmap(lambda force: cancel(jnp.zeros_like(rows), -force))(frictions)
        balance = unchecked_take(self._of_accelerations.right_inverse.T, places)
        reaction = lambda change, forces: jnp.sum(balance * (inertia.product(change) + forces)[None], axis=1)
        coupling = jax.vmap(reaction, out_axes=1)(responses, -frictions)
        answer = solve_coupled(jnp.eye(places.size, dtype=rows.dtype) - coupling, reaction(change, forces))
        return change + answer @ responses, answer
