"""The error control of tangents for one-step methods, and the controller that takes them into account."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ._evaluation import ravel, unravel_like
from ._multistep import AbstractMultistep
from ._tangent import Tangent, TangentControl, pushed, pushed_only
from ._wrapped import WrappedSolver


class WithTangents(WrappedSolver):
    """A one-step solver that carries tangents along, in its state."""

    control: TangentControl
    rtol: Any

    def init(self, terms, t0, t1, y0, args):
        start = lambda terms, y0: self.solver.init(terms, t0, t1, y0, args)
        tangents = []
        for of_terms, w in zip(self.control.of_terms(terms), self.control.starts(), strict=True):
            memory = pushed_only(start, (terms, y0), (of_terms, unravel_like(y0, w)))
            tangents.append(Tangent(w, memory, self.control.largest(w)))
        return start(terms, y0), tangents

    # Compiled inside the whole program, so that it is traced once.
    @eqx.filter_jit
    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        state, before = solver_state
        step = lambda solver: eqx.Partial(_step_from, solver, t0, t1, args, made_jump)
        of_terms = self.control.of_terms(terms)
        along = tuple((of, unravel_like(y0, x.w), x.memory) for of, x in zip(of_terms, before, strict=True))
        # Loops over stages in the form of the adjoint have no forward derivatives.
        out, along = pushed(step(self.with_loops("lax")), (terms, y0, state), along, step(self.inner))
        y1, error, dense_info, state, result = out
        tangents, errors = [], []
        for tangent, (dy1, derror, _, memory, _) in zip(before, along, strict=True):
            w = ravel(dy1)
            tangents.append(Tangent(w, memory, jnp.maximum(tangent.peak, self.control.largest(w))))
            errors.append(ravel(derror) / self.control.scale(self.rtol, tangent, w))
        return y1, ErrorWithTangents(error, errors), dense_info, (state, tangents), result


def _step_from(solver, t0, t1, args, made_jump, terms, y0, state):
    return solver.step(terms, t0, t1, y0, args, state, made_jump)


def with_tangents(solver: Any, controller: Any, control: TangentControl) -> tuple[Any, Any, Callable[[Any], Any]]:
    """A solver and its step size controller, with the errors of tangents controlled as well, and a function that
    removes the tangents from the solver's state.

    A controller that measures no error stays as it is, and so does the solver.
    """
    if isinstance(solver, AbstractMultistep):
        if solver.tolerances.fixed:
            return solver, controller, lambda state: state
        solver = eqx.tree_at(lambda s: s.tangent_control, solver, control, is_leaf=lambda x: x is None)
        return solver, controller, lambda state: eqx.tree_at(lambda s: s.tangents, state, ())
    is_pid = lambda x: isinstance(x, diffrax.PIDController)
    found = [x for x in jax.tree.leaves(controller, is_leaf=is_pid) if is_pid(x)]
    if not found:
        return solver, controller, lambda state: state
    watched = lambda x: ControllerWithTangents(x.rtol, x.atol, x.norm, x) if is_pid(x) else x
    controller = jax.tree.map(watched, controller, is_leaf=is_pid)
    return WithTangents(solver, control, found[0].rtol), controller, lambda state: state[0]


class ErrorWithTangents(NamedTuple):
    """The error estimate of a state, and those of tangents in units of the tolerance."""

    error: PyTree
    of_tangents: list[Float[Array, " n"]]


class ControllerWithTangents(diffrax.AbstractAdaptiveStepSizeController):
    """A PID controller of the largest of several errors, of the state and of tangents; `rtol`, `atol` and `norm` are
    those of `controller`.
    """

    rtol: Any
    atol: Any
    norm: Callable[[PyTree], Any]
    controller: diffrax.PIDController

    def wrap(self, direction):
        controller: Any = self.controller.wrap(direction)
        return eqx.tree_at(lambda c: c.controller, self, controller)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error: Any, error_order, controller_state):
        norm, like = self.norm, ravel(y0)
        # The controller divides by its tolerances. Those of the tangents have been applied: for them it divides by one.
        every = lambda errors: functools.reduce(jnp.maximum, map(norm, errors))
        controller = eqx.tree_at(lambda c: c.norm, self.controller, every)
        zero, one = unravel_like(y0, jnp.zeros_like(like)), unravel_like(y0, jnp.ones_like(like))
        with jax.numpy_dtype_promotion("standard"):
            of_tangents = [unravel_like(y0, error * (self.atol + self.rtol)) for error in y_error.of_tangents]
        count = len(of_tangents)
        before, after, errors = (y0, *[zero] * count), (y1_candidate, *[one] * count), (y_error.error, *of_tangents)
        return controller.adapt_step_size(t0, t1, before, after, args, errors, error_order, controller_state)
