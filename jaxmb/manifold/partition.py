"""Generalized coordinate partitioning: integrate the independent coordinates and velocities, solve for the rest.

A step evaluates twice. `ideal_acceleration` takes predicted coordinates close to the manifold and factors the Jacobian
there: the one elimination of the step. `ChartConstraints` take the corrected state, keep its independent coordinates
and velocities, solve `Φ = 0` and `ψ = 0` for the dependent ones, and find the accelerations there by one Newton
correction of those of the prediction: it needs no Jacobian and no elimination, and costs a fifth. Where no state nearby
has been evaluated, `restore_positions` is followed by `ideal_acceleration`. Where constraints are not ideal, or bind
accelerations only, `general_acceleration` stands for that. Its derivatives are those of the equations at their
solution, those of `ideal_acceleration` as well; the factors that these need are differentiated with them or made anew,
so higher derivatives are right.

Sources: R. A. Wehage and E. J. Haug, J. Mech. Design 104(1), 1982; P. E. Nikravesh and I. S. Chung, J. Mech. Design
104(4), 1982; P. E. Nikravesh and E. J. Haug, J. Mech. Transm. Autom. Des. 105(3), 1983 (nonholonomic).
"""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._compat import cond_of_lanes
from .._results import RESULTS
from .._types import Coordinates, Scalar, State, Velocities
from ..contacts.guards import contact_guards
from ..contacts.tolerance import ContactTolerance
from ..formulations import AbstractFormulation, Partitioned
from ..formulations.formulation import check_mass, row_levels, solve_constrained
from ..formulations.friction import solve_coupled
from ..formulations.partitioned import reduced_accelerations
from ..linalg.elimination import Factor, PivotOrder, eliminate, full_pivot, positive_solver
from ..linalg.jacobian import DenseJacobian
from ..linalg.newton import chord
from ..linalg.sums import unchecked_take, with_entries
from ..solvers import AbstractManifoldTerm, AbstractMultistep, ManifoldEvaluation
from ..system import AbstractEquation
from ..system.residuals import drops_rows, friction_force, row_sizes, violation_of_dropped_rows
from .compliant_gaps import compliant_gaps
from .constraints import (
    AbstractConstraints,
    RestoredState,
    SolvedState,
    dense,
    push,
    push_accelerations,
    push_velocities,
    rates_along,
    restore,
    solved,
)
from .diagnosis import diagnose
from .impulse import after_jump, found_at_jump
from .manifold import AbstractManifold, VectorField, newton_tolerance
from .orthogonal_projection import project_normalized

# Largest number of Newton iterations for positions.
_MAX_ITERATIONS = 12
# A stored position factor is refreshed after this many steps, or when Newton's method takes this many iterations.
_AGE = 4
_SLOW = 3
# It is of no use where the nearness to a loss of rank has changed by this factor since it was made, nor on the other
# side of that position: there one of this state takes its place. (A parallelogram in space that lies flat several
# times, rtol 1e-4 to 1e-10: with the stored factor alone 35 of 40 cases end soon after that position, as Newton's
# method fails at steps of any length; with this none of 200.)
_MOVED = 1.5
# A chart is replaced when its influence matrix has grown by this factor. (A pendulum at rtol 1e-10, error after ten
# seconds: 1e-7 with 4, 1e-8 with 2 and 4e-9 with 1.1, at 664, 628 and 623 steps. A chain of ten rods makes 19 charts
# in 1200 steps.)
_GROWTH = 1.1
# The same for the solution of the rows that were kept. Where others are redundant, the kept ones can lose rank at a
# position where all of them do not, and H shows nothing of it.
_ROW_GROWTH = 4.0
# No step ends nearer to a position where the rows lose rank than it began, by this factor: at its end round-off would
# be divided by the cube of the distance, and the steps after it would creep. The retry, of 0.7 of the length, ends at a
# third of the distance, and the next step crosses. (Linkages that lie flat several times, 60 speeds: without this nine
# end there at rtol 1e-10, and energies are off by up to 7e-4 at 1e-6; with it none, and 2e-6.)
_NEARER = 8.0
# Redundant rows may be violated by this multiple of Newton's tolerance, or of the pivots that count as zero.
_ALLOWED = 8.0


