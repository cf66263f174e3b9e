"""Generalized coordinate partitioning: integrate the independent coordinates and velocities, solve for the rest.

A step evaluates twice. `acceleration` takes predicted coordinates close to the manifold and factors the Jacobian there:
the one elimination of the step. `ChartConstraints` take the corrected state, keep its independent coordinates and
velocities, and solve `Φ = 0` and `ψ = 0` for the dependent ones. One Newton correction of the prediction's
accelerations gives the accelerations there, without a Jacobian and an elimination, at a fifth of the cost.

Without an evaluation nearby, `restore_positions` is followed by `acceleration`. Derivatives follow from the equations
at their solution, and the factors have the derivatives of their matrices, so higher derivatives are right.

Sources: R. A. Wehage and E. J. Haug, J. Mech. Design 104(1), 1982; P. E. Nikravesh and I. S. Chung, J. Mech. Design
104(4), 1982; P. E. Nikravesh and E. J. Haug, J. Mech. Transm. Autom. Des. 105(3), 1983 (nonholonomic).
"""

import abc
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._branches import cond_of_lanes
from .._results import RESULTS
from ..formulations import AbstractFormulation, Partitioned
from ..formulations.formulation import check_mass
from ..formulations.laws import laws_of
from ..linalg.elimination import eliminate
from ..solvers import AbstractMultistep
from ..solvers.manifold_term import ManifoldEvaluation
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .accuracy import Accuracy
from .chart import choose, velocity_quality
from .chart_constraints import ChartConstraints, acceleration, chart_constraints
from .constraints import (
    SolvedState,
    restore,
)
from .diagnosis import diagnose
from .implied import (
    DroppedRows,
    contradiction_ahead,
    drops_accelerations,
    drops_positions,
    drops_rows,
    independent_part,
    violation_of_accelerations,
    watched,
)
from .manifold import AbstractManifold
from .orthogonal_projection import project_normalized
from .split import AbstractSplit, restore_positions
from .term import AbstractConstrainedTerm

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

# A stored position factor is refreshed after this many steps, or when Newton's method takes this many iterations.
_AGE = 4
_SLOW = 3
# A stored factor is useless if the nearness to a loss of rank has changed by this ratio since the factor was made. It
# is also useless on the other side of the position where rank is lost. A factor of the present state then replaces it.
# (A parallelogram in space that lies flat several times, rtol 1e-4 to 1e-10: with the stored factor alone 35 of 40
# cases end soon after that position, as Newton's method fails at steps of any length; with this replacement none of
# 200.)
_MOVED = 1.5
# A chart is replaced when its influence matrix has grown by this factor. (A pendulum at rtol 1e-10, error after ten
# seconds: 1e-7 with 4, 1e-8 with 2 and 4e-9 with 1.1, at 664, 628 and 623 steps. A chain of ten rods makes 19 charts
# in 1200 steps.)
_GROWTH = 1.1
# The same for the solution of the kept rows. If other rows are redundant, the kept rows can lose rank at a position
# where all rows together do not, and H does not show it.
_ROW_GROWTH = 4.0
# No step ends nearer than it began, by this factor, to a position where the rows lose rank. Otherwise round-off at its
# end would be divided by the cube of the distance, and the next steps would be very short. The retry, of 0.7 of the
# length, ends at a third of the distance, and the next step crosses. (Linkages that lie flat several times, 60 speeds:
# without this bound nine end there at rtol 1e-10, and energies are off by up to 7e-4 at 1e-6; with this bound none ends
# there, and energies are off by up to 2e-6.)
_NEARER = 8.0
# At a prediction, the gradient of a row may be independent of the others by this multiple of the tolerance.
_UNRESOLVED = 100.0


# The default, made once.
_PARTITIONED = Partitioned()


