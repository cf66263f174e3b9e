"""Generalized coordinate partitioning: integrate the independent coordinates and velocities, solve for the rest.

Sources: R. A. Wehage and E. J. Haug, J. Mech. Design 104(1), 1982; P. E. Nikravesh and I. S. Chung, J. Mech. Design
104(4), 1982; P. E. Nikravesh and E. J. Haug, J. Mech. Transm. Autom. Des. 105(3), 1983 (nonholonomic).
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._compat import cond_of_any_lane
from .._results import RESULTS
from .._types import State
from ..formulations import AbstractFormulation, Partitioned
from ..formulations.formulation import check_mass, row_levels
from ..linalg.elimination import eliminate, full_pivot
from ..solvers import AbstractManifoldTerm, AbstractMultistep, ManifoldEvaluation
from ..system import AbstractEquation
from ..system.residuals import drops_rows, row_sizes, violation_of_dropped_rows
from .chart import (
    ChartConstraints,
    ChartIndices,
    coordinate_factor,
    correct_positions,
    general_acceleration,
    ideal_acceleration,
    restore_positions,
    shares_split,
)
from .constraints import SolvedState, restore
from .diagnosis import diagnose
from .impulse import after_impulse
from .manifold import AbstractManifold, VectorField, newton_tolerance
from .orthogonal_projection import project_normalized

# A stored position factor is refreshed after this many steps, or when Newton's method takes this many iterations.
_AGE = 4
_SLOW = 3
# A chart is replaced when its influence matrix has grown by this factor. (A pendulum at rtol 1e-10, error after ten
# seconds: 1e-7 with 4, 1e-8 with 2 and 4e-9 with 1.1, at 664, 628 and 623 steps. A chain of ten rods makes 19 charts
# in 1200 steps.)
_GROWTH = 1.1
# The same for the solution of the rows that were kept. Where others are redundant, the kept ones can lose rank at a
# position where all of them do not, and H shows nothing of it.
_ROW_GROWTH = 4.0
# Redundant rows may be violated by this multiple of Newton's tolerance, or of the pivots that count as zero.
_ALLOWED = 8.0


class Partition(AbstractManifold):
    """Coordinate partitioning with charts chosen by full pivoting.

    There are `nq − rank Φ_q` independent coordinates and `nu − rank [Φ; ψ]` independent velocities; with nonholonomic
    constraints these are two nested charts. Only independent components are integrated; the others satisfy the
    constraints to Newton's tolerance at the end of every step. The error of a step is measured on all of them. A chart
    is replaced when its influence matrix H has grown by the factor `max_influence`, or when redundant rows would serve
    better than those it keeps; the solver's history is that of all components, so a new chart costs no restart.

    The formulation finds the accelerations of predicted states; those of corrected states follow by one step of
    Newton's method with the same factor.

    **Arguments:** `max_influence`: bound on `max |H|` (scaled), relative to 1 or to its value when the chart was made,
    whichever is larger: errors of the independent components reach the dependent ones multiplied by H and its
    rates; `newton_tol`: size of the last Newton correction relative to the system's size, default tied to the
    tolerance of integration.
    """

    max_influence: float = eqx.field(static=True, default=_GROWTH)
    newton_tol: float | None = eqx.field(static=True, default=None)
    restores: ClassVar[bool] = True
    uses_charts: ClassVar[bool] = True

    def __check_init__(self):
        if not self.max_influence > 1:
            raise ValueError(f"Partition: max_influence must be above 1, got {self.max_influence}.")

    def prepare(self, system, formulation, solver, rtol):
        if not isinstance(solver, AbstractMultistep):
            raise ValueError(
                f"Partition needs a solver that knows charts (Adams or Hermite), got {type(solver).__name__}; use "
                "manifold=Projection() with it."
            )
        check_mass(system, formulation)
        return PartitionTerm(system, formulation, self.max_influence, newton_tolerance(self.newton_tol, rtol)), solver

    def default_formulation(self, system):
        return Partitioned()

    def correction(self, interpolated):
        return project_normalized if interpolated else None

    def statistics(self, solver_state):
        return {"newton_iterations": solver_state.chart.newton, "charts": solver_state.chart.charts}

    def diagnose(self, system, t, y, solver_state, result, failed):
        chart = solver_state.chart
        result = diagnose(system, t, y, chart.singular, result, failed)
        if chart.redundant is None:
            return result
        # Steps were refused until they led up to the violation that is allowed.
        violated = failed & (chart.redundant.violation > 0.5)
        return RESULTS.where(violated, RESULTS.inconsistent_constraints, result)


class RedundantRows(eqx.Module):
    """The `sizes` of the rows of ψ, and the `violation` of redundant ones at the state of a chart relative to what is
    allowed.
    """

    sizes: Float[Array, "velocity_rows"]
    violation: Float[Array, ""]


class Chart(eqx.Module):
    """The index sets with their quality and counters.

    **Fields:** `split`; `quality` at the last evaluation and at the `fresh` chart: largest scaled |H| and, with
    redundant rows, largest entry of the solution of the kept ones; `counters`: see the properties; `redundant`: None
    where all rows are independent.
    """

    split: ChartIndices
    quality: Float[Array, "k"]
    fresh: Float[Array, "k"]
    counters: Int[Array, "5"]
    redundant: RedundantRows | None = None

    @property
    def age(self) -> Int[Array, ""]:
        """Steps since the position factor was refreshed."""
        return self.counters[0]

    @property
    def iterations(self) -> Int[Array, ""]:
        """Newton iterations for positions in the last step."""
        return self.counters[1]

    @property
    def newton(self) -> Int[Array, ""]:
        """Newton iterations for positions in all steps."""
        return self.counters[2]

    @property
    def charts(self) -> Int[Array, ""]:
        """Charts made."""
        return self.counters[3]

    @property
    def singular(self) -> Bool[Array, ""]:
        """Whether the rank has fallen."""
        return self.counters[4] > 0


class PartitionTerm(AbstractManifoldTerm):
    """A constrained system as a term with charts."""

    system: AbstractEquation
    formulation: AbstractFormulation
    max_influence: float = eqx.field(static=True)
    newton_tol: Float[Array, ""]

    def vf(self, t, y, args):
        return VectorField(self.system, self.formulation)(t, y, args)

    def init_chart(self, t, y, args):
        system, y = lax.stop_gradient((self.system, y))
        split, fresh, singular = _choose(system, t, y, _of_coordinates(system, t, y))
        redundant = None
        if drops_rows(system):
            sizes = row_sizes(system, t, y)
            redundant = RedundantRows(sizes, _violation(system, t, y, sizes, self.newton_tol))
        return Chart(split, fresh, fresh, jnp.stack([0, 0, 0, 1, singular.astype(int)]), redundant)

    def evaluate(self, t, y, chart, args):
        q = correct_positions(self.system, t, y.q, lax.stop_gradient(chart.split))
        return self._evaluate(t, q, y.u, chart)

    def _evaluate(self, t, q, u, chart):
        system, split, quality, failed = self.system, chart.split, chart.quality, None
        if system.acceleration_rows == 0:
            udot, factors = system.inertia(t, q, u).solve(system.force(t, q, u)), None
        else:
            if system.ideal_on_velocities:
                out = ideal_acceleration(system, self.formulation, t, q, u, split.velocity)
            else:
                out = general_acceleration(system, self.formulation, t, q, u, split)
                failed = out.failed
            u, udot, factors = out.u, out.udot, out.factor
            quality = _velocity_quality(system, factors, split.velocity)
            if split.coordinate is None:
                split = ChartIndices(split.velocity, split.acceleration, None, factors.right_inverse)
        chart = Chart(split, quality, chart.fresh, chart.counters, chart.redundant)
        f = State(system.rates(t, q, u), udot)
        failed = chart.singular if failed is None else chart.singular | failed
        return ManifoldEvaluation(State(q, u), f, chart, failed, factors)

    def project_near(self, t, y, linearized_at, args):
        system, chart = self.system, linearized_at.chart
        if system.acceleration_rows == 0 or not system.ideal_on_velocities:
            return self._project(t, y, chart, chart.split)
        constraints = ChartConstraints(linearized_at.factors, chart.split)
        near = SolvedState(constraints, lax.stop_gradient(linearized_at.f.u), None)
        out: Any = restore(system, t, y, near, self.newton_tol)
        f = State(system.rates(t, out.q, out.u), out.udot)
        chart, failed = _counted(chart, out.iterations), out.failed | chart.singular
        return ManifoldEvaluation(State(out.q, out.u), f, chart, failed, None)

    def project_cold(self, t, y, chart, args):
        if not (self.system.ideal_on_velocities and self.system.linear):
            return super().project_cold(t, y, chart, args)
        split = chart.split
        if split.coordinate is None:
            # The chart's matrix is that of the state before the step.
            system, at, q = lax.stop_gradient((self.system, t, y.q))
            split = eqx.tree_at(lambda s: s.right_inverse, split, coordinate_factor(system, at, q, split).right_inverse)
        return self._project(t, y, chart, split)

    def _project(self, t, y, chart, split):
        """Restore positions with the matrix of a split, then evaluate there."""
        q, iterations, failed = restore_positions(self.system, t, y.q, split, self.newton_tol)
        out = self._evaluate(t, q, y.u, _counted(chart, iterations))
        return out._replace(failed=failed | out.failed)

    def after_jump(self, t, y, args):
        return after_impulse(self.system, t, y)

    def controlled(self, chart):
        # All components: where dependent ones change fast, the error of the independent ones alone shows it too late.
        # (A four-bar at error 1e-6: 2949 evaluations and no rejected step, against 3461 and 122; a spatial
        # slider-crank 3107 against 3867.)
        del chart
        return State(jnp.ones(self.system.nq, bool), jnp.ones(self.system.nu, bool))

    def free(self, chart):
        system, velocity = self.system, chart.split.velocity
        coordinate = velocity if chart.split.coordinate is None else chart.split.coordinate
        independent = coordinate.columns[system.coordinate_rank :]
        return jnp.concatenate([independent, system.nq + velocity.columns[system.velocity_rank :]])

    def update_chart(self, t, y, chart, args):
        del args
        chart = _updated(*lax.stop_gradient((self.system, t, y, chart)), self.max_influence)
        if chart.redundant is None:
            return chart
        violation = _violation(*lax.stop_gradient((self.system, t, y, chart.redundant.sizes, self.newton_tol)))
        return eqx.tree_at(lambda chart: chart.redundant.violation, chart, violation)

    def refuses(self, chart):
        return False if chart.redundant is None else chart.redundant.violation > 1


def _counted(chart, iterations):
    """The chart after a Newton iteration for positions."""
    age, _, newton, charts, singular = chart.counters
    counters = jnp.stack([age, iterations, newton + iterations, charts, singular])
    return Chart(chart.split, chart.quality, chart.fresh, counters, chart.redundant)


@eqx.filter_jit
def _updated(system, t, y, chart, max_influence):
    """The chart, refreshed or chosen anew where it has become worse."""
    bounds = np.array([max_influence, _ROW_GROWTH])[: chart.fresh.size]
    worse = lambda chart: jnp.any(chart.quality > bounds * chart.fresh)

    def renewed(chart, jacobian):
        def renew(chart):
            split, fresh, singular = _choose(system, t, y, jacobian)
            counters = chart.counters + jnp.array([0, 0, 0, 1, 0]) + jnp.array([0, 0, 0, 0, 1]) * singular.astype(int)
            return Chart(split, fresh, fresh, counters, chart.redundant)

        return cond_of_any_lane(worse(chart), renew, lambda chart: chart, chart)

    if chart.split.coordinate is None or system.coordinate_rank == 0:
        return renewed(chart, _of_coordinates(system, t, y))
    stale = worse(chart) | (chart.age >= _AGE) | (chart.iterations >= _SLOW)

    def refresh(chart):
        jacobian = _of_coordinates(system, t, y)
        split, own = _refreshed(system, jacobian, chart.split)
        quality = jnp.maximum(chart.quality, own)
        # Only a chart that has been refreshed can be worse.
        refreshed = Chart(split, quality, chart.fresh, chart.counters.at[0].set(0), chart.redundant)
        return renewed(refreshed, jacobian)

    def keep(chart):
        return Chart(chart.split, chart.quality, chart.fresh, chart.counters.at[0].add(1), chart.redundant)

    return cond_of_any_lane(stale, refresh, keep, chart)


@eqx.filter_jit
def _violation(system, t, y, sizes, newton_tol):
    """The violation of redundant rows relative to what the solution of the others may leave."""
    allowed = _ALLOWED * jnp.maximum(newton_tol, jnp.finfo(y.q.dtype).eps ** 0.5)
    return violation_of_dropped_rows(system, t, y, sizes) / allowed


def _of_coordinates(system, t, y):
    """The coordinates' Jacobian, where that of the velocities does not serve both."""
    return None if shares_split(system) else system.coordinate_jacobian(t, y.q)