class ChartIndices(eqx.Module):
    """A chart's index sets, and the matrix that restores positions.

    **Fields:** `velocity`: order of elimination of the velocities' Jacobian; `acceleration`: that of all rows of A,
    None where no row binds accelerations only; `coordinate`: that of the coordinates' Jacobian, None where one order
    serves both; `right_inverse` (nq × coordinate rows): that of the coordinates' Jacobian, from a state of this step or
    of an earlier one.
    """

    velocity: PivotOrder
    acceleration: PivotOrder | None
    coordinate: PivotOrder | None
    right_inverse: Float[Array, "nq mq"]


class ConstrainedAcceleration(eqx.Module):
    """Velocities on the manifold of their coordinates, and accelerations.

    **Fields:** `u`, `udot`; the `factor` of the velocities' Jacobian; that of `every` row of A, None where none binds
    accelerations only; of a system with friction, the `multipliers` of the rows that it depends on, and whether it
    `failed` to determine the accelerations; None of others.
    """

    u: Velocities
    udot: Float[Array, "nu"]
    factor: Factor
    every: Factor | None = None
    multipliers: Float[Array, "k"] | None = None
    failed: Bool[Array, ""] | None = None


def shares_split(system: AbstractEquation) -> bool:
    """Whether one split serves coordinates and velocities: q̇ = u, and no nonholonomic rows."""
    return system.rates_are_velocities and system.velocity_rows == system.position_rows


def coordinate_factor(system: AbstractEquation, t: Scalar, q: Coordinates, split: ChartIndices) -> Factor:
    """Factor of the coordinates' Jacobian in a chart."""
    order = split.velocity if split.coordinate is None else split.coordinate
    return eliminate(system.coordinate_jacobian(t, q), order, system.coordinate_rank)


def correct_positions(system: AbstractEquation, t: Scalar, q: Coordinates, split: ChartIndices) -> Float[Array, "nq"]:
    """Coordinates nearer to the manifold, by one modified-Newton correction with the stored matrix."""
    if system.coordinate_rank == 0:
        return q
    return q - split.right_inverse @ system.coordinate_residual(t, q)


# Each function with a derivative rule is wrapped in a compiled one, so that it is traced once for all its places.
@eqx.filter_jit
def ideal_acceleration(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Coordinates,
    u: Velocities,
    order: PivotOrder,
) -> ConstrainedAcceleration:
    """Accelerations of a system with ideal constraints at coordinates on the manifold or near it.

    **Arguments:** `u`: independent velocities exact, dependent ones a guess; `order` of elimination.
    """
    return _ideal_acceleration(system, formulation, t, q, u, order)


@eqx.filter_custom_jvp
def _ideal_acceleration(system, formulation, t, q, u, order):
    jacobian = system.jacobian(t, q, u)
    solved = eliminate(jacobian, order, system.velocity_rank)
    if system.linear and system.drift_free:
        u = solved.null_space @ u[order.columns[system.velocity_rank :]]
    else:
        u = u - solved.right_inverse @ system.velocity_residual(t, q, u)
    gamma = -system.acceleration_residual(t, q, u, jnp.zeros_like(u))
    jacobian = DenseJacobian(jacobian, solved, solved.rows)
    udot, _ = formulation.solve(system.inertia(t, q, u), system.force(t, q, u), jacobian, gamma)
    return ConstrainedAcceleration(u, udot, solved)