class Partition(AbstractManifold):
    """Coordinate partitioning with charts chosen by full pivoting.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, manifold=jaxmb.manifold.Partition(max_influence=1.5))
    ```

    There are `nq − rank Φ_q` independent coordinates and `nu − rank [Φ; ψ]` independent velocities; with nonholonomic
    constraints these are two nested charts. Only independent components are integrated; the others satisfy the
    constraints to Newton's tolerance at the end of every step. The error of a step is measured on all components. A
    chart is replaced when its influence matrix H has grown by the factor `max_influence`, or when redundant rows would
    serve better than the kept ones. The solver's history contains all components, so a new chart needs no restart. No
    step ends much nearer than it began to a position where rows lose rank, such as a linkage that lies flat. Such a
    step is shortened, so that the next step passes over that position.

    The formulation finds the accelerations of predicted states; the accelerations of corrected states follow by one
    correction of Newton's method with the same factor.

    **Arguments:**

    - `max_influence`: bound on `max |H|` (scaled), relative to 1 or to its value when the chart was made, whichever is
        larger. Errors of the independent components reach the dependent ones multiplied by H and its rates.
    - `newton_tol`: size of the last Newton correction relative to the system's size; default a thousandth of the
        tolerance of integration, at most 1e-6.
    """

    max_influence: float = eqx.field(static=True, default=_GROWTH)
    newton_tol: float | None = eqx.field(static=True, default=None)  # pyright: ignore[reportIncompatibleVariableOverride]
    restores: ClassVar[bool] = True
    uses_charts: ClassVar[bool] = True

    def __check_init__(self):
        if not self.max_influence > 1:
            raise ValueError(f"Partition: max_influence must be above 1, got {self.max_influence}.")

    def prepare(self, system, formulation, solver, accuracy):
        if not isinstance(solver, AbstractMultistep):
            raise ValueError(
                f"Partition needs a solver that knows charts (Adams or Hermite), got {type(solver).__name__}; use "
                "manifold=Projection() with it."
            )
        check_mass(system, formulation)
        term = PartitionTerm if system.acceleration_rows else FreeTerm
        return term(system, formulation, accuracy, self.max_influence), solver

    def default_formulation(self, system):
        return _PARTITIONED

    def correction(self, interpolated):
        return project_normalized if interpolated else None

    def statistics(self, solver_state):
        return {"newton_iterations": solver_state.chart.newton, "charts": solver_state.chart.charts}

    def evidence(self, solver_state):
        chart = solver_state.chart
        return chart.singular, None if chart.redundant is None else chart.redundant.suspected

    def diagnose(self, system, t, y, evidence, result, failed, accuracy):
        (singular, violation), at = evidence, Instant.of(system, t, y)
        result = diagnose(at, singular, result, failed)
        if violation is None:
            return result
        # Steps were refused until they reached the allowed violation.
        if drops_accelerations(system):
            violation = jnp.maximum(violation, contradiction_ahead(*lax.stop_gradient((at, accuracy.rtol))))
        return RESULTS.where(failed & (violation > 0.5), RESULTS.inconsistent_constraints, result)


class ChartInUse(eqx.Module):
    """The index sets of a chart with their quality and counters.

    **Fields:**

    - `split`: the index sets.
    - `quality`: of the last evaluation: the largest scaled |H|; with redundant rows the largest entry of the solution
        of the kept rows; and the `nearness` to a loss of rank.
    - `fresh`: the quality of the chart when it was made, with the `nearness` when the position factor was made.
    - `counters`: see the properties.
    - `redundant`: the watch of dropped rows, None if all rows are independent.
    - `multipliers`: the memories of the system's laws at the prediction of the last step and at its end, None without
        any.
    """

    split: AbstractSplit
    quality: Float[Array, "k"]
    fresh: Float[Array, "k"]
    counters: Int[Array, "5"]
    redundant: DroppedRows | None = None
    multipliers: Float[Array, "2 k"] | None = None

    @property
    def nearness(self) -> Float[Array, ""]:
        """The nearness to a loss of rank: the largest diagonal entry of the inverse in the elimination."""
        return self.quality[-1]

    @property
    def outdated(self) -> Bool[Array, ""]:
        """Whether the stored position factor is useless, because the nearness to a loss of rank has changed."""
        change = self.nearness / self.fresh[-1]
        return (change > _MOVED) | (change < 1 / _MOVED)

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


