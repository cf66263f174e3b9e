"""The Adams method of Shampine and Gordon, of variable order and variable step."""

from collections.abc import Callable
from typing import Any, ClassVar, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from .._arguments import whole_number
from ._history import HIGHEST_ORDER, INDEX, LENGTH, History, advance, start
from ._interpolation import RateInterpolation
from ._stiffness import Stiffness, none_found, observed
from .adams_steps import AdamsSteps, coefficients
from .evaluation import (
    Evaluation,
    controlled_components,
    evaluate,
    found_at_jump,
    next_chart,
    project_near,
    ravel,
    unravel_like,
)
from .manifold_term import Chart
from .multistep import AbstractAttempt, AbstractMultistep, AbstractMultistepState, tolerances_of
from .order import GAIN, choose_order
from .tangent import Tangent, TangentControl
from .tolerances import Tolerances, norm_of

# The target error of a step, in units of the tolerance.
_TARGET = 0.2
# Numbers of evaluations and matrices in a step.
_WORK = np.array([2, 0], np.int32)
# The local error of order k is a product of the spans h_n + ... + h_{n-m+1}. If all steps change, it is proportional to
# their power k + 1. If only the last step changes, it is proportional to its power 1 + sum_{m<=k} 1/m.
_ORDERS = np.arange(1, LENGTH)
_RESPONSES = np.append(1.0, GAIN * (_ORDERS + 1) / (1 + np.cumsum(1 / _ORDERS)))


class AdamsState(AbstractMultistepState):
    """The state of `Adams` between steps; `diffrax.SaveAt(solver_state=True)` returns it.

    **Fields:**

    - `history`: the mesh and the scaled divided differences of all components.
    - `order`: the order of the next step.
    - `step_counts`: `step_counts[0]` counts the starts (the first, and the restarts after jumps), `step_counts[k]` the
        accepted steps of order `k`. The number of evaluations of the vector field, rejected steps included, is `2 *
        solution.stats["num_steps"]`, plus `step_counts[0]` for steps of given lengths.
    - `chart`: the chart of an `AbstractManifoldTerm`, otherwise `None`.
    - `stiffness`: the evidence of stiffness in the accepted steps if it is counted, otherwise `None`.
    - `sizes`: the sizes that the absolute tolerance is relative to, with the controller's `scales`; otherwise `None`.
    - `tangents`: the tangents whose errors are controlled beside the state's error, otherwise `None`.
    - `found`: the numbers of `AbstractManifoldTerm.found_at_jump` for derivatives of the last jump, or `None`.
    """

    history: History
    order: Int[Array, ""]
    step_counts: Int[Array, " length"]
    chart: Chart | None
    stiffness: Stiffness | None
    sizes: Float[Array, " sizes"] | None
    tangents: tuple[Tangent, ...] | None
    found: PyTree[Array]

    def with_found(self, found):
        return eqx.tree_at(lambda state: state.found, self, found, is_leaf=lambda x: x is None)

    @property
    def memory(self) -> Float[Array, "length n"]:
        return self.history.differences

    @property
    def chosen(self) -> Int[Array, ""]:
        return self.order


class _Step(AbstractAttempt):
    """The numbers of a step.

    **Fields:** the state `after` it and the history there; the local `errors` of three formulas; the `mismatch` of the
    corrector at the end; the evaluations of the prediction (`first`) and of the corrected state (`second`). In a first
    step the rows of `errors` are the state before it, the error, and the change by its derivative.
    """

    after: Float[Array, " n"]
    history: History
    errors: Float[Array, "3 n"]
    mismatch: Float[Array, " n"]
    predicted: Float[Array, " n"]
    first: Evaluation
    second: Evaluation

    @property
    def memory(self) -> Float[Array, "length n"]:
        return self.history.differences