@_ideal_acceleration.def_jvp
def _ideal_acceleration_jvp(primals, tangents):
    system, formulation, t, q, u, order = primals
    dsystem, _, dt, dq, du, _ = tangents
    out = ideal_acceleration(system, formulation, t, q, u, order)
    solved, at = out.factor, (system, t, q, out.u)
    here = ChartConstraints(solved, ChartIndices(order, None, None, solved.right_inverse))
    along = push_velocities(here, at, (dsystem, dt, dense(dq, q), dense(du, u)))
    pushed = solved.right_inverse @ push(lambda s, t, q, u: s.jacobian(t, q, u), at, along)
    dfactor = Factor(-(pushed @ solved.right_inverse), -(pushed @ solved.null_space), None)
    dudot, _ = push_accelerations(here, at, along, RestoredState(q, out.u, out.udot))
    return out, ConstrainedAcceleration(along[3], dudot, dfactor)


@eqx.filter_jit
def general_acceleration(
    system: AbstractEquation,
    formulation: AbstractFormulation,
    t: Scalar,
    q: Coordinates,
    u: Velocities,
    split: ChartIndices,
) -> ConstrainedAcceleration:
    """The same for any constraints, ideal or not, also those that bind accelerations only."""
    return _general_acceleration(system, formulation, t, q, u, split)


@eqx.filter_custom_jvp
def _general_acceleration(system, formulation, t, q, u, split):
    def velocity_factor(u):
        return eliminate(system.velocity_jacobian(t, q, u), split.velocity, system.velocity_rank)

    solved = velocity_factor(u)
    u = u - solved.right_inverse @ system.velocity_residual(t, q, u)
    if not system.linear:
        solved = velocity_factor(u)
        u = u - solved.right_inverse @ system.velocity_residual(t, q, u)
    jacobian = system.jacobian(t, q, u)
    every = None if split.acceleration is None else eliminate(jacobian, split.acceleration, system.acceleration_rank)
    factor = solved if every is None else every
    out = solve_constrained(system, formulation, t, q, u, DenseJacobian(jacobian, factor, factor.rows))
    own = None if out.failed is None else unchecked_take(out.multipliers, system.friction_rows)
    return ConstrainedAcceleration(u, out.udot, solved, every, own, out.failed)


@_general_acceleration.def_jvp
def _general_acceleration_jvp(primals, tangents):
    system, formulation, t, q, u, split = primals
    dsystem, _, dt, dq, du, _ = tangents
    out = general_acceleration(system, formulation, t, q, u, split)
    here, at = _chart_constraints(split, system, t, q, out.u), (system, t, q, out.u)
    along = push_velocities(here, at, (dsystem, dt, dense(dq, q), dense(du, u)))
    solution = RestoredState(q, out.u, out.udot, out.multipliers)
    found = along[3], *push_accelerations(here, at, along, solution)
    # Nothing that is differentiated depends on the factors.
    none, parts = jax.tree.map(lambda _: None, out), lambda out: (out.u, out.udot, out.multipliers)
    return out, eqx.tree_at(parts, none, found, is_leaf=lambda x: x is None)


@eqx.filter_custom_jvp
def restore_positions(
    system: AbstractEquation, t: Scalar, q: Coordinates, split: ChartIndices, outdated: Bool[Array, ""], tol: float
) -> tuple[Float[Array, "nq"], Int[Array, ""] | None, Bool[Array, ""] | None]:
    """Solve `Φ = 0` for the dependent coordinates by Newton with a fixed matrix: `(q, iterations, failed)`.

    **Arguments:** `outdated`: whether the stored matrix is known to be of no use here.
    """
    if system.coordinate_rank == 0:
        return q, jnp.array(0), jnp.array(False)
    if split.coordinate is None:
        # Velocities and coordinates share their factor: it is of this time, and wrong by the first correction only.
        return _newton(system, t, q, split.right_inverse, 1.0, tol)
    # Of an older one nothing is known.
    found = _newton(system, t, q, split.right_inverse, 0.0, tol)

    def with_own_factor(found):
        own = coordinate_factor(system, t, q, split)
        corrected, iterations, failed = _newton(system, t, q, own.right_inverse, 1.0, tol)
        return corrected, found[1] + iterations, failed

    return cond_of_lanes(found[2] | outdated, with_own_factor, lambda found: found, found)


