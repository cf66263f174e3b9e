"""Integration of all coordinates, with a projection on the constraints after every step."""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from .._types import Scalar
from ..contacts.guards import ContactGuards, contact_guards
from ..formulations import AbstractFormulation
from ..formulations.formulation import check_mass
from ..formulations.laws import laws_of
from ..formulations.multipliers import FactoredMultipliers
from ..linalg.jacobian import MassProjector
from ..solvers import AbstractMultistep, AbstractMultistepState
from ..solvers.directed import direction_of, inner_term
from ..solvers.events import cond_of_jumps, crossing, map_error
from ..solvers.manifold_term import ManifoldEvaluation
from ..solvers.wrapped import AbstractSolverAround
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .accuracy import Accuracy
from .constraints import SolvedState, restore
from .diagnosis import NOT_PROJECTED, diagnose, diagnose_newton
from .implied import check_watched, drops_rows, violated
from .impulse import after_jump
from .manifold import AbstractManifold, VectorField, normalize_state
from .orthogonal_projection import (
    ProjectorConstraints,
    project_in_metric,
    project_normalized,
    projected,
    projector_constraints,
)
from .term import AbstractConstrainedTerm

# The result of an accepted step that violates redundant rows, until the simulation is diagnosed.
_FAILED: Any = diffrax.RESULTS.nonlinear_divergence
# The size of omitted corrections, as a power of eps: 1e-12 in double precision.
_LEFT_OUT = 0.77


class Projection(AbstractManifold):
    """Integrate all coordinates and velocities with any diffrax Runge–Kutta solver, with `Adams` or with `Hermite`, and
    project every step on the constraints.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, manifold=jaxmb.manifold.Projection())
    ```

    With a Runge–Kutta solver the projection is the smallest change in the coordinates' scales, first of the
    configuration, then of the velocities. A first-same-as-last derivative is kept across the projection, which changes
    it by the size of the local error.

    With `Adams` the projection is the smallest change in the metric of the mass matrix. One factor of `A M⁻¹ Aᵀ` for
    each step, at its prediction, serves positions, velocities and accelerations. The elimination follows the graph of
    joints: for chains, trees and local loops a step takes time and memory in proportion to the number of joints.
    Constraints must be linear in velocities. If some are not ideal or act on accelerations, each evaluation needs its
    own factor. Servos need a second factor; friction needs a solution for each row of the joints with friction,
    and a full matrix of the size of all these rows. In a scene large enough for sparse elimination implied rows are
    omitted, the same ones throughout a motion; in smaller scenes no row may be redundant.

    With `Hermite` the same projection is applied to every iterate of Newton's method; constraints must be ideal and
    bind positions or velocities. The matrix of a scene has blocks for bodies that share a force or a joint. It is
    eliminated along with the joints in an order that follows from their graph. For trains, cables, trees and local
    loops a step takes time in proportion to the number of bodies. The eigenvalues near the inverse of the step decide
    which formulas and steps are stable; only these are computed. Newton's matrix omits the change of the directions of
    joints and forces in a step. So there are up to 40 % more iterations than with `Partition`. Derivatives follow from
    the exact equations.

    **Arguments:** `newton_tol`: with `Adams` and `Hermite`, the size of omitted Newton corrections of positions,
    velocities and accelerations, relative to the system's; default the smaller of 1e-12 and a thousandth of the
    tolerance of integration.
    """

    newton_tol: float | None = eqx.field(static=True, default=None)  # pyright: ignore[reportIncompatibleVariableOverride]
    restores: ClassVar[bool] = True

    def accuracy(self, rtol):
        return Accuracy.of(rtol, self.newton_tol, float(jnp.finfo(jnp.result_type(float)).eps) ** _LEFT_OUT)

    def prepare(self, system, formulation, solver, accuracy):
        check_mass(system, formulation)
        if not isinstance(solver, AbstractMultistep):
            guards = contact_guards(system, formulation, accuracy.at_contacts)
            solver = ProjectedSolver(solver, guards, accuracy.rtol)
            return diffrax.ODETerm(VectorField(system, formulation)), solver
        _check_multistep(system, formulation, type(solver).__name__)
        if solver.solves_implicitly and not system.has_field_jacobian:
            raise ValueError(
                f"Projection with {type(solver).__name__} needs a scene of bodies, whose graph orders its equations, "
                "without internal states; use Partition()."
            )
        if solver.solves_implicitly and not system.ideal_on_velocities:
            raise ValueError(
                f"Projection with {type(solver).__name__} takes constraints that are ideal and bind positions or "
                "velocities; use Partition()."
            )
        term = ProjectionTerm if system.velocity_rows else NormalisedTerm
        return term(system, formulation, accuracy), solver

    def correction(self, interpolated):
        return _returned if interpolated else None

    def statistics(self, solver_state):
        # The states of Runge–Kutta methods have no charts.
        chart: Any = solver_state.chart if isinstance(solver_state, AbstractMultistepState) else None
        return {} if chart is None else {"newton_iterations": chart}

    def violated(self, system, t, y, accuracy):
        return violated(Instant.of(system, t, y), accuracy.rtol)

    def diagnose(self, system, t, y, evidence, result, failed, accuracy):
        if system.elimination is None:
            return diagnose(Instant.of(system, t, y), jnp.array(False), result, failed)
        # The rank of constraints that are eliminated along the graph of joints is not examined.
        return diagnose_newton(result, failed) if system.velocity_rows else result