def _choose(system, t, y, of_coordinates):
    """A chart by full pivoting, its quality, and whether the rank is less than it was when the scene was compiled.

    It may be higher: where the state is on the constraints to Newton's tolerance only, so are redundant rows redundant.
    """
    jacobian, scale, levels = system.jacobian(t, y.q, y.u), system.velocity_scale(), row_levels(system)
    rows = system.velocity_rows
    velocity = full_pivot(jacobian[:rows], scale=scale, level=levels[:rows])
    singular = velocity.rank < system.velocity_rank
    solved = eliminate(jacobian[:rows], velocity.order, system.velocity_rank)
    quality = _velocity_quality(system, solved, velocity.order)
    acceleration = None
    if system.acceleration_rows > rows:
        every = full_pivot(jacobian, scale=scale, level=levels)
        acceleration, singular = every.order, singular | (every.rank < system.acceleration_rank)
    if shares_split(system):
        return ChartIndices(velocity.order, acceleration, None, solved.right_inverse), quality, singular
    pivots = full_pivot(of_coordinates, scale=system.coordinate_scale())
    split, own = _refreshed(
        system, of_coordinates, ChartIndices(velocity.order, acceleration, pivots.order, jnp.zeros(()))
    )
    return split, jnp.maximum(quality, own), singular | (pivots.rank < system.coordinate_rank)


def _refreshed(system, jacobian, split):
    """The split with the position factor of this state, from its Jacobian, and the coordinates' quality."""
    solved = eliminate(jacobian, split.coordinate, system.coordinate_rank)
    own = _quality(system, solved, system.coordinate_scale(), split.coordinate, system.coordinate_rank)
    return ChartIndices(split.velocity, split.acceleration, split.coordinate, solved.right_inverse), own


def _velocity_quality(system, solved, order):
    solved = lax.stop_gradient(solved)
    return _quality(system, solved, system.velocity_scale(), order, system.velocity_rank)


def _quality(system, solved, scale, order, rank):
    """The quality of a chart, in units of the coordinates' scales."""
    influence = jnp.abs(solved.null_space) * scale[order.columns[rank:]][None, :] / scale[:, None]
    largest = [jnp.max(influence, initial=1.0)]
    if system.velocity_rank < system.velocity_rows:
        largest.append(jnp.max(jnp.abs(solved.right_inverse) / scale[:, None], initial=0.0))
    return jnp.stack(largest)