def _newton(system, t, q, right_inverse, first, tol):
    scale = system.coordinate_scale()

    def correct(q):
        step = right_inverse @ system.coordinate_residual(t, q)
        return q - step, jnp.max(jnp.abs(step) / scale)

    return chord(correct, q, first=jnp.full((), first, q.dtype), tol=tol, most=_MAX_ITERATIONS, peel=True)


@restore_positions.def_jvp
def _restore_positions_jvp(primals, tangents):
    system, t, q, split, outdated, tol = primals
    dsystem, dt, dq, *_ = tangents
    out = restore_positions(system, t, q, split, outdated, tol)
    dq = dense(dq, q)
    if system.coordinate_rank > 0:
        own = coordinate_factor(system, t, out[0], split)
        dq = _push_positions(own, (system, t, out[0]), (dsystem, dt, dq))
    return out, (dq, None, None)


def _push_positions(own, at, along):
    """Tangent of the coordinates on the manifold, from their factor there."""
    return along[2] - own.right_inverse @ push(lambda s, t, q: s.coordinate_residual(t, q), at, along)


def _chart_constraints(split, system, t, q, u):
    """The constraints in a chart at a state."""
    jacobian = system.jacobian(t, q, u)
    factor = eliminate(jacobian[: system.velocity_rows], split.velocity, system.velocity_rank)
    every = None if split.acceleration is None else eliminate(jacobian, split.acceleration, system.acceleration_rank)
    return ChartConstraints(factor, split, every)


class ChartConstraints(AbstractConstraints):
    """The constraints in a chart: independent coordinates and velocities keep their values.

    **Fields:** the `factor` of the velocities' Jacobian at a state; the `split`; the factor of `every` row of A, None
    where none binds accelerations only; whether the split's matrix is known to be `outdated`.
    """

    factor: Factor
    split: ChartIndices
    every: Factor | None = None
    outdated: Bool[Array, ""] | bool = False

    def restore(self, system, t, y, near, tol):
        q, iterations, failed = restore_positions(system, t, y.q, self.split, self.outdated, tol)
        # The factor is wrong by the distance of the two states, so the first correction leaves its square, and the
        # second its cube.
        right_inverse = self.factor.right_inverse
        u = y.u - right_inverse @ system.velocity_residual(t, q, y.u)
        if not system.linear:
            step = right_inverse @ system.velocity_residual(t, q, u)
            u = u - step
            failed = failed | ~(jnp.max(jnp.abs(step)) <= jnp.sqrt(tol) * (1.0 + jnp.max(jnp.abs(u))))
        # Residuals of the equations of motion, `A u̇ − γ` and `M u̇ − F − Aᵀ λ − C(λ)`. The accelerations are wrong by
        # the square of the distance; by the distance only where a multiplier that friction depends on changes its sign.
        at, own = (t, q, u), system.friction_rows
        rows = system.acceleration_residual(*at, near.udot)
        unbalanced = self._unbalanced(system, t, RestoredState(q, u, near.udot))
        unbalanced = unbalanced - self._friction(system, at, near.multipliers)
        multipliers = self._of_accelerations.right_inverse.T @ unbalanced
        if near.multipliers is not None:
            multipliers = with_entries(multipliers, own, near.multipliers)
        forces = unbalanced - system.constraint_force(*at, multipliers)
        change, reactions = self.cancel_residuals(system, at, multipliers, forces, rows)
        found = None if near.multipliers is None or reactions is None else near.multipliers + reactions
        return RestoredState(q, u, near.udot + change, found, iterations, failed)

    def at(self, system, t, q, u):
        return _chart_constraints(self.split, system, t, q, u)

    def multipliers(self, system, t, restored):
        friction = self._friction(system, (t, restored.q, restored.u), restored.multipliers)
        return self._of_accelerations.right_inverse.T @ (self._unbalanced(system, t, restored) - friction)

    def _friction(self, system, at, own):
        """`C` at (t, q, u), from the multipliers that it depends on."""
        if system.ideal:
            return jnp.zeros(system.nu, at[2].dtype)
        (t, q, u), own = at, jnp.zeros(0, at[2].dtype) if own is None else own
        return friction_force(system, t, q, u, own)

    def _unbalanced(self, system, t, at):
        """`M u̇ − F`, what the constraints have to balance."""
        return system.inertia(t, at.q, at.u).product(at.udot) - system.force(t, at.q, at.u)

    def push_positions(self, at, along):
        system, t, q = at
        if system.coordinate_rank == 0:
            return along[2]
        own = self.factor if self.split.coordinate is None else coordinate_factor(system, t, q, self.split)
        return _push_positions(own, at, along)

    def cancel_velocities(self, residual):
        return -(self.factor.right_inverse @ residual)

    @property
    def _of_accelerations(self) -> Factor:
        return self.factor if self.every is None else self.every

    def _cancelling(self, inertia):
        """`(forces, rows) -> change`, what `cancel_residuals` does without C."""
        factor = self._of_accelerations
        solve = positive_solver(factor.null_space.T @ inertia.product(factor.null_space))

        def cancel(forces, rows):
            return reduced_accelerations(inertia, -forces, factor, -rows, solve)

        return cancel

    def balance(self, system, at, rows, forces):
        inertia = system.inertia(*at)
        change = self._cancelling(inertia)(forces, rows)
        return change, self._of_accelerations.right_inverse.T @ (inertia.product(change) + forces)

    def cancel_residuals(self, system, at, multipliers, forces, rows):
        inertia, own = system.inertia(*at), system.friction_rows
        cancel = self._cancelling(inertia)
        change = cancel(forces, rows)
        if own.size == 0:
            return change, None
        # Friction answers a change of the multipliers that it depends on, and so changes them again.
        law = lambda x: friction_force(system, *at, x)
        frictions = jax.jacfwd(law)(unchecked_take(multipliers, own)).T
        responses = jax.vmap(lambda force: cancel(-force, jnp.zeros_like(rows)))(frictions)
        balance = unchecked_take(self._of_accelerations.right_inverse.T, own)
        reaction = lambda change, forces: jnp.sum(balance * (inertia.product(change) + forces)[None], axis=1)
        coupling = jax.vmap(reaction, out_axes=1)(responses, -frictions)
        own_change = solve_coupled(jnp.eye(own.size, dtype=rows.dtype) - coupling, reaction(change, forces))
        return change + own_change @ responses, own_change


