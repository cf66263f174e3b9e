"""Generalized coordinate partitioning: integrate the independent coordinates and velocities, solve for the rest.

Sources: R. A. Wehage and E. J. Haug, J. Mech. Design 104(1), 1982; P. E. Nikravesh and I. S. Chung, J. Mech. Design 104(4),
1982; P. E. Nikravesh and E. J. Haug, J. Mech. Transm. Autom. Des. 105(3), 1983 (nonholonomic).
"""

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .._types import State
from ..elimination import full_pivot
from ..formulations import AbstractFormulation
from ..formulations._base import stages
from ..solvers import AbstractManifoldTerm, Adams
from ..system import AbstractSystem
from ._base import AbstractManifold
from .constrained import Split, coordinate_factor, evaluate, shared
from .free import VectorField

# A carried position factor is refreshed after this many steps, or when Newton takes this many iterations.
_AGE = 4
_SLOW = 3


class Partition(AbstractManifold):
    """Coordinate partitioning with charts chosen by full pivoting.

    Independent coordinates number `nq − rank Φ_q`, independent velocities `nu − rank [Φ; ψ]`; with nonholonomic constraints
    these are two nested charts. Only independent components are integrated and error-controlled; the others satisfy the
    constraints to Newton's tolerance at every evaluation. A chart is replaced when its influence matrix grows beyond
    `max_influence`; history is kept for all components, so that costs no restart.

    **Arguments:** `max_influence`: bound on `max |H|` (scaled; full pivoting gives about 1); `newton_tol`: size of the last
    Newton correction relative to the system's size, default tied to the tolerance of integration.
    """

    max_influence: float = eqx.field(static=True, default=4.0)
    newton_tol: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if not self.max_influence > 1:
            raise ValueError(f"Partition: max_influence must be above 1, got {self.max_influence}.")

    def prepare(self, system, formulation, solver, rtol):
        if not isinstance(solver, Adams):
            raise ValueError(
                f"Partition needs a solver that knows charts (Adams), got {type(solver).__name__}; use manifold=Projection() with it."
            )
        floor = 64 * float(jnp.finfo(system.guess.q.dtype).eps)
        tol = min(max(1e-3 * rtol, floor), 1e-6) if self.newton_tol is None else self.newton_tol
        return PartitionTerm(system, formulation, self.max_influence, tol), solver


class Chart(eqx.Module):
    """A split with its quality and counters.

    **Fields:** `split`; `influence`: largest scaled |H| at the last evaluation; `pivot`: smallest pivot when the chart was made;
    `age`: steps since the position factor was refreshed; `iterations`: of the last position Newton; `newton`: all of them;
    `charts`: charts made; `singular`: whether the rank fell.
    """

    split: Split
    influence: Float[Array, ""]
    pivot: Float[Array, ""]
    age: Int[Array, ""]
    iterations: Int[Array, ""]
    newton: Int[Array, ""]
    charts: Int[Array, ""]
    singular: Array


