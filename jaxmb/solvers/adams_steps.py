"""The formulas of a step of Adams' method, and the step as a linear map.

A step evaluates its field twice, at a prediction and at the corrected state, which differ by the local error. The
tangent of a step uses one linearisation for both, at the corrected state, which is on its manifold and has a known
field. So nothing is solved, and little of a step is stored. The linear map is the same method, applied to the tangent
equation on the mesh of the motion. It differs from the derivative of the step by less than the tangent's local error.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ._history import INDEX, basis_means, known_differences, start, step_end, sums_before
from ._interpolation import RateInterpolation
from .evaluation import at_solution, guards_of, kept_of_chart, ravel, unravel_like
from .restarts import AtRestart, Jump, restarts
from .steps import AbstractSteps, LinearStep


class Coefficients(eqx.Module):
    """The coefficients of a step.

    **Fields:** its length `h` and its `end`; for each divided difference, `means` of its term over the step in the
    polynomial through the last k derivatives, and `values` of its term at the end; `order` k; `last`: the integral that
    multiplies a new derivative in the corrector; `differences` of such integrals for three orders.
    """

    h: Float[Array, ""]
    end: Any
    means: Float[Array, " length"]
    values: Float[Array, " length"]
    order: Int[Array, ""]
    last: Float[Array, ""]
    differences: Float[Array, "3"]

    def mean(self, differences: Float[Array, "length n"]) -> Float[Array, " n"]:
        """The mean over the step of the polynomial through the last k derivatives."""
        return self.means @ differences

    def sums(self, differences: Float[Array, "length n"]) -> tuple[Array, Array]:
        """Values at the end of the step of the polynomials through the last 0, 1, 2, ... derivatives, and through the
        last k - 1, k and k + 1.
        """
        every, total = sums_before(self.values[:, None] * differences)
        return every, lax.dynamic_slice_in_dim(jnp.concatenate([every, total[None]]), self.order - 1, 3)


def coefficients(mesh: Float[Array, " length"], order: Int[Array, ""], t1: Any, dtype: Any) -> Coefficients:
    """The coefficients of a step of an order from the latest point of a mesh to `t1`."""
    h = (t1 - mesh[0]).astype(dtype)
    end = step_end(mesh, t1)
    means, values = basis_means(mesh, mesh[0], end)
    means, values = means.astype(dtype), values.astype(dtype)
    integrals = means / values
    padded = jnp.concatenate([jnp.zeros(1, dtype), integrals, integrals[-1:]])
    # The integrals of the terms k - 2 to k + 1; the term k belongs to the new derivative.
    integrals = lax.dynamic_slice_in_dim(padded, order - 1, 4)
    means = jnp.where(order > INDEX, means, jnp.zeros((), dtype))
    return Coefficients(h, end, means, values, order, integrals[2], jnp.diff(integrals))


class AdamsRow(eqx.Module):
    """The stored numbers of a step, or of the start of a run.

    **Fields:** its `end`; the `mesh`, the `order` and the number of `known` points at its start; state `y` and field
    `f` at its end; `kept`: the numbers kept of the chart there; `jump` at its start, None if steps have none. In the
    row of a start the order is zero, `known` is zero unless the memory is given, and y, f and the chart belong to the
    start.
    """

    end: Any
    mesh: Float[Array, " length"]
    order: Int[Array, ""]
    known: Int[Array, ""]
    y: Float[Array, " n"]
    f: Float[Array, " n"]
    kept: Any
    jump: Jump | None


class AdamsSteps(AbstractSteps):
    """The steps of `Adams`.

    **Fields:** `jumps`: whether they may begin after a jump; `evaluates`: whether the first step after a jump evaluates
    only at its start and at its end; `begins`: whether the run begins with a jump.
    """

    jumps: bool = eqx.field(static=True)
    evaluates: bool = eqx.field(static=True, default=True)
    begins: bool = eqx.field(static=True, default=False)

    def after_first_jump(self):
        return dataclasses.replace(self, begins=True)

    def row(self, terms, before, after):
        old, new = before.solver_state, after.solver_state
        mesh, order, count, jump = old.history.mesh, old.order, jnp.maximum(old.history.known, 1), None
        if self.jumps:
            made = jnp.asarray(before.made_jump)
            first = start(before.tprev, new.history.differences[0], before.tnext - before.tprev)
            of_start = first.mesh, jnp.ones_like(order), first.known
            mesh, order, count = jax.tree.map(lambda a, b: jnp.where(made, a, b), of_start, (mesh, order, count))
            last = jnp.where(old.history.known > 0, old.history.mesh[0], before.tprev)
            restart = self._restart(terms, new)
            jump = Jump(made, last, before.tprev, ravel(before.y), old.history.differences[0], old.chart, restart)
        kept = kept_of_chart(terms, new.chart)
        return AdamsRow(before.tnext, mesh, order, count, ravel(after.y), new.history.differences[0], kept, jump)

    def _restart(self, terms, after):
        """The numbers known after one step from a restart, for terms with guards, else None. Without guards there are
        second derivatives, which would need the tangent of the field.
        """
        if guards_of(terms) is None or not self.evaluates:
            return None
        return AtRestart(after.found, *_at_start(terms, after))

    def alone(self, solver_state):
        return solver_state.alone()

    def chosen(self, solver_state):
        return solver_state.chosen

    def again(self, solver, *step):
        return solver.step_again(*step)

    def memory(self, solver_state):
        return solver_state.memory

    @property
    def starts(self):
        # A run that begins with a jump has no field before it.
        return not self.begins

    def start(self, terms, before, after):
        first_row, count = self.row(terms, before, after), before.solver_state.history.known
        given = (count > 0) | jnp.asarray(before.made_jump)
        if first_row.jump is not None:
            first_row = eqx.tree_at(lambda row: row.jump.made, first_row, jnp.zeros_like(first_row.jump.made))
        f, kept = _at_start(terms, after.solver_state)
        numbers = jnp.zeros_like(first_row.order), given.astype(count.dtype), ravel(before.y), f, kept
        return eqx.tree_at(
            lambda row: (row.order, row.known, row.y, row.f, row.kept), first_row, numbers, is_leaf=lambda x: x is None
        )

    def linearised(self, of, moved, like, row):
        begins = row.order == 0 if self.starts else jnp.array(False)
        time = jnp.where(begins, row.mesh[0], row.end)

        def at(of_terms, flat):
            terms, args, _ = of(of_terms)
            return at_solution(terms, time, flat, row.f, like, row.kept, args)

        _, field = jax.linearize(at, moved.terms, row.y)
        formulas = coefficients(row.mesh, row.order, row.end, row.y.dtype)
        h = jnp.where(begins, 0.0, formulas.h)
        used = (row.order >= INDEX)[:, None]
        jump = row.jump
        restart = None if jump is None else restarts(of, moved, like, jump, lambda field, t, y: field(t, y)[0])

        def push(dmoved, w, memory):
            if jump is not None and restart is not None:
                new, f = restart(dmoved, w, memory[0])
                restarted = jnp.concatenate([f[None], jnp.zeros_like(memory[1:])])
                w, memory = jnp.where(jump.made, new, w), jnp.where(jump.made, restarted, memory)
            partial_sums, neighbours = formulas.sums(memory)
            predicted = w + h * formulas.mean(memory)

            def evaluated(before, _):
                w, f = field(dmoved.terms, before[0])
                corrected = predicted + h * formulas.last * (f - neighbours[1])
                return (corrected, w, f), None

            # A loop, so that both evaluations share one program, and one transpose.
            none = jnp.zeros_like(predicted)
            (corrected, after, f), _ = lax.scan(evaluated, (predicted, none, none), length=2)
            of_start = jnp.where(row.known == 0, jnp.zeros_like(memory).at[0].set(f), memory)
            memory = jnp.where(begins, of_start, known_differences(row.known, f, partial_sums))
            mismatch, w = corrected - after, jnp.where(begins, w, after)
            zero = jnp.zeros((), w.dtype)
            dense = {"y1": unravel_like(like, w), "differences": jnp.where(used, memory, zero), "mesh": None}
            return w, memory, dense | {"mismatch": mismatch}

        mesh = jnp.concatenate([formulas.end[None], row.mesh[:-1]])

        def within(dense, t):
            # Dense output is linear in everything but the mesh.
            return ravel(RateInterpolation(row.mesh[0], row.end, **dense | {"mesh": mesh}).evaluate(t))

        return LinearStep(push, within)

    def row_tangent(self, row, like, before, after):
        w, memory = after
        none = jax.tree.map(lambda _: None, row)
        parts = lambda row: (row.y, row.f)
        out = eqx.tree_at(parts, none, (w, memory[0]), is_leaf=lambda x: x is None)
        if row.jump is None:
            return out
        parts = lambda row: (row.jump.y, row.jump.f)
        return eqx.tree_at(parts, out, (before[0], before[1][0]), is_leaf=lambda x: x is None)


def _at_start(terms, after):
    """The field at a start, and the numbers kept of the chart there, from the state of the solver after one step."""
    # `change`: the derivative at the end of the step minus the derivative at its start.
    last, change, *_ = after.history.differences
    return last - change, kept_of_chart(terms, after.chart, at_start=True)