# The default, made once.
_PARTITIONED = Partitioned()


class Partition(AbstractManifold):
    """Coordinate partitioning with charts chosen by full pivoting.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, manifold=jaxmb.manifold.Partition(max_influence=1.5))
    ```

    There are `nq − rank Φ_q` independent coordinates and `nu − rank [Φ; ψ]` independent velocities; with nonholonomic
    constraints these are two nested charts. Only independent components are integrated; the others satisfy the
    constraints to Newton's tolerance at the end of every step. The error of a step is measured on all of them. A chart
    is replaced when its influence matrix H has grown by the factor `max_influence`, or when redundant rows would serve
    better than those it keeps; the solver's history is that of all components, so a new chart costs no restart. No step
    ends much nearer to a position where rows lose rank, as where a linkage lies flat, than it began: it is made
    shorter, so that the next one passes over that position.

    The formulation finds the accelerations of predicted states; those of corrected states follow by one step of
    Newton's method with the same factor.

    **Arguments:** `max_influence`: bound on `max |H|` (scaled), relative to 1 or to its value when the chart was made,
    whichever is larger: errors of the independent components reach the dependent ones multiplied by H and its
    rates; `newton_tol`: size of the last Newton correction relative to the system's size, default tied to the
    tolerance of integration.
    """

    max_influence: float = eqx.field(static=True, default=_GROWTH)
    newton_tol: float | None = eqx.field(static=True, default=None)  # pyright: ignore[reportIncompatibleVariableOverride]
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
        tolerances = newton_tolerance(self.newton_tol, rtol), self.contact_tolerance(system, rtol)
        return PartitionTerm(system, formulation, self.max_influence, *tolerances), solver

    def default_formulation(self, system):
        return _PARTITIONED

    def correction(self, interpolated):
        return project_normalized if interpolated else None

    def statistics(self, solver_state):
        return {"newton_iterations": solver_state.chart.newton, "charts": solver_state.chart.charts}

    def evidence(self, solver_state):
        chart = solver_state.chart
        return chart.singular, None if chart.redundant is None else chart.redundant.violation

    def diagnose(self, system, t, y, evidence, result, failed):
        singular, violation = evidence
        result = diagnose(system, t, y, singular, result, failed)
        if violation is None:
            return result
        # Steps were refused until they led up to the violation that is allowed.
        return RESULTS.where(failed & (violation > 0.5), RESULTS.inconsistent_constraints, result)


