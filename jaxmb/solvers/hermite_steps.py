"""A step of `Hermite` as a linear map.

Where a step ends is known, so that its equation need not be solved again: its derivative is that of the solution, by
the implicit function theorem. It is the exact derivative of the step.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .evaluation import ravel, unravel_like
from .steps import AbstractSteps, LinearStep, refuse_moving_jumps


class HermiteRow(eqx.Module):
    """What is stored of a step.

    **Fields:** its start `t0` and end `t1`; the state of the solver `before` it, without the matrix of Newton's
    method, which the result does not depend on; the raveled states at both ends; whether it `made_jump` at its start,
    None where steps have none.
    """

    t0: Any
    t1: Any
    before: Any
    start: Float[Array, " n"]
    end: Float[Array, " n"]
    made_jump: Any


class HermiteSteps(AbstractSteps):
    """The steps of `Hermite`; `jumps`: whether they may begin after a jump."""

    jumps: bool = eqx.field(static=True)

    def row(self, terms, before, after):
        del terms
        made_jump = jnp.asarray(before.made_jump) if self.jumps else None
        own = self.alone(before.solver_state)
        own = own if self.jumps else eqx.tree_at(lambda state: state.matrix, own, None)
        return HermiteRow(before.tprev, before.tnext, own, ravel(before.y), ravel(after.y), made_jump)

    def alone(self, solver_state):
        return solver_state.alone()

    def chosen(self, solver_state):
        return solver_state.chosen

    def memory(self, solver_state):
        return solver_state.memory

    def linearised(self, of, moved, like, row):
        *_, solver = of(moved.terms)
        refuse_moving_jumps(moved, solver)

        def step(moved, flat, memory):
            terms, args, solver = of(moved.terms)
            y, jumped = unravel_like(like, flat), row.made_jump
            state = eqx.tree_at(lambda state: state.memory, row.before, memory)
            y, state = solver.restarted(terms, row.t0, row.t1, y, args, state, False if jumped is None else jumped)
            found = solver.attempt_to(terms, row.t1, ravel(y), like, args, state, row.end)
            dense, still = eqx.partition(solver.dense_info(found, like, state.order_index), eqx.is_inexact_array)
            return (found.after, found.memory, dense), still

        (_, _, dense), push, still = jax.linearize(step, moved, row.start, row.before.memory, has_aux=True)

        def at(ddense, t):
            interpolation = lambda dense: solver.interpolation_cls(t0=row.t0, t1=row.t1, **eqx.combine(dense, still))
            return jax.jvp(lambda dense: ravel(interpolation(dense).evaluate(t)), (dense,), (ddense,))[1]

        return LinearStep(push, at)

    def row_tangent(self, row, like, before, after):
        # The end follows from the rest.
        del after
        none, parts = jax.tree.map(lambda _: None, row), lambda row: (row.start, row.before.memory)
        return eqx.tree_at(parts, none, before, is_leaf=lambda x: x is None)
