"""The common base of the multistep solvers: tolerances, starts and restarts, and how errors are measured."""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Self

import diffrax
import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, PyTree

from .._compat import from_controller
from .directed import direction_of
from .evaluation import (
    after_jump,
    chart_after_jump,
    chart_after_step,
    check_real,
    check_term,
    derivative,
    first_chart,
    found_at_jump,
    guards_of,
    refused,
)
from .events import Crossing, cond_of_jumps, crossing, map_error
from .manifold_term import Args, Chart, Y
from .order import StepEstimate, refuse
from .packing import Layout
from .steps import AbstractSteps
from .tangent import Tangent, TangentControl, pushed, pushed_only
from .tolerances import MultistepNorm, Tolerances, norm_of

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

# The result of a step whose constraints or implicit equation were not solved. It matters only for fixed steps;
# otherwise the error is infinite.
_FAILED: Any = diffrax.RESULTS.nonlinear_divergence


class AbstractMultistepState(eqx.Module):
    """The memory of a multistep method between steps; `diffrax.SaveAt(solver_state=True)` returns it.

    **Fields:**

    - `chart`: the chart of an `AbstractManifoldTerm`, otherwise `None`.
    - `sizes`: the sizes that the absolute tolerance is relative to, with the controller's `scales`; otherwise `None`.
    - `tangents`: the tangents whose errors are controlled beside the state's error, otherwise `None`.
    """

    chart: AbstractVar[Chart | None]
    sizes: AbstractVar[Float[Array, " sizes"] | None]
    tangents: AbstractVar[tuple[Tangent, ...] | None]

    @property
    @abc.abstractmethod
    def memory(self) -> PyTree[Array]:
        """The numbers of the past that a step depends on smoothly: fields, or parts of them."""

    @property
    @abc.abstractmethod
    def chosen(self) -> PyTree[Array]:
        """The choices of the last step for the next, such as its order: fields, or parts of them; None without any."""

    def with_found(self, found: PyTree[Array]) -> Self:
        """The same after a jump, with the numbers of `AbstractManifoldTerm.found_at_jump` if the method keeps them."""
        del found
        return self

    def alone(self) -> Self:
        """The same without tangents."""
        return eqx.tree_at(lambda state: state.tangents, self, None, is_leaf=lambda x: x is None)


class AbstractAttempt(eqx.Module):
    """The numbers of a step before it is judged.

    **Fields:** `after`: the raveled state at its end.
    """

    after: AbstractVar[Float[Array, " n"]]

    @property
    @abc.abstractmethod
    def memory(self) -> PyTree[Array]:
        """The `memory` of the state at the end of the step."""