class RedundantRows(eqx.Module):
    """The `sizes` of the rows of ψ, and the `violation` of redundant ones at the end of the last step relative to what
    is allowed.
    """

    sizes: Float[Array, "velocity_rows"]
    violation: Float[Array, ""]


class Chart(eqx.Module):
    """The index sets with their quality and counters.

    **Fields:** `split`; `quality` at the last evaluation and at the `fresh` chart: largest scaled |H|, with redundant
    rows the largest entry of the solution of the kept ones, and the `nearness` to a loss of rank, in `fresh` that where
    the position factor was made; `counters`: see the properties; `redundant`: None where all rows are independent;
    `multipliers` of the rows that friction depends on, at the prediction of the last step and at its end, None without
    any.
    """

    split: ChartIndices
    quality: Float[Array, "k"]
    fresh: Float[Array, "k"]
    counters: Int[Array, "5"]
    redundant: RedundantRows | None = None
    multipliers: Float[Array, "2 k"] | None = None

    @property
    def nearness(self) -> Float[Array, ""]:
        """To a loss of rank: the largest entry on the diagonal of the inverse that elimination ends with."""
        return self.quality[-1]

    @property
    def outdated(self) -> Bool[Array, ""]:
        """Whether the stored position factor is of no use, so near or so far is a loss of rank."""
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


