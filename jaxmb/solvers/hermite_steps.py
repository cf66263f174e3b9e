"""A step of `Hermite` as a linear map.

The end of a step, known when the step is differentiated, solves `y = past + a f + b g`. So the tangent solves the
linearised equation, and nothing else is solved. Little of a step is stored, and nothing of Newton's method.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._dense import DenseLinearization
from ._field import derivatives
from ._formulas import FAMILIES, start
from ._history import History
from ._structured import structured
from .evaluation import free_components, freeze, jacobian_of, kept_of_chart, ravel, solution_of
from .restarts import Jump, restarts
from .steps import AbstractSteps, LinearStep


class HermiteRow(eqx.Module):
    """The stored numbers of a step, or of the start of a run.

    **Fields:** its `end`; the `mesh`, the number of `known` points and the `order_index` at its start; state `y` and
    field `f` at its end; `kept`: the numbers kept of the chart there; its `free` components; `jump` at its start, None
    if steps have none. In the row of a start `known` is zero, and y and f belong to the start.
    """

    end: Any
    mesh: Float[Array, " length"]
    known: Int[Array, ""]
    order_index: Int[Array, ""]
    y: Float[Array, " n"]
    f: Float[Array, " n"]
    kept: Any
    free: Int[Array, " free"]
    jump: Jump | None


class HermiteSteps(AbstractSteps):
    """The steps of `Hermite`.

    **Fields:** `jumps`: whether they may begin after a jump; the `family` of formulas; `anew`: whether a run begins
    with a state and without a memory.
    """

    jumps: bool = eqx.field(static=True)
    family: str = eqx.field(static=True)
    anew: bool = eqx.field(static=True, default=False)

    @property
    def starts(self):
        return self.anew

    def from_start(self):
        return dataclasses.replace(self, anew=True)

    def start(self, terms, before, after):
        del after
        old, flat = before.solver_state, ravel(before.y)
        history, f, jump = old.history, old.slope[-flat.size :], None
        if self.jumps:
            made = jnp.zeros_like(jnp.asarray(before.made_jump))
            jump = Jump(made, history.mesh[0], before.tprev, flat, f, old.chart, None)
        kept, free = kept_of_chart(terms, old.chart), free_components(terms, flat, old.chart)
        nothing = jnp.zeros_like(history.known)
        return HermiteRow(before.tnext, history.mesh, nothing, old.order_index, flat, f, kept, free, jump)

    def row(self, terms, before, after):
        old, new, n = before.solver_state, after.solver_state, ravel(after.y).size
        mesh, count, order_index, jump = old.history.mesh, old.history.known, old.order_index, None
        if self.jumps:
            made, f = jnp.asarray(before.made_jump), old.slope[-n:]
            first = start(FAMILIES[self.family], before.tprev, f, f, before.tnext - before.tprev)
            of_start = first.mesh, first.known, jnp.ones_like(order_index)
            here = mesh, count, order_index
            mesh, count, order_index = jax.tree.map(lambda a, b: jnp.where(made, a, b), of_start, here)
            jump = Jump(made, old.history.mesh[0], before.tprev, ravel(before.y), f, old.chart, None)
        kept, free = kept_of_chart(terms, new.chart), free_components(terms, ravel(after.y), new.chart)
        return HermiteRow(before.tnext, mesh, count, order_index, ravel(after.y), new.slope[-n:], kept, free, jump)

    def alone(self, solver_state):
        return solver_state.alone()

    def chosen(self, solver_state):
        return solver_state.chosen

    def again(self, solver, *step):
        return solver.step_again(*step)

    def memory(self, solver_state):
        return solver_state.memory

    def linearised(self, of, moved, like, row):
        terms, args, solver = of(moved.terms)
        formula = solver.formula(row.mesh, row.order_index, row.end, row.y.dtype)
        jump = row.jump
        restart = None if jump is None else restarts(of, moved, like, jump, lambda *at: derivatives(*at)[:3])

        begins = row.known == 0 if self.anew else False
        time = jnp.where(begins, row.mesh[0], row.end)

        def solution(numbers):
            new_terms, args, _ = of(numbers)
            return solution_of(new_terms, time, like, row.kept, args)

        matrix = structured(jacobian_of(*freeze((terms, time, like, args))), freeze(row.y))
        if matrix is None:
            matrix = DenseLinearization.unknown(row.y, row.free)
        step = solver.linearised(formula, (solution, moved.terms), (time, row.y, row.f), row.free, matrix, begins)

        def push(dmoved, w, memory):
            differences, slope = memory
            # At a start, the memory follows from the state.
            differences = jnp.where(begins, 0.0, differences)
            if jump is not None and restart is not None:
                new, f, g = restart(dmoved, w, slope[-w.size :])
                first, _ = solver.begun(row.mesh[0], formula.h, new, f, g)
                w = jnp.where(jump.made, new, w)
                differences = jnp.where(jump.made, first.differences, differences)
            end = step(dmoved.terms, w, History(differences, row.mesh, row.known))
            return end.after, end.memory, solver.dense_info(end, like, row.order_index) | {"mesh": None}

        none = jnp.zeros_like(row.y)
        blank, _ = solver.begun(row.mesh[0], formula.h, none, none, none)
        blank = History(blank.differences, row.mesh, row.known)
        mesh = solver.ended(formula, blank, solver.equation(formula, none, blank.differences), (none,) * 3).doubled.mesh

        def within(dense, t):
            # Dense output is linear in everything but the mesh.
            return ravel(solver.interpolation_cls(t0=row.mesh[0], t1=row.end, **dense | {"mesh": mesh}).evaluate(t))

        return LinearStep(push, within)

    def row_tangent(self, row, like, before, after):
        w, (_, slope) = after
        none = jax.tree.map(lambda _: None, row)
        out = eqx.tree_at(lambda row: (row.y, row.f), none, (w, slope[-w.size :]), is_leaf=lambda x: x is None)
        if row.jump is None:
            return out
        parts = lambda row: (row.jump.y, row.jump.f)
        return eqx.tree_at(parts, out, (before[0], before[1][1][-w.size :]), is_leaf=lambda x: x is None)