class Adams(AbstractMultistep):
    """Adams' method of variable order (1 to 13) and variable step, for non-stiff problems.

    Predictor, evaluation, corrector, evaluation (PECE) with local extrapolation: a step of order k predicts with the
    Adams-Bashforth formula of order k and corrects with the Adams-Moulton formula of order k + 1. A step of any order
    takes two evaluations. At tolerances of about 1e-6 and below the method needs roughly half the evaluations of
    high-order Runge-Kutta methods: it pays when the vector field is expensive. The first step is Euler's, of order one:
    it evaluates at its start instead of at a prediction.

    Use it with `MultistepController`, which reads the error estimates and holds the tolerances:

    ```python
    import diffrax
    from jaxmb.solvers import Adams, MultistepController

    term, control = diffrax.ODETerm(lambda t, y, args: -y), MultistepController(rtol=1e-8, atol=1e-10)
    end = diffrax.diffeqsolve(term, Adams(), 0.0, 1.0, None, jnp.array([1.0]), stepsize_controller=control).ys[-1]
    motion = jaxmb.simulate(system, state, t1=1.0, solver=Adams(max_order=8))
    ```

    The term is a `diffrax.ODETerm` or an `AbstractManifoldTerm`. Every form of `diffrax.SaveAt`, events, jumps,
    integration backward in time and every adjoint work as with other diffrax solvers. Derivatives differentiate the
    discrete solution with its mesh and orders frozen. After a jump (`diffrax.ClipStepSizeController(jump_ts=...)`) the
    method restarts at order one. A solve continued with `solver_state` must start at the state where the other ended,
    in the same direction of time; otherwise pass `made_jump=True`.

    **Reference:**

    ```bibtex
    @book{shampine1975computer,
        author={Shampine, Lawrence F. and Gordon, Marilyn K.},
        title={Computer Solution of Ordinary Differential Equations: The Initial Value Problem},
        publisher={W. H. Freeman},
        address={San Francisco},
        year={1975},
    }
    ```
    """

    tolerances: Tolerances
    tangent_control: TangentControl | None
    min_order: int = eqx.field(static=True)
    max_order: int = eqx.field(static=True)
    stiffness: str = eqx.field(static=True)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., RateInterpolation]] = RateInterpolation
    solves_implicitly: ClassVar[bool] = False
    finest: ClassVar[float] = 250.0

    def __init__(
        self,
        *,
        min_order: int = 1,
        max_order: int = HIGHEST_ORDER,
        stiffness: Literal["ignore", "count", "stop"] = "ignore",
        rtol: Any = None,
        atol: Any = None,
        norm: Callable[[PyTree], Any] = optx.rms_norm,
    ):
        """**Arguments:**

        - `min_order`, `max_order`: bounds of the order; equal values fix it, after a start from order one.
        - `stiffness`: "count" counts the steps that are limited by stability instead of accuracy, in
            `AdamsState.stiffness`; "stop" also stops at a stiff motion, with `diffrax.RESULTS.nonlinear_divergence`.
        - `rtol`, `atol`, `norm`: only for steps that no error estimate controls (`diffrax.ConstantStepSize`,
            `diffrax.StepTo`). They then control the order. Otherwise leave them out.

        **Raises:** `ValueError` if the bounds are not orders of the method, for another word for `stiffness`, or if
        only one tolerance is given.
        """
        if stiffness not in ("ignore", "count", "stop"):
            raise ValueError(f"`Adams` can 'ignore' or 'count' stiffness, or 'stop'; got `stiffness={stiffness!r}`.")
        if not 1 <= min_order <= max_order <= HIGHEST_ORDER:
            raise ValueError(
                f"`Adams` has the orders 1 to {HIGHEST_ORDER}, and `min_order` is at most `max_order`; got "
                f"`min_order={min_order}` and `max_order={max_order}`."
            )
        self.tolerances = tolerances_of("Adams", rtol, atol, norm)
        self.tangent_control = None
        self.min_order = whole_number("min_order", min_order)
        self.max_order = whole_number("max_order", max_order)
        self.stiffness = stiffness

    def order(self, terms: PyTree[diffrax.AbstractTerm]) -> int:
        del terms
        return self.max_order + 1

    def linear_steps(self, jumps):
        return AdamsSteps(jumps, evaluates=not self.tolerances.fixed)

    def statistics(self, solver_state: AdamsState, controller_state, stats):
        out = {
            "num_evaluations": 2 * stats["num_steps"] + (solver_state.step_counts[0] if self.tolerances.fixed else 0),
            "orders": solver_state.step_counts[1:],
        }
        if solver_state.stiffness is not None:
            out |= {"stiff": solver_state.stiffness.found, "stiff_steps": solver_state.stiffness.steps}
        return out

    def initial_state(self, terms, t0, t1, y0, args, chart, before: AdamsState | None) -> AdamsState:
        flat = ravel(y0)
        history = start(t0, jnp.zeros_like(flat), t1 - t0)
        history = eqx.tree_at(lambda history: history.known, history, jnp.zeros_like(history.known))
        starts = jnp.zeros((), np.int32)
        if self.tolerances.fixed:
            # No error is controlled, so the error of Euler's method may be large in the first step.
            first = evaluate(terms, t0, flat, y0, next_chart(terms, t0, y0, chart, args), args)
            history, chart, starts = start(t0, first.f, t1 - t0), first.chart, starts + 1
        if before is None:
            step_counts, stiffness = jnp.zeros(LENGTH, np.int32), None if self.stiffness == "ignore" else none_found()
            sizes = None if self.tolerances.scales is None else self.tolerances.scales.none(flat.dtype)
            at_jump = eqx.filter_eval_shape(found_at_jump, terms, t0, y0, args)
            at_jump = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), at_jump)
        else:
            step_counts, stiffness, sizes = before.step_counts, before.stiffness, before.sizes
            at_jump = before.found
        tangents = None
        if self.tangent_control is not None:
            control = self.tangent_control
            ws = control.starts() if before is None else [tangent.w for tangent in before.tangents or ()]
            tangents = tuple(Tangent(w, jnp.zeros_like(history.differences), control.largest(w)) for w in ws)
        order = jnp.asarray(1, np.int32)
        return AdamsState(history, order, step_counts.at[0].add(starts), chart, stiffness, sizes, tangents, at_jump)

    def attempt(self, terms, t1, before, like, args, state: AdamsState) -> _Step:
        history, order, chart = state.history, state.order, state.chart
        of = coefficients(history.mesh, order, t1, before.dtype)
        starts = history.known == 0
        mean = of.mean(history.differences)
        predicted = before + of.h * mean
        first = evaluate(terms, jnp.where(starts, history.mesh[0], t1), predicted, like, chart, args)
        # At a start there is no history to predict from: it begins with this derivative.
        latest = jnp.where(starts, first.f, history.differences[0])
        differences = jnp.concatenate([latest[None], history.differences[1:]])
        partial_sums, neighbours = of.sums(differences)
        history = eqx.tree_at(lambda history: history.known, history, jnp.maximum(history.known, 1))

        explicit = before + of.h * jnp.where(starts, first.f, mean)
        corrected = explicit + of.h * of.last * (first.f - neighbours[1])
        second = project_near(terms, t1, corrected, like, first, args)
        errors = of.h * of.differences[:, None] * (jnp.where(starts, second.f, first.f)[None] - neighbours)
        errors = jnp.where(starts, jnp.stack([before, errors[1], of.h * first.f]), errors)
        mismatch = explicit + of.h * of.last * (second.f - neighbours[1]) - second.y
        return _Step(
            second.y, advance(history, of.end, second.f, partial_sums), errors, mismatch, predicted, first, second
        )

    def advance(self, terms, t1, y0, args, state: AdamsState):
        history, order, before = state.history, state.order, ravel(y0)
        dtype, starts = before.dtype, history.known == 0
        chart = next_chart(terms, history.mesh[0], y0, state.chart, args)
        state = eqx.tree_at(lambda state: state.chart, state, chart, is_leaf=lambda x: x is None)
        step, along = self.attempted(terms, t1, before, y0, args, state)
        after = step.after

        h = (t1 - history.mesh[0]).astype(dtype)
        failed = step.first.failed | step.second.failed
        started = self._started(state.sizes, before, step.first.f)
        state = eqx.tree_at(lambda state: state.sizes, state, started, is_leaf=lambda x: x is None)
        scale = self.tolerances.of_step(before, after, h, state.sizes, self.finest)
        sizes = self._sizes(terms, y0, scale, step.errors, state.chart)
        # In the first step the state changes at most by its size, or by the tolerance.
        reached = sizes[2] / jnp.maximum(sizes[0], 1)
        sizes = jnp.where(starts, jnp.maximum(sizes, _TARGET * reached**2), sizes)
        tangents, scales = self.tangents_after(state.tangents, along)
        for end, tolerated in zip(along, scales, strict=True):
            sizes = jnp.maximum(sizes, self._sizes(terms, y0, tolerated, end.errors, state.chart))
        sizes = jnp.where(failed, jnp.asarray(jnp.inf, dtype), sizes)
        change, estimate = choose_order(
            sizes,
            order + np.arange(3, dtype=np.int32),
            jnp.asarray(_RESPONSES, dtype)[order],
            may_fall=order > self.min_order,
            may_rise=order < self.max_order,
            known=order < history.known,
            target=_TARGET,
            work=jnp.asarray(_WORK),
        )
        lost = starts & (step.first.failed | ~jnp.isfinite(reached))
        # After one step the second order is better by an unknown factor, larger than the steps may grow.
        growth = jnp.where(starts, jnp.asarray(jnp.inf, dtype), estimate.growth)
        retry = jnp.where(lost, jnp.asarray(-1.0, dtype), estimate.retry)
        estimate = eqx.tree_at(lambda e: (e.growth, e.retry), estimate, (growth, retry))
        y1 = unravel_like(y0, after)
        new_state = AdamsState(
            history=step.history,
            order=order + change,
            step_counts=state.step_counts + ((order == INDEX) | (starts & (INDEX == 0))).astype(np.int32),
            chart=step.second.chart,
            stiffness=self._observed(state, h, before, step.predicted, after, step.first.f, step.second.f, y0),
            sizes=self.grown_sizes(state.sizes, after),
            tangents=tangents,
            found=state.found,
        )
        used = (order >= INDEX)[:, None]
        dense_info = {
            "y1": y1,
            "differences": jnp.where(used, new_state.history.differences, jnp.zeros((), dtype)),
            "mesh": new_state.history.mesh,
            "mismatch": step.mismatch,
        }
        if self.stiffness == "stop" and state.stiffness is not None:
            failed = failed | state.stiffness.found
        return y1, estimate, dense_info, new_state, failed

    def _started(self, sizes, before, f) -> Float[Array, " sizes"] | None:
        """The sizes that the absolute tolerance is relative to; from the first state, if there are none yet."""
        scales = self.tolerances.scales
        if scales is None:
            return None
        return jnp.where(sizes > 0, sizes, scales.start(before, f))

    def _observed(self, state, h, before, predicted, after, first, second, like) -> Stiffness | None:
        if state.stiffness is None:
            return None
        scale = self.tolerances.of_step(before, after, h, state.sizes, self.finest)
        size = lambda change: self.weighted_norm(lax.stop_gradient(change), scale, like)
        correction = size(after - predicted), size(second - first)
        change = size(after - before), size(second - state.history.differences[0])
        return observed(state.stiffness, state.order, lax.stop_gradient(h), correction, change)

    def _sizes(self, terms, y0, scale, errors, chart) -> Float[Array, "3"]:
        """Weighted norms of the errors in the controlled components."""
        errors = lax.stop_gradient(errors) / scale[None]
        controlled = controlled_components(terms, chart)
        if controlled is not None:
            # The norm is a mean over all components.
            share = jnp.maximum(jnp.sum(controlled), 1) / controlled.size
            errors = jnp.where(controlled[None], errors, jnp.zeros((), errors.dtype)) / jnp.sqrt(share).astype(
                errors.dtype
            )
        return jax.vmap(lambda error: norm_of(self.tolerances.norm, error, y0))(errors)