class PartitionTerm(AbstractManifoldTerm):
    """A constrained system as a term with charts; `at_contact`: what counts as zero there, None without contacts."""

    system: AbstractEquation
    formulation: AbstractFormulation
    max_influence: float = eqx.field(static=True)
    newton_tol: Float[Array, ""]
    at_contact: ContactTolerance | None = None

    def vf(self, t, y, args):
        return VectorField(self.system, self.formulation)(t, y, args)

    def init_chart(self, t, y, args):
        # A chart of no use, so that charts are chosen in one place.
        system, y = lax.stop_gradient((self.system, y))
        choose = lambda system: _choose(system, t, y, _of_coordinates(system, t, y))
        split, quality, _ = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), eqx.filter_eval_shape(choose, system))
        redundant = RedundantRows(row_sizes(system, t, y), jnp.zeros((), y.q.dtype)) if drops_rows(system) else None
        frictions = system.friction_rows.size
        multipliers = jnp.zeros((2, frictions), y.q.dtype) if frictions else None
        return Chart(split, jnp.full_like(quality, jnp.inf), quality, jnp.zeros(5, int), redundant, multipliers)

    def evaluate(self, t, y, chart, args):
        q = correct_positions(self.system, t, y.q, lax.stop_gradient(chart.split))
        return self._evaluate(t, q, y.u, chart)

    def _evaluate(self, t, q, u, chart):
        system, split, quality, failed = self.system, chart.split, chart.quality, None
        multipliers = chart.multipliers
        if system.acceleration_rows == 0:
            udot, factors = system.inertia(t, q, u).solve(system.force(t, q, u)), None
        else:
            if system.ideal_on_velocities:
                out = ideal_acceleration(system, self.formulation, t, q, u, split.velocity)
            else:
                out = general_acceleration(system, self.formulation, t, q, u, split)
                failed = out.failed
                if out.multipliers is not None:
                    multipliers = jnp.stack([out.multipliers] * 2)
            u, udot, factors = out.u, out.udot, (out.factor, out.every)
            quality = _velocity_quality(system, out.factor, split.velocity)
            if split.coordinate is None:
                split = ChartIndices(split.velocity, split.acceleration, None, out.factor.right_inverse)
        chart = dataclasses.replace(chart, split=split, quality=quality, multipliers=multipliers)
        f = State(system.rates(t, q, u), udot)
        failed = chart.singular if failed is None else chart.singular | failed
        return ManifoldEvaluation(State(q, u), f, chart, failed, factors)

    def project_near(self, t, y, linearized_at, args):
        system, chart = self.system, linearized_at.chart
        if system.acceleration_rows == 0:
            return self._project(t, y, chart, chart.split)
        outdated = False if chart.split.coordinate is None else chart.outdated
        constraints = ChartConstraints(linearized_at.factors[0], chart.split, linearized_at.factors[1], outdated)
        multipliers = None if chart.multipliers is None else chart.multipliers[0]
        near = SolvedState(constraints, *lax.stop_gradient((linearized_at.f.u, multipliers)))
        out: Any = restore(system, t, y, near, self.newton_tol)
        f = State(system.rates(t, out.q, out.u), out.udot)
        chart, failed = _counted(chart, out.iterations), out.failed | chart.singular
        if multipliers is not None:
            chart = dataclasses.replace(chart, multipliers=jnp.stack([multipliers, out.multipliers]))
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
        q, iterations, failed = restore_positions(self.system, t, y.q, split, False, self.newton_tol)
        out = self._evaluate(t, q, y.u, _counted(chart, iterations))
        return out._replace(failed=failed | out.failed)

    def kept(self, chart):
        return self._kept(chart, 1)

    def kept_at_start(self, chart):
        return self._kept(chart, 0)

    def _kept(self, chart, k):
        split = eqx.tree_at(lambda split: split.right_inverse, chart.split, None)
        return split, None if chart.multipliers is None else chart.multipliers[k]

    def at_solution(self, t, y, f, kept, args):
        system, (split, multipliers) = self.system, kept
        if system.acceleration_rows > 0:
            solution = RestoredState(y.q, y.u, f.u, multipliers)
            out = solved(eqx.Partial(_chart_constraints, split), system, t, solution)
            return State(out.q, out.u), State(system.rates(t, out.q, out.u), out.udot)
        if system.coordinate_rank:
            own = coordinate_factor(*lax.stop_gradient((system, t, y.q)), split)
            split = ChartIndices(split.velocity, split.acceleration, split.coordinate, own.right_inverse)
        none = jnp.zeros(2 + drops_rows(system), y.q.dtype)
        out = self._project(t, y, Chart(split, none, none, jnp.zeros(5, int)), split)
        return out.y, out.f

    def along_solution(self, t, y, f, along, kept, args):
        system, (split, _) = self.system, kept
        if system.acceleration_rows == 0 or system.friction_rows.size:
            return super().along_solution(t, y, f, along, kept, args)
        return rates_along(eqx.Partial(_chart_constraints, split), system, t, y, f, along)

    @property
    def guards(self):
        return contact_guards(self.system, self.formulation, self.at_contact)

    @property
    def gaps(self):
        return compliant_gaps(self.system)

    def found_at_jump(self, t, y, args):
        return found_at_jump(self.guards, t, y)

    def after_jump(self, t, y, found, args):
        return after_jump(self.system, self.guards, t, y, found)

    def chart_after_jump(self, chart):
        if not self.system.contacts:
            return chart
        # Contacts that close or open make the chart one of other rows.
        return dataclasses.replace(chart, quality=jnp.full_like(chart.quality, jnp.inf))

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
        return _updated(*lax.stop_gradient((self.system, t, y, chart)), self.max_influence)

    def after_step(self, t, y, chart, args):
        del args
        if chart.redundant is None:
            return chart
        violation = _violation(*lax.stop_gradient((self.system, t, y, chart.redundant.sizes, self.newton_tol)))
        return eqx.tree_at(lambda chart: chart.redundant.violation, chart, violation)

    def refuses(self, chart, before):
        nearer = (chart.nearness > _NEARER * before.nearness) & (chart.charts == before.charts)
        return nearer if chart.redundant is None else nearer | (chart.redundant.violation > 1)


