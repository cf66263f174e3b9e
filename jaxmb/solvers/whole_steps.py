"""The steps of any solver, differentiated as they are."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from .._compat import with_loops
from .controller import MultistepController
from .evaluation import freeze, ravel, unravel_like
from .multistep import AbstractMultistep
from .one_step import OneStepController, WithTangents
from .steps import AbstractSteps, LinearStep, refuse_moving_jumps


class WholeSteps(AbstractSteps):
    """The steps of any solver, differentiated as they are, also by the numbers of the solver.

    **Fields:** `multistep`: whether the solver is a multistep method, which names the numbers that a step depends on
    smoothly; `watched`: whether the solver of the run carries tangents (`WithTangents`), so that the plain solver's
    state is the first part of its states; `jumps`: whether steps may begin after a jump.
    """

    multistep: bool = eqx.field(static=True)
    watched: bool = eqx.field(static=True)
    jumps: bool = eqx.field(static=True)

    def row(self, terms, before, after):
        del terms, after
        jump = jnp.asarray(before.made_jump) if self.jumps else None
        return before.tprev, before.tnext, before.y, self.alone(before.solver_state), jump

    def alone(self, solver_state):
        if self.multistep:
            return solver_state.alone()
        return solver_state[0] if self.watched else solver_state

    def chosen(self, solver_state):
        return solver_state.chosen if self.multistep else None

    def of_solver_alone(self):
        return dataclasses.replace(self, watched=False)

    def memory(self, solver_state):
        return self._smooth(self.alone(solver_state))

    def _smooth(self, state):
        """The numbers that a step depends on smoothly, with None for all others."""
        if self.multistep:
            none = jax.tree.map(lambda _: None, state)
            return eqx.tree_at(lambda state: state.memory, none, state.memory, is_leaf=_is_none)
        return eqx.filter(state, eqx.is_inexact_array)

    def linearised(self, of, moved, like, row):
        t0, t1, y0, state, jump = row
        *_, solver = of(moved.terms)
        refuse_moving_jumps(moved, solver)

        def step(moved, flat, memory):
            terms, args, solver = of(moved.terms)
            before = eqx.combine(memory, state)
            made_jump = False if jump is None else jump
            out = solver.step(terms, t0, t1, unravel_like(y0, flat), args, before, made_jump)
            dense, still = eqx.partition(out[2], eqx.is_inexact_array)
            return (ravel(out[0]), self._smooth(out[3]), dense), still

        (_, _, dense), push, still = jax.linearize(step, moved, ravel(y0), self._smooth(state), has_aux=True)

        def at(ddense, t):
            value = lambda dense: ravel(solver.interpolation_cls(t0=t0, t1=t1, **eqx.combine(dense, still)).evaluate(t))
            return jax.jvp(value, (dense,), (ddense,))[1]

        return LinearStep(push, at)

    def row_tangent(self, row, like, before, after):
        del row, after
        w, memory = before
        return None, None, unravel_like(like, w), memory, None


def steps_of(solver: Any, controller: Any) -> tuple[AbstractSteps, Any]:
    """The steps of a solver, and the solver without the tangents that it carries along."""
    jumpless = (MultistepController, OneStepController, diffrax.PIDController, diffrax.ConstantStepSize, diffrax.StepTo)
    # Concrete classes, since no attribute tells that a controller knows no jumps.
    if isinstance(controller, diffrax.ClipStepSizeController) and controller.jump_ts is None:
        controller = controller.controller
    jumps = not isinstance(controller, jumpless)
    if isinstance(solver, AbstractMultistep):
        # A multistep method has no numbers but its tolerances.
        untracked = freeze(eqx.tree_at(lambda s: s.tangent_control, solver, None, is_leaf=_is_none))
        steps = untracked.linear_steps(jumps)
        return WholeSteps(True, False, jumps) if steps is None else steps, untracked
    # A concrete class: only this one holds another solver beside tangents.
    watched = isinstance(solver, WithTangents)
    # Loops over stages in the form that both modes can differentiate.
    return WholeSteps(False, watched, jumps), with_loops(solver.solver if watched else solver, "bounded")


def jump_times(controller: Any) -> Any:
    """The times of jumps that a step size controller knows, or None."""
    # A concrete class: no other has such times.
    return controller.jump_ts if isinstance(controller, diffrax.ClipStepSizeController) else None


def _is_none(x):
    return x is None
