"""Long chains of joints: every coordinate is integrated, and every step returned to the constraints joint by joint."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import State
from ..formulations import BlockMultipliers
from ..formulations.formulation import check_independent
from ..solvers import AbstractManifoldTerm, AbstractMultistep, ManifoldEvaluation
from ..system import AbstractSystem
from ..system.chain import chain_of
from ..system.corrector import corrector
from .manifold import AbstractManifold, newton_tolerance
from .nearest import nearest
from .projection import ProjectedSolver, project_normalized
from .vector_field import VectorField


class BlockProjection(AbstractManifold):
    """Projection in the metric of the mass matrix, for scenes whose joints form a chain: with n joints a step costs
    O(n) time and memory.

    All coordinates and velocities are integrated; at the end of every step of `Adams` positions and velocities are
    projected on the constraints, and the accelerations found there, with one block-tridiagonal factor for the three.
    Other solvers than `Adams` are those of `Projection`. `Hermite` needs independent coordinates, which a chain of
    joints does not single out.

    **Arguments:** `newton_tol`: size of the last Newton correction of positions relative to the system's size, default
    tied to the tolerance of integration; one more correction is made with the factor of the state it led to.
    """

    newton_tol: float | None = eqx.field(static=True, default=None)

    def prepare(self, system, formulation, solver, rtol):
        chain_of(system)
        check_independent(system)
        if not isinstance(formulation, BlockMultipliers):
            raise ValueError(
                f"BlockProjection goes with BlockMultipliers(), got {type(formulation).__name__}(); leave the "
                "formulation out."
            )
        if not system.linear:
            raise ValueError(
                "BlockProjection takes constraints that are linear in velocities; use Partition() or Projection()."
            )
        if not isinstance(solver, AbstractMultistep):
            return diffrax.ODETerm(VectorField(system, formulation)), ProjectedSolver(solver, system)
        if solver.solves_implicitly:
            raise ValueError(
                f"BlockProjection needs Adams or a Runge–Kutta solver, got {type(solver).__name__}; use Partition() "
                "with it."
            )
        return BlockTerm(system, formulation, newton_tolerance(self.newton_tol, rtol)), solver

    def default_formulation(self, system):
        return BlockMultipliers()

    def correction(self, interpolated):
        return project_normalized if interpolated else None

    def statistics(self, solver_state):
        return {}

    def diagnose(self, system, t, y, solver_state, result, failed):
        return result


class BlockTerm(AbstractManifoldTerm):
    """A chain of bodies as a term that knows its constraints. Its chart is the number of Newton iterations so far."""

    system: AbstractSystem
    formulation: BlockMultipliers
    newton_tol: Float[Array, ""]

    def vf(self, t, y, args):
        return VectorField(self.system, self.formulation)(t, y, args)

    def init_chart(self, t, y, args):
        return jnp.array(0)

    def evaluate(self, t, y, chart, args):
        y = State(self.system.normalize(y.q), y.u)
        near = corrector(self.system, t, y, self.system.inertia(t, y.q, y.u))
        f = State(self.system.rates(t, y.q, y.u), _accelerations(self.system, t, y, near))
        return ManifoldEvaluation(y, f, chart, jnp.array(False), near)

    def restore(self, t, y, near, args):
        metric = self.system.inertia(t, y.q, y.u)
        y, here, iterations, failed = nearest(self.system, t, y, metric, near.factors, self.newton_tol)
        f = State(self.system.rates(t, y.q, y.u), _accelerations(self.system, t, y, here))
        return ManifoldEvaluation(y, f, near.chart + iterations, failed, None)

    def controlled(self, chart):
        return State(jnp.ones(self.system.nq, bool), jnp.ones(self.system.nu, bool))

    def free(self, chart):
        return jnp.arange(self.system.nq + self.system.nu)

    def update_chart(self, t, y, chart, args):
        return chart


def _accelerations(system, t, y, corrector):
    """Accelerations at a state, with the factor that is there."""
    free = corrector.metric.solve(system.force(t, y.q, y.u))
    return free + corrector.remove(system.acceleration_residual(t, y.q, y.u, free))
