"""The steps of any solver, differentiated as they are."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from .controller import MultistepController
from .evaluation import ravel, unravel_like
from .multistep import AbstractMultistep
from .one_step import OneStepController, WithTangents
from .steps import AbstractSteps, LinearStep


class WholeSteps(AbstractSteps):
    """The steps of any solver, differentiated as they are.

    **Fields:** the `solver`, whose states are those of the run or, if they are `watched`, the first parts of them;
    `jumps`: whether steps may begin after a jump.
    """

    solver: Any
    watched: bool = eqx.field(static=True)
    jumps: bool = eqx.field(static=True)

    def row(self, terms, before, after):
        del terms, after
        jump = jnp.asarray(before.made_jump) if self.jumps else None
        return before.tprev, before.tnext, before.y, self._own(before.solver_state), jump

    def memory(self, solver_state):
        return self._smooth(self._own(solver_state))

    def _own(self, solver_state):
        """A solver state without tangents."""
        if isinstance(self.solver, AbstractMultistep):
            return eqx.tree_at(lambda state: state.tangents, solver_state, None, is_leaf=_is_none)
        return solver_state[0] if self.watched else solver_state

    def _smooth(self, state):
        """The numbers that a step depends on smoothly, with None for all others."""
        if isinstance(self.solver, AbstractMultistep):
            none = jax.tree.map(lambda _: None, state)
            return eqx.tree_at(lambda state: state.memory, none, state.memory, is_leaf=_is_none)
        return eqx.filter(state, eqx.is_inexact_array)

    def linearised(self, of, moved, like, row):
        t0, t1, y0, state, jump = row
        if moved.jumps is not None:
            raise ValueError(
                "Derivatives by the times of jumps are known to jaxmb.solvers.Adams only, got "
                f"{type(self.solver).__name__}: use that, or stop_gradient for the times."
            )

        def step(moved, flat, memory):
            terms, args = of(moved.terms)
            before = eqx.combine(memory, state)
            out = self.solver.step(terms, t0, t1, unravel_like(y0, flat), args, before, False if jump is None else jump)
            dense, still = eqx.partition(out[2], eqx.is_inexact_array)
            return (ravel(out[0]), self._smooth(out[3]), dense), still

        (_, _, dense), push, still = jax.linearize(step, moved, ravel(y0), self._smooth(state), has_aux=True)

        def at(ddense, t):
            value = lambda dense: ravel(
                self.solver.interpolation_cls(t0=t0, t1=t1, **eqx.combine(dense, still)).evaluate(t)
            )
            return jax.jvp(value, (dense,), (ddense,))[1]

        return LinearStep(push, at)

    def row_tangent(self, row, like, before, after):
        del row, after
        w, memory = before
        return None, None, unravel_like(like, w), memory, None


def steps_of(solver: Any, controller: Any) -> AbstractSteps:
    """The steps of a solver, without the tangents that it carries along."""
    still = (MultistepController, OneStepController, diffrax.PIDController, diffrax.ConstantStepSize, diffrax.StepTo)
    jumps = not isinstance(controller, still)
    if isinstance(solver, AbstractMultistep):
        solver = eqx.tree_at(lambda s: s.tangent_control, solver, None, is_leaf=_is_none)
        own = solver.linear_steps(jumps)
        return WholeSteps(solver, False, jumps) if own is None else own
    if isinstance(solver, WithTangents):
        return WholeSteps(solver.inner, True, jumps)
    return WholeSteps(solver, False, jumps)


def jump_times(controller: Any) -> Any:
    """The times of jumps that a step size controller knows, or None."""
    # A concrete class, which alone has such times.
    return controller.jump_ts if isinstance(controller, diffrax.ClipStepSizeController) else None


def _is_none(x):
    return x is None