class AbstractMultistep(diffrax.AbstractImplicitSolver, diffrax.AbstractAdaptiveSolver):
    """A multistep method under a `MultistepController`.

    A new method is a subclass with diffrax's `term_structure`, `interpolation_cls` and `order`, the fields below, and
    the four methods `initial_state`, `attempt`, `advance` and `statistics`. The base calls them at starts, after jumps
    and in every step. States are raveled, one vector of all components; `evaluate` is the vector field of any term at
    such a vector, and `next_chart` follows the charts of a manifold.

    **Fields:**

    - `tolerances`: from `tolerances_of`, filled in from the controller before any other use of the solver.
    - `tangent_control`: None; set if a tangent's error is controlled.
    - `solves_implicitly`: whether a step solves an equation for the independent components of the state; an
        `AbstractManifoldTerm` must then name them (`free`).
    - `finest`: the smallest relative tolerance of a step that the method resolves, in units of the machine precision;
        default 0.
    """

    tolerances: AbstractVar[Tolerances]
    tangent_control: AbstractVar[TangentControl | None]
    solves_implicitly: AbstractVar[bool]
    finest: ClassVar[float] = 0.0

    # diffrax fills in the tolerances of a step size controller here; they are not a root finder.
    @property
    def root_finder(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.tolerances

    @property
    def root_find_max_steps(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 0

    def func(self, terms: PyTree[diffrax.AbstractTerm], t0: Any, y0: Y, args: Args) -> Y:
        return derivative(terms, t0, y0, args)

    def init(self, terms: PyTree[diffrax.AbstractTerm], t0: Any, t1: Any, y0: Y, args: Args) -> Any:
        self.tolerances.check(type(self).__name__)
        check_term(terms)
        check_real(y0)
        return self.initial_state(terms, t0, t1, y0, args, first_chart(terms, t0, y0, args), None)

    # Nested jit: a step is traced once, and not again for each loop and transformation around it.
    @eqx.filter_jit
    def step(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: Any,
        t1: Any,
        y0: Y,
        args: Args,
        solver_state: Any,
        made_jump: Any,
    ) -> tuple[Y, StepEstimate | Crossing | None, dict[str, Any], Any, diffrax.RESULTS]:
        first = y0
        y0, before = self.restarted(terms, t0, t1, y0, args, solver_state, made_jump)
        y1, estimate, dense_info, state, failed = self._advanced(terms, t1, y0, args, before)
        off = refused(terms, state.chart, before.chart)
        if off is not False:
            failed, estimate = failed | off, refuse(estimate, off)
        estimate = None if self.tolerances.fixed else estimate
        guards = guards_of(terms)
        if guards is not None:
            at = lambda t: self.interpolation_cls(t0=t0, t1=t1, **dense_info).evaluate(t)
            retry = jnp.inf if estimate is None else estimate.retry
            ends = first, y0, y1
            estimate = crossing(guards, direction_of(terms), estimate, (t0, t1), ends, at, made_jump, retry)
            # No step goes to where guards are not numbers, as beyond the edge of a terrain.
            off = jnp.isnan(estimate.lowest)
            failed = failed | off
            estimate = map_error(lambda error: error if error is None else refuse(error, off), estimate)
        result: Any = diffrax.RESULTS.successful
        if failed is not False:
            result = diffrax.RESULTS.where(failed, _FAILED, result)
        return y1, estimate, dense_info, state, result

    @eqx.filter_jit
    def step_again(self, terms, t0, t1, y0: Y, args: Args, solver_state: Any, made_jump: Any) -> tuple[Y, Any]:
        """The end of an accepted step, and the solver state there: `step` without a search for events."""
        y0, state = self.restarted(terms, t0, t1, y0, args, solver_state, made_jump)
        y1, _, _, state, _ = self._advanced(terms, t1, y0, args, state)
        return y1, state

    def _advanced(self, terms, t1, y0: Y, args: Args, state: Any):
        y1, estimate, dense_info, state, failed = self.advance(terms, t1, y0, args, state)
        chart = chart_after_step(terms, t1, y1, state.chart, args)
        state = eqx.tree_at(lambda state: state.chart, state, chart, is_leaf=lambda x: x is None)
        return y1, estimate, dense_info, state, failed

    def restarted(self, terms, t0, t1, y0: Y, args: Args, solver_state: Any, made_jump: Any) -> tuple[Y, Any]:
        """The state and the solver state, restarted after a jump and otherwise unchanged."""
        if made_jump is False:
            return y0, solver_state

        # Packed in few vectors, since most steps copy them.
        layout = Layout((y0, solver_state))

        def restarted(before):
            y0, solver_state = layout.unpacked(before)
            numbers = found_at_jump(terms, t0, y0, args)
            after = after_jump(terms, t0, y0, numbers, args)
            chart = chart_after_jump(terms, solver_state.chart)
            state = self.initial_state(terms, t0, t1, after, args, chart, solver_state).with_found(numbers)
            return layout.packed((after, state))

        cond = cond_of_jumps(guards_of(terms))
        return layout.unpacked(cond(made_jump, restarted, lambda before: before, layout.packed((y0, solver_state))))

    def linear_steps(self, jumps: bool) -> AbstractSteps | None:
        """The steps of the method as linear maps of tangents, if the method has a form cheaper than their derivatives.

        **Arguments:** `jumps`: whether steps may begin after a jump.
        """
        del jumps
        return None

    @abc.abstractmethod
    def statistics(self, solver_state: Any, controller_state: Any, stats: dict[str, Any]) -> dict[str, Any]:
        """Counts of an integration, from the final states and diffrax's `stats`.

        They include `num_evaluations` of the vector field. `SaveAt(solver_state=True, controller_state=True)` gives the
        states.
        """

    @abc.abstractmethod
    def initial_state(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: Any,
        t1: Any,
        y0: Y,
        args: Args,
        chart: Chart | None,
        before: Any,
    ) -> AbstractMultistepState:
        """The solver state at a start.

        A method that evaluates here takes two fields from `first_sizes` and `first_tangents`, and its chart from
        `next_chart`. The vector field and the choice of a chart are then compiled once more for each start; `Adams`
        leaves both to the first step.

        **Arguments:** `t1`: the end of the first attempted step; `chart`: a chart for `next_chart` at `y0`; `before`:
        the state before a jump, None at the first start.

        **Returns:** a state whose numbers are arrays of JAX.
        """

    @abc.abstractmethod
    def attempt(
        self, terms: PyTree[diffrax.AbstractTerm], t1: Any, before: Float[Array, " n"], like: Y, args: Args, state: Any
    ) -> AbstractAttempt:
        """The numbers of a step to `t1`, before it is judged; differentiable.

        **Arguments:** `before`: the raveled state at the start of the step; `like`: the same before raveling.
        """

    @abc.abstractmethod
    def advance(
        self, terms: PyTree[diffrax.AbstractTerm], t1: Any, y0: Y, args: Args, state: Any
    ) -> tuple[Y, StepEstimate, dict[str, Any], Any, Any]:
        """A step from y0 to `t1`: `(y1, estimate, dense_info, state, failed)`.

        `attempted` makes the attempt, `tolerances.of_step` and `weighted_norm` measure its error, and `choose_order`
        makes the estimate. `tangents_after`, `grown_sizes` and `next_chart` give fields of the new state. `dense_info`
        contains the arguments of the interpolation; `failed`: whether an equation was not solved.
        """

    def first_tangents(
        self, numbers: Callable[..., tuple[Array, PyTree]], terms, flat: Float[Array, " n"], before: Any
    ) -> tuple[Tangent, ...] | None:
        """The tangents at a start whose errors are controlled.

        **Arguments:** `numbers(terms, flat)`: the state on the manifold and the memory of a solver that starts there;
        `before`: the solver state before a jump, None at the first start.
        """
        control = self.tangent_control
        if control is None:
            return None
        starts = control.starts() if before is None else [tangent.w for tangent in before.tangents]
        pushes = [pushed_only(numbers, (terms, flat), at) for at in zip(control.of_terms(terms), starts, strict=True)]
        return tuple(Tangent(w, memory, control.largest(w)) for w, memory in pushes)

    def attempted(self, terms, t1, before: Float[Array, " n"], like: Y, args, state: Any) -> tuple[Any, list[Any]]:
        """The numbers of a step, and their derivatives along the tangents whose errors are controlled."""
        if self.tangent_control is None:
            return self.attempt(terms, t1, before, like, args, state), []
        step = eqx.Partial(_step_from, self, t1, like, args, state)
        of_terms = self.tangent_control.of_terms(terms)
        along = tuple((of, x.w, x.memory) for of, x in zip(of_terms, state.tangents, strict=True))
        return pushed(step, (terms, before, state.memory), along)

    def tangents_after(
        self, tangents: tuple[Tangent, ...] | None, along: list[Any]
    ) -> tuple[tuple[Tangent, ...] | None, list[Float[Array, " n"]]]:
        """The tangents at the end of a step, from the derivatives of its numbers, and the errors tolerated in them."""
        control = self.tangent_control
        if control is None or tangents is None:
            return None, []
        scales = control.scales(self.tolerances.rtol, tangents, [end.after for end in along])
        peaks = [jnp.maximum(x.peak, control.largest(end.after)) for x, end in zip(tangents, along, strict=True)]
        return tuple(Tangent(end.after, end.memory, peak) for end, peak in zip(along, peaks, strict=True)), scales

    def first_sizes(
        self, flat: Float[Array, " n"], f: Float[Array, " n"], before: Any
    ) -> Float[Array, " sizes"] | None:
        """The sizes that the absolute tolerance is relative to, at a start."""
        scales = self.tolerances.scales
        if scales is None:
            return None
        return scales.start(flat, f) if before is None else before.sizes

    def grown_sizes(
        self, sizes: Float[Array, " sizes"] | None, after: Float[Array, " n"]
    ) -> Float[Array, " sizes"] | None:
        """The sizes after a step."""
        scales = self.tolerances.scales
        return None if scales is None or sizes is None else scales.grown(sizes, after)

    def weighted_norm(self, error: Float[Array, " n"], scale: Float[Array, " n"], like: Y) -> Any:
        """The weighted norm of an error."""
        return norm_of(self.tolerances.norm, error / scale, like)


def _step_from(solver, t1, like, args, state, terms, before, memory):
    return solver.attempt(terms, t1, before, like, args, eqx.tree_at(lambda state: state.memory, state, memory))


def tolerances_of(
    solver: str, rtol: Any = None, atol: Any = None, norm: Callable[[PyTree], Any] = optx.rms_norm
) -> Tolerances:
    """The tolerances of a solver, by default from the step size controller.

    **Raises:** `ValueError` for one tolerance without the other.
    """
    if (rtol is None) != (atol is None):
        raise ValueError(
            f"`{solver}` takes both of `rtol` and `atol`, or neither; got `rtol={rtol}` and `atol={atol}`."
        )
    if rtol is None:
        return from_controller(Tolerances)
    return Tolerances(rtol, atol, MultistepNorm(norm), fixed=True)