class PartitionTerm(AbstractManifoldTerm):
    """A constrained system as a term that knows its charts."""

    system: AbstractSystem
    formulation: AbstractFormulation
    max_influence: float = eqx.field(static=True)
    newton_tol: float = eqx.field(static=True)

    def vf(self, t, y, args):
        return VectorField(self.system, self.formulation)(t, y, args)

    def contr(self, t0, t1, **kwargs):
        del kwargs
        return t1 - t0

    def prod(self, vf, control):
        return jax.tree.map(lambda v: control * v, vf)

    def init_chart(self, t, y, args):
        system, y = lax.stop_gradient((self.system, y))
        split, influence, pivot, singular = _choose(system, t, y)
        zero = jnp.array(0)
        return Chart(split, influence, pivot, zero, zero, zero, jnp.array(1), singular)

    def evaluate(self, t, y, chart, args):
        chart = lax.stop_gradient(chart)
        out = evaluate(self.system, self.formulation, t, y.q, y.u, chart.split, self.newton_tol)
        iterations = chart.newton + out.iterations
        split = chart.split
        if shared(self.system):
            split = eqx.tree_at(lambda s: s.correction, split, lax.stop_gradient(out.factor.correction))
        influence = chart.influence if self.system.velocity_rows == 0 else _influence(self.system, out.factor, split)
        chart = Chart(
            split, influence, chart.pivot, chart.age, out.iterations, iterations, chart.charts, chart.singular
        )
        f = State(self.system.rates(t, out.q, out.u), out.udot)
        return State(out.q, out.u), f, chart, out.failed | chart.singular

    def free(self, chart):
        split = chart.split
        return State(
            jnp.argsort(split.coordinate_columns) >= self.system.coordinate_rank,
            jnp.argsort(split.velocity_columns) >= self.system.velocity_rank,
        )

    def update_chart(self, t, y, chart, args):
        system, y, chart = lax.stop_gradient((self.system, y, chart))
        poor = chart.influence > self.max_influence
        if not shared(system) and system.coordinate_rank > 0:
            stale = poor | (chart.age >= _AGE) | (chart.iterations >= _SLOW)

            def refresh(chart):
                solved = coordinate_factor(system, t, y.q, chart.split)
                split = eqx.tree_at(lambda s: s.correction, chart.split, solved.correction)
                influence = _scaled(solved.basis, system.coordinate_scale(), split.coordinate_columns, system.coordinate_rank)
                return split, jnp.maximum(influence, chart.influence), jnp.zeros_like(chart.age)

            split, influence, age = _any_lane(
                stale, refresh, lambda chart: (chart.split, chart.influence, chart.age + 1), chart
            )
            poor = influence > self.max_influence
            chart = Chart(
                split, chart.influence, chart.pivot, age, chart.iterations, chart.newton, chart.charts, chart.singular
            )

        def renew(chart):
            split, influence, pivot, singular = _choose(system, t, y)
            zero = jnp.zeros_like(chart.age)
            return Chart(split, influence, pivot, zero, chart.iterations, chart.newton, chart.charts + 1, singular)

        return _any_lane(poor, renew, lambda chart: chart, chart)


def _choose(system, t, y):
    """A chart by full pivoting."""
    velocity_jacobian = system.jacobian(t, y.q, y.u)
    velocity = full_pivot(velocity_jacobian, scale=system.velocity_scale(), stage=stages(system))
    singular = velocity.rank != system.velocity_rank
    coordinate = velocity
    if not shared(system):
        coordinate = full_pivot(system.coordinate_jacobian(t, y.q), scale=system.coordinate_scale())
        singular = singular | (coordinate.rank != system.coordinate_rank)
    empty = jnp.zeros((system.nq, system.coordinate_rows), y.q.dtype)
    split = Split(coordinate.rows, coordinate.columns, velocity.rows, velocity.columns, empty)
    if system.coordinate_rank > 0:
        correction = coordinate_factor(system, t, y.q, split).correction
        split = eqx.tree_at(lambda s: s.correction, split, correction)
    pivot = jnp.minimum(velocity.smallest, coordinate.smallest)
    return split, jnp.ones((), y.q.dtype), pivot, singular


def _influence(system, solved, split):
    return _scaled(lax.stop_gradient(solved.basis), system.velocity_scale(), split.velocity_columns, system.velocity_rank)


def _scaled(basis, scale, columns, rank):
    """Largest entry of the influence matrix in units of the coordinates' scales."""
    return jnp.max(jnp.abs(basis) * scale[columns[rank:]][None, :] / scale[:, None], initial=1.0)


def _any_lane(pred, true_fn, false_fn, operand):
    """`lax.cond` that stays a branch under `vmap`: taken if any lane wants it, kept only by those that do."""
    new = lax.cond(eqxi.unvmap_any(pred), true_fn, false_fn, operand)
    return jax.tree.map(lambda a, b: jnp.where(pred, a, b), new, false_fn(operand))