class AbstractChartTerm(AbstractConstrainedTerm):
    """A system as a term with charts."""

    # The error is measured on all components: if dependent ones change fast, the error of the independent ones alone
    # shows it too late. (A four-bar at error 1e-6: 2949 evaluations and no rejected step, against 3461 and 122; a
    # spatial slider-crank 3107 against 3867.)

    max_influence: AbstractVar[float]

    def init_chart(self, t, y, args):
        # A useless chart, so that charts are chosen in one place.
        at = lax.stop_gradient(self.at(t, y))
        first = lambda at: choose(at, at.coordinate_jacobian)
        split, quality, _ = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), eqx.filter_eval_shape(first, at))
        redundant = DroppedRows.at_start(at) if drops_rows(self.system) else None
        memory = laws_of(self.system).remembered(at, jnp.zeros(self.system.acceleration_rows, y.q.dtype))
        unknown, none = jnp.full_like(quality, jnp.inf), jnp.zeros(5, int)
        return ChartInUse(split, unknown, quality, none, redundant, _both(memory, memory))

    def evaluate(self, t, y, chart, args):
        return self._evaluate(lax.stop_gradient(chart.split).correct(self.at(t, y)), chart)

    def project_cold(self, t, y, chart, args):
        if not (self.system.ideal_on_velocities and self.system.linear):
            return super().project_cold(t, y, chart, args)
        at = self.at(t, y)
        return self._project(at, chart, chart.split.at_guess(lax.stop_gradient(at)))

    def _project(self, at, chart, split):
        """Restore positions with the matrix of a split, then evaluate there."""
        q, iterations, failed = restore_positions(at, split, False, self.accuracy.newton)
        out = self._evaluate(at.with_(q=q), _counted(chart, iterations))
        return out._replace(failed=failed | out.failed)

    @abc.abstractmethod
    def _evaluate(self, at: Instant, chart: ChartInUse) -> ManifoldEvaluation:
        """The evaluation at coordinates near the constraints or on them."""

    @abc.abstractmethod
    def _kept(self, chart: ChartInUse, k: int) -> Any:
        """See `kept`; with the memory of the laws at the prediction of a step (k = 0) or at its end (k = 1)."""

    def kept(self, chart):
        return self._kept(chart, 1)

    def kept_at_start(self, chart):
        return self._kept(chart, 0)

    def chart_after_jump(self, chart):
        if not self.system.contacts:
            return chart
        # Contacts that close or open change the rows of the chart.
        return dataclasses.replace(chart, quality=jnp.full_like(chart.quality, jnp.inf))

    def free(self, chart):
        system, velocity = self.system, chart.split.velocity
        coordinates = chart.split.independent(system)
        velocities = system.nq + velocity.columns[system.velocity_rank :]
        # Internal states are independent in every chart.
        states = system.nq + system.nu + jnp.arange(system.nz, dtype=velocities.dtype)
        return jnp.concatenate([coordinates, velocities, states])

    def update_chart(self, t, y, chart, args):
        return _updated(*lax.stop_gradient((self.at(t, y), chart)), self.max_influence)

    def refuses(self, chart, before):
        nearer = (chart.nearness > _NEARER * before.nearness) & (chart.charts == before.charts)
        return nearer if chart.redundant is None else nearer | (chart.redundant.violation > 1)


class PartitionTerm(AbstractChartTerm):
    """A constrained system."""

    system: AbstractEquation
    formulation: AbstractFormulation
    accuracy: Accuracy
    max_influence: float = eqx.field(static=True)

    def _evaluate(self, at, chart: Any):
        out = acceleration(at, self.formulation, chart.split)
        split = chart.split.at_evaluation(out.factor)
        quality = velocity_quality(self.system, out.factor, split.velocity)
        chart = dataclasses.replace(chart, split=split, quality=quality, multipliers=_both(out.memory, out.memory))
        if out.jacobian is not None and chart.redundant is not None:
            # The state is off the constraints by an error of the prediction.
            sizes, scale = chart.redundant.sizes, self.system.velocity_scale()
            rows = out.jacobian[: self.system.position_rows]
            independent = independent_part(rows, sizes, out.factor, split.velocity, scale)
            independent = jnp.maximum(independent - _UNRESOLVED * self.accuracy.rtol, 0.0)
            chart = eqx.tree_at(lambda chart: chart.redundant.independent, chart, independent)
        near = SolvedState(ChartConstraints(out.factor, split, out.every, chart.outdated), out.udot, out.memory)
        return self.evaluated(at.with_(u=out.u), out.udot, chart, chart.singular | out.failed, near)

    def project_near(self, t, y, linearized_at, args):
        at, chart, near = self.at(t, y), linearized_at.chart, linearized_at.factors
        out: Any = restore(at, near, self.accuracy.newton)
        memory = _both(near.multipliers, out.multipliers)
        chart = dataclasses.replace(_counted(chart, out.iterations), multipliers=memory)
        return self.evaluated(at.with_(q=out.q, u=out.u), out.udot, chart, out.failed | chart.singular)

    def after_step(self, t, y, chart, args):
        if chart.redundant is None:
            return chart
        redundant = _watched(*lax.stop_gradient((self.at(t, y), chart.split, chart.redundant, self.accuracy)))
        return dataclasses.replace(chart, redundant=redundant)

    def _kept(self, chart, k):
        return chart.split.orders(), jax.tree.map(lambda memories: memories[k], chart.multipliers)

    def linearisation(self, kept):
        split, memory = kept
        return eqx.Partial(chart_constraints, split), memory