def _counted(chart, iterations):
    """The chart after a Newton iteration for positions."""
    age, _, newton, charts, singular = chart.counters
    counters = jnp.stack([age, iterations, newton + iterations, charts, singular])
    return dataclasses.replace(chart, counters=counters)


@eqx.filter_jit
def _updated(system, t, y, chart, max_influence):
    """The chart, refreshed or chosen anew where it has become worse."""
    bounds = np.array([max_influence, _ROW_GROWTH])[: chart.fresh.size - 1]
    # Of no quality, not a number, are charts that are none.
    worse = lambda chart: ~jnp.all(chart.quality[:-1] <= bounds * chart.fresh[:-1])

    def renewed(chart, jacobian):
        def renew(chart):
            split, fresh, singular = _choose(system, t, y, jacobian)
            counters = chart.counters + jnp.array([0, 0, 0, 1, 0]) + jnp.array([0, 0, 0, 0, 1]) * singular.astype(int)
            return dataclasses.replace(chart, split=split, quality=fresh, fresh=fresh, counters=counters)

        return cond_of_lanes(worse(chart), renew, lambda chart: chart, chart)

    if chart.split.coordinate is None or system.coordinate_rank == 0:
        return renewed(chart, _of_coordinates(system, t, y))
    stale = worse(chart) | (chart.age >= _AGE) | (chart.iterations >= _SLOW) | chart.outdated

    def refresh(chart):
        jacobian = _of_coordinates(system, t, y)
        split, own = _refreshed(system, jacobian, chart.split)
        quality = chart.quality.at[:-1].max(own)
        # Only a chart that has been refreshed can be worse.
        fresh, counters = chart.fresh.at[-1].set(chart.nearness), chart.counters.at[0].set(0)
        refreshed = dataclasses.replace(chart, split=split, quality=quality, fresh=fresh, counters=counters)
        return renewed(refreshed, jacobian)

    def keep(chart):
        return dataclasses.replace(chart, counters=chart.counters.at[0].add(1))

    return cond_of_lanes(stale, refresh, keep, chart)


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
    return split, quality.at[:-1].max(own), singular | (pivots.rank < system.coordinate_rank)


def _refreshed(system, jacobian, split):
    """The split with the position factor of this state, from its Jacobian, and the coordinates' quality."""
    solved = eliminate(jacobian, split.coordinate, system.coordinate_rank)
    own = _quality(system, solved, system.coordinate_scale(), split.coordinate, system.coordinate_rank)
    return ChartIndices(split.velocity, split.acceleration, split.coordinate, solved.right_inverse), own


def _velocity_quality(system, solved, order):
    """The quality of a chart, as `Chart` has it."""
    solved, rank = lax.stop_gradient(solved), system.velocity_rank
    diagonal = solved.right_inverse.at[order.columns[:rank], order.rows[:rank]]
    nearness = jnp.max(jnp.abs(diagonal.get(mode="promise_in_bounds", wrap_negative_indices=False)), initial=0.0)
    return jnp.append(_quality(system, solved, system.velocity_scale(), order, rank), nearness)


def _quality(system, solved, scale, order, rank):
    """That of the coordinates or velocities that it makes depend on others, in units of their scales."""
    influence = jnp.abs(solved.null_space) * scale[order.columns[rank:]][None, :] / scale[:, None]
    largest = [jnp.max(influence, initial=1.0)]
    if system.velocity_rank < system.velocity_rows:
        largest.append(jnp.max(jnp.abs(solved.right_inverse) / scale[:, None], initial=0.0))
    return jnp.stack(largest)