def _inertia(at):
    return at.inertia


def _returned(system, t, y):
    """An interpolated state, returned to the constraints."""
    return project_normalized(system, t, y) if system.velocity_rows else normalize_state(system, t, y)


def _check_multistep(system, formulation, solver):
    """Refuse systems and formulations for which one factor of `A M⁻¹ Aᵀ` does not suffice."""
    if not system.positive_definite_mass:
        raise ValueError(
            f"Projection with {solver} needs the inverse of the mass matrix, which is singular in these velocities; "
            "use Partition()."
        )
    if not formulation.takes_blocks:
        raise ValueError(
            f"Projection with {solver} finds accelerations by Multipliers(), got {type(formulation).__name__}(); leave "
            "the formulation out, or use Partition()."
        )
    check_watched(system, f"Projection with {solver}")
    if system.elimination is None and drops_rows(system):
        raise ValueError(
            f"Of {system.acceleration_rows} constraint rows only {system.acceleration_rank} are independent, and "
            f"Projection with {solver} drops none; use Partition()."
        )
    if not system.linear:
        raise ValueError(f"Projection with {solver} takes constraints that are linear in velocities; use Partition().")


class AbstractProjectionTerm(AbstractConstrainedTerm):
    """A system whose states are projected. Its chart is the number of Newton iterations so far."""

    def init_chart(self, t, y, args):
        return jnp.array(0)

    def jacobian(self, t, y, args):
        return self.system.field_jacobian(t, y)

    def free(self, chart):
        return None

    def update_chart(self, t, y, chart, args):
        return chart