class FreeTerm(AbstractChartTerm):
    """A system without constraints, whose coordinates may need normalisation."""

    system: AbstractEquation
    formulation: AbstractFormulation
    accuracy: Accuracy
    max_influence: float = eqx.field(static=True)

    def _evaluate(self, at, chart):
        return self.evaluated(at, at.inertia.solve(at.force), chart, chart.singular)

    def project_near(self, t, y, linearized_at, args):
        chart = linearized_at.chart
        return self._project(self.at(t, y), chart, chart.split)

    def _kept(self, chart, k):
        return chart

    def linearisation(self, kept):
        return None


def _both(first, second):
    """Two memories of laws, stacked."""
    return jax.tree.map(lambda *memories: jnp.stack(memories), first, second)


def _counted(chart, iterations):
    """The chart after Newton's iterations for positions."""
    age, _, newton, charts, singular = chart.counters
    counters = jnp.stack([age, iterations, newton + iterations, charts, singular])
    return dataclasses.replace(chart, counters=counters)


@eqx.filter_jit
def _updated(at, chart, max_influence):
    """The chart, refreshed or chosen anew if it has become worse."""
    bounds = np.array([max_influence, _ROW_GROWTH])[: chart.fresh.size - 1]
    # Useless charts have a NaN or infinite quality.
    worse = lambda chart: ~jnp.all(chart.quality[:-1] <= bounds * chart.fresh[:-1])

    def renewed(chart, jacobian):
        def renew(chart):
            split, fresh, singular = choose(at, jacobian)
            counters = chart.counters + jnp.array([0, 0, 0, 1, 0]) + jnp.array([0, 0, 0, 0, 1]) * singular.astype(int)
            return dataclasses.replace(chart, split=split, quality=fresh, fresh=fresh, counters=counters)

        return cond_of_lanes(worse(chart), renew, lambda chart: chart, chart)

    if not chart.split.ages:
        return renewed(chart, None)
    stale = worse(chart) | (chart.age >= _AGE) | (chart.iterations >= _SLOW) | chart.outdated

    def refresh(chart):
        jacobian = at.coordinate_jacobian
        split, of_coordinates, factor = chart.split.refreshed(at.system, jacobian)
        quality = chart.quality.at[:-1].max(of_coordinates)
        # Only a refreshed chart can be worse.
        fresh, counters = chart.fresh.at[-1].set(chart.nearness), chart.counters.at[0].set(0)
        refreshed = dataclasses.replace(chart, split=split, quality=quality, fresh=fresh, counters=counters)
        if drops_positions(at.system):
            rows, scale = jacobian[: at.system.position_rows], at.system.coordinate_scale()
            independent = independent_part(rows, chart.redundant.sizes, factor, split.coordinate, scale)
            refreshed = eqx.tree_at(lambda chart: chart.redundant.independent, refreshed, independent)
        return renewed(refreshed, jacobian)

    def keep(chart):
        return dataclasses.replace(chart, counters=chart.counters.at[0].add(1))

    return cond_of_lanes(stale, refresh, keep, chart)


@eqx.filter_jit
def _watched(at, split, redundant, accuracy):
    """The dropped rows at a state, with their violation."""
    system = at.system
    redundant = watched(at, redundant, accuracy.newton, accuracy.rtol)
    if not drops_accelerations(system):
        return redundant
    every = eliminate(at.jacobian, split.acceleration, system.acceleration_rank)
    contradiction = violation_of_accelerations(at, every.right_inverse @ at.gamma, accuracy.rtol)
    return eqx.tree_at(lambda rows: rows.violation, redundant, jnp.maximum(redundant.violation, contradiction))
