"""One-step methods that carry tangents along, and their controller, which also knows running scales."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._compat import with_loops
from .controller import AbstractControllerState, MultistepController
from .evaluation import ravel, unravel_like
from .events import error_of, map_error
from .multistep import AbstractMultistep
from .scales import RunningScales
from .tangent import Tangent, TangentControl, pushed, pushed_only
from .tolerances import MultistepNorm, NormOfCounted, Tolerances
from .wrapped import AbstractSolverAround


class WithTangents(AbstractSolverAround):
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

    # A nested program, so that the step is traced once.
    @eqx.filter_jit
    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        state, before = solver_state
        step = lambda solver: eqx.Partial(_step_from, solver, t0, t1, args, made_jump)
        of_terms = self.control.of_terms(terms)
        along = tuple((of, unravel_like(y0, x.w), x.memory) for of, x in zip(of_terms, before, strict=True))
        # Loops over stages that can be differentiated in both modes are slower in forward mode.
        out, along = pushed(step(with_loops(self.solver, "lax")), (terms, y0, state), along, step(self.solver))
        y1, error, dense_info, state, result = out
        tangents, errors = [], []
        scales = self.control.scales(self.rtol, before, [ravel(dy1) for dy1, *_ in along])
        for tangent, scale, (dy1, derror, _, memory, _) in zip(before, scales, along, strict=True):
            w = ravel(dy1)
            tangents.append(Tangent(w, memory, jnp.maximum(tangent.peak, self.control.largest(w))))
            errors.append(ravel(error_of(derror)) / scale)
        error = map_error(lambda of_state: ErrorWithTangents(of_state, errors), error)
        return y1, error, dense_info, (state, tangents), result


def _step_from(solver, t0, t1, args, made_jump, terms, y0, state):
    return solver.step(terms, t0, t1, y0, args, state, made_jump)


def with_counted(controller: Any, counted: tuple[int, ...] | None) -> Any:
    """A controller that measures the errors of some components only, with the indices `counted` in the raveled state
    (None: all). A controller that measures no errors is unchanged.
    """
    if counted is None:
        return controller
    # A controller may be wrapped in others of diffrax.
    norms = {
        MultistepController: lambda x: (x.norm.norm,),
        OneStepController: lambda x: (x.norm, x.controller.norm),
        diffrax.PIDController: lambda x: (x.norm,),
    }
    is_known = lambda x: isinstance(x, tuple(norms))

    def of_counted(x):
        where = next((select for kind, select in norms.items() if isinstance(x, kind)), None)
        return x if where is None else eqx.tree_at(where, x, replace_fn=lambda norm: NormOfCounted(norm, counted))

    return jax.tree.map(of_counted, controller, is_leaf=is_known)


def with_tangents(solver: Any, controller: Any, control: TangentControl) -> tuple[Any, Any, Callable[[Any], Any]]:
    """A solver and its step size controller that also control the errors of tangents, and a function that removes the
    tangents from the solver's state.

    A controller that measures no error is unchanged, and so is its solver.
    """
    if isinstance(solver, AbstractMultistep):
        if solver.tolerances.fixed:
            return solver, controller, lambda state: state
        solver = eqx.tree_at(lambda s: s.tangent_control, solver, control, is_leaf=lambda x: x is None)
        return solver, controller, lambda state: eqx.tree_at(lambda s: s.tangents, state, None)
    kinds = (diffrax.PIDController, OneStepController)
    # Concrete classes, since a controller may be wrapped in others of diffrax.
    is_known = lambda x: isinstance(x, kinds)
    controllers = [x for x in jax.tree.leaves(controller, is_leaf=is_known) if is_known(x)]
    if not controllers:
        return solver, controller, lambda state: state

    def watched(x):
        if not is_known(x):
            return x
        with_scales = OneStepController.around(x) if isinstance(x, diffrax.PIDController) else x
        return dataclasses.replace(with_scales, tangents=True)

    controller = jax.tree.map(watched, controller, is_leaf=is_known)
    return WithTangents(solver, control, controllers[0].rtol), controller, lambda state: state[0]


class ErrorWithTangents(NamedTuple):
    """The error estimate of a state, and the errors of tangents in units of the tolerance."""

    error: PyTree
    of_tangents: list[Float[Array, " n"]]


class OneStepState(AbstractControllerState):
    """The state of `OneStepController`.

    **Fields:** `inner`: the state of the controller inside; the running `sizes`; `least`: the least step that is tried;
    `intended`: the length of the next step.
    """

    inner: Any
    sizes: Float[Array, " sizes"] | None
    least: Float[Array, ""]
    intended: Float[Array, ""]


class OneStepController(diffrax.AbstractAdaptiveStepSizeController):
    """A PID controller of the error of a state, and of `tangents` if the solver carries them along. Errors are in units
    of tolerances, which may be relative to running `scales`. `rtol`, `atol` and `norm` are taken from `controller`.
    """

    rtol: Any
    atol: Any
    norm: Callable[[PyTree], Any]
    controller: diffrax.PIDController
    scales: RunningScales | None = None
    tangents: bool = eqx.field(static=True, default=False)

    @classmethod
    def around(cls, controller: Any, scales: RunningScales | None = None) -> "OneStepController":
        """A controller with the tolerances of a PID controller."""
        return cls(controller.rtol, controller.atol, controller.norm, controller, scales)

    def wrap(self, direction):
        controller: Any = self.controller.wrap(direction)
        return dataclasses.replace(self, controller=controller)

    def init(self, terms, t0: Any, t1, y0, dt0, args, func, error_order):
        least = jnp.finfo(t0.dtype).eps * jnp.abs(t1 - t0)
        dtmax = self.controller.dtmax
        if self.scales is None:
            first, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
            if dtmax is not None:
                first = jnp.minimum(first, t0 + jnp.asarray(dtmax, t0.dtype))
            return first, OneStepState(state, None, least, first - t0)
        flat = ravel(y0)
        sizes = self.scales.start(flat, ravel(func(terms, t0, y0, args)))
        # The first step is chosen in units of these sizes, and of the time in which they change. It then does not
        # depend on other units, and the absolute tolerance is the same for all components.
        unit, rate = self.scales.of_components(sizes), self.scales.rate(sizes).astype(t0.dtype)

        def field(terms, t, y, args):
            f = func(terms, t / rate, unravel_like(y0, ravel(y) * unit), args)
            return unravel_like(y0, ravel(f) / (unit * rate))

        y0 = unravel_like(y0, flat / unit)
        dt0 = None if dt0 is None else dt0 * rate
        first, state = self.controller.init(terms, t0 * rate, t1 * rate, y0, dt0, args, field, error_order)
        intended = (first - t0 * rate) / rate
        if dtmax is not None:
            intended = jnp.minimum(intended, jnp.asarray(dtmax, t0.dtype))
        return t0 + intended, OneStepState(state, sizes, least, intended)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error: Any, error_order, controller_state):
        state, sizes, least = controller_state.inner, controller_state.sizes, controller_state.least
        of_state, of_tangents = (y_error.error, y_error.of_tangents) if self.tangents else (y_error, [])
        scale = Tolerances(self.rtol, self.atol, MultistepNorm(self.norm, self.scales)).scale(
            ravel(y0), ravel(y1_candidate), t1 - t0, sizes
        )
        errors = [self.norm(unravel_like(y0, error)) for error in (ravel(of_state) / scale, *of_tangents)]
        # The PID controller sees one number in units of the tolerance.
        unit = eqx.tree_at(lambda c: (c.rtol, c.atol, c.norm), self.controller, (0.0, 1.0, jnp.abs))
        zero = jnp.zeros_like(errors[0])
        error = functools.reduce(jnp.maximum, errors)
        keep, *times, made_jump, state, result = unit.adapt_step_size(
            t0, t1, zero, zero, args, error, error_order, state
        )
        # With errors that are not finite, ever smaller steps would be tried.
        stuck = jnp.logical_not(keep) & (times[1] - times[0] <= least)
        result = diffrax.RESULTS.where(stuck, diffrax.RESULTS.dt_min_reached, result)
        if self.scales is not None and sizes is not None:
            sizes = jnp.where(keep, self.scales.grown(sizes, ravel(y1_candidate)), sizes)
        state = OneStepState(state, sizes, least, times[1] - times[0])
        return keep, *times, made_jump, state, result