class ProjectionTerm(AbstractProjectionTerm):
    """A constrained system, projected in the metric of the mass matrix."""

    system: AbstractEquation
    formulation: AbstractFormulation
    accuracy: Accuracy

    def evaluate(self, t, y, chart, args):
        at = self.at(t, y).normalized()
        return self._solved(at, at.binding_velocities.projector(at.inertia), 0, False, chart)

    def project_near(self, t, y, linearized_at, args):
        at, near, chart = self.at(t, y), linearized_at.factors, linearized_at.chart
        if not self.system.ideal_on_velocities:
            projection = project_in_metric(at, _inertia, near.constraints.projector, self.accuracy.newton)
            return self._solved(*projection, chart)
        out: Any = restore(at, near, self.accuracy.newton)
        return self.evaluated(at.with_(q=out.q, u=out.u), out.udot, chart + out.iterations, out.failed)

    def project_cold(self, t, y, chart, args):
        # The guess may be far from the constraints: accelerations need a factor at the projected state.
        return self._solved(*project_in_metric(self.at(t, y), _inertia, None, self.accuracy.newton), chart)

    def _solved(self, at, projector: MassProjector, iterations, failed, chart):
        """The evaluation at a state on the constraints with a known projector."""
        near = ProjectorConstraints(at.q, projector)
        if self.system.acceleration_rows > self.system.velocity_rows:
            projector = at.structured_jacobian.projector(projector.metric)
        laws, method = laws_of(self.system), FactoredMultipliers(projector)
        udot, multipliers, undetermined = laws.solve(at, method, projector.jacobian, at.gamma)
        near = SolvedState(near, udot, multipliers)
        return self.evaluated(at, udot, chart + iterations, failed | undetermined, near)

    def linearisation(self, kept):
        return (projector_constraints, None) if self.system.ideal_on_velocities else None


class NormalisedTerm(AbstractProjectionTerm):
    """A system whose rows, if any, bind accelerations only: its coordinates are normalised."""

    system: AbstractEquation
    formulation: AbstractFormulation
    accuracy: Accuracy

    def evaluate(self, t, y, chart, args):
        at = self.at(t, y).normalized()
        return ManifoldEvaluation(at.state, self.vf(t, at.state, args), chart, jnp.array(False))

    def project_near(self, t, y, linearized_at, args):
        return self.evaluate(t, y, linearized_at.chart, args)

    def project_cold(self, t, y, chart, args):
        return self.evaluate(t, y, chart, args)

    def linearisation(self, kept):
        return None


class ProjectedSolver(AbstractSolverAround):
    """A Runge–Kutta solver whose steps end with a projection on the constraints of the term's system, or at events of
    contacts.

    **Fields:** the `guards` of the contacts, None without any; `rtol`: the tolerance of integration.
    """

    guards: ContactGuards | None
    rtol: Scalar

    # A nested program, so that the step is traced once.
    @eqx.filter_jit
    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        system, direction = inner_term(terms).vector_field.system, direction_of(terms)
        before = y0
        if made_jump is not False:
            after = lambda y: after_jump(system, self.guards, t0 * direction, y)
            y0 = cond_of_jumps(self.guards)(made_jump, after, lambda y: y, y0)
        first, last = t0, t1
        y1, error, dense_info, solver_state, result = self.solver.step(terms, t0, t1, y0, args, solver_state, made_jump)
        t1 = t1 * direction
        y1, failed = projected(system, t1, y1)
        # A step without a projected end has an infinite error. If no error estimate shortens it, the run ends there.
        unknown = lambda x: jnp.where(failed, jnp.nan, x) if eqx.is_inexact_array(x) else x
        y1, dense_info = jax.tree.map(unknown, (y1, dense_info))
        error = jax.tree.map(lambda x: jnp.where(failed, jnp.inf, x), error)
        result = diffrax.RESULTS.where(failed, NOT_PROJECTED, result)
        wrong = violated(Instant.of(system, t1, y1), self.rtol)
        if wrong is not False:
            # diffrax discards the result of a rejected step.
            result = diffrax.RESULTS.where(wrong, _FAILED, result)
        if self.guards is not None:
            at = self.interpolation_cls(t0=first, t1=last, **dense_info).evaluate
            error = crossing(self.guards, direction, error, (first, last), (before, y0, y1), at, made_jump)
            # No step goes to where guards are not numbers, as beyond the edge of a terrain.
            off = jnp.isnan(error.lowest)
            error = map_error(lambda of_step: jax.tree.map(lambda x: jnp.where(off, jnp.inf, x), of_step), error)
            result = diffrax.RESULTS.where(off, NOT_PROJECTED, result)
        return y1, error, dense_info, solver_state, result
