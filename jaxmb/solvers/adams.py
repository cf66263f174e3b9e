"""The Adams method of Shampine and Gordon, of variable order and step."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Int, PyTree

from ._base import Args, Chart, Y
from ._evaluation import check_term, derivative, evaluate, first_chart, free_components, next_chart, ravel, unravel_like
from ._history import advance, extrapolate, HIGHEST_ORDER, History, INDEX, LENGTH, start
from ._interpolation import MultistepInterpolation
from ._order import choose_order, StepEstimate
from ._tolerances import Tolerances


class AdamsState(eqx.Module):
    """What `Adams` remembers between steps; obtained with `diffrax.SaveAt(solver_state=True)`.

    **Fields:**

    - `history`: mesh and scaled divided differences of all components.
    - `order`: the order of the next step.
    - `tally`: `tally[0]` counts starts (the first, and one for every restart after a jump), `tally[k]` the accepted steps
        of order `k`. With `stats = solution.stats` the vector field was evaluated
        `tally[0] + 2 * stats["num_steps"]` times.
    - `chart`: the chart of an `AbstractManifoldTerm`, else `None`.
    """

    history: History
    order: Int[Array, ""]
    tally: Int[Array, " length"]
    chart: Chart | None


class Adams(diffrax.AbstractImplicitSolver[AdamsState], diffrax.AbstractAdaptiveSolver[AdamsState]):
    """doc"""

    tolerances: Tolerances
    min_order: int = eqx.field(static=True)
    max_order: int = eqx.field(static=True)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., MultistepInterpolation]] = MultistepInterpolation

    def __init__(
        self,
        *,
        min_order: int = 1,
        max_order: int = HIGHEST_ORDER,
        rtol: Any = None,
        atol: Any = None,
        norm: Callable[[PyTree], Any] = optx.rms_norm,
    ):
        if not 1 <= min_order <= max_order <= HIGHEST_ORDER:
            raise ValueError(
                f"`Adams` has orders from 1 to {HIGHEST_ORDER}, with `min_order` at most `max_order`, but got "
                f"`min_order={min_order}` and `max_order={max_order}`."
            )
        if (rtol is None) != (atol is None):
            raise ValueError("`Adams` needs both of `rtol` and `atol`, or neither of them.")
        if rtol is None:
            self.tolerances = diffrax.with_stepsize_controller_tols(Tolerances)()
        else:
            self.tolerances = Tolerances(rtol, atol, norm)
        self.min_order = min_order
        self.max_order = max_order

    @property
    def root_finder(self) -> Tolerances:  # pyright: ignore
        return self.tolerances

    @property
    def root_find_max_steps(self) -> int:  # pyright: ignore
        return 1

    def order(self, terms: PyTree[diffrax.AbstractTerm]) -> int | None:
        return None

    def func(self, terms: PyTree[diffrax.AbstractTerm], t0: Any, y0: Y, args: Args) -> Y:
        return derivative(terms, t0, y0, args)

    def init(self, terms: PyTree[diffrax.AbstractTerm], t0: Any, t1: Any, y0: Y, args: Args) -> AdamsState:
        check_term(terms)
        chart = first_chart(terms, t0, y0, args)
        tally = jnp.zeros(LENGTH, jnp.int32)
        return self._start(terms, t0, t1, y0, args, chart, tally)

    def _start(self, terms, t0, t1, y0, args, chart, tally) -> AdamsState:
        _, f, chart, failed = evaluate(terms, t0, ravel(y0), y0, chart, args)
        # Not a number spreads to the error estimate, and fails the step.
        f = jnp.where(failed, jnp.full_like(f, jnp.nan), f)
        order = jnp.asarray(1, jnp.int32)
        return AdamsState(start(t0, f, t1 - t0), order, tally + (INDEX == 0).astype(np.int32), chart)

    def step(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: Any,
        t1: Any,
        y0: Y,
        args: Args,
        solver_state: AdamsState,
        made_jump: Any,
    ) -> tuple[Y, StepEstimate | None, dict[str, Any], AdamsState, diffrax.RESULTS]:
        if made_jump is not False:
            solver_state = self._restart(terms, t0, t1, y0, args, solver_state, made_jump)
        history, order, chart = solver_state.history, solver_state.order, solver_state.chart
        flat0 = ravel(y0)
        dtype = flat0.dtype
        h = (t1 - t0).astype(dtype)

        ahead = extrapolate(history, t1)
        used = jnp.where(INDEX < order, ahead.means, jnp.zeros((), dtype))
        predicted = flat0 + h * (used @ history.differences)
        _, f_p, new_chart, failed_p = evaluate(terms, t1, predicted, y0, chart, args)

        # Rows: what the derivative at t1 adds to the polynomials through the last k - 1, k, k + 1 before it.
        defects = f_p[None] - lax.dynamic_slice_in_dim(ahead.partial_sums, order - 1, 3)
        g = ahead.means / ahead.values
        g_steps = jnp.diff(g, prepend=jnp.zeros((1,), dtype), append=g[-1:])
        corrected = predicted + h * g[order] * defects[1]
        flat1, f1, new_chart, failed_c = evaluate(terms, t1, corrected, y0, new_chart, args)
        failed = failed_p | failed_c
        y1 = unravel_like(y0, flat1)

        errors = self._norms(
            terms, y0, flat0, flat1, h * lax.dynamic_slice_in_dim(g_steps, order - 1, 3)[:, None] * defects, chart
        )
        errors = jnp.where(failed, jnp.asarray(jnp.inf, dtype), errors)
        next_order, estimate = choose_order(errors, order, history.points, self.min_order, self.max_order)
        new_history = advance(history, t1, f1, ahead.partial_sums)
        new_state = AdamsState(
            history=new_history,
            order=next_order,
            tally=solver_state.tally + (INDEX == order).astype(jnp.int32),
            chart=next_chart(terms, t1, y1, new_chart, args),
        )
        dense_info = dict(
            y1=y1,
            differences=new_history.differences,
            mesh=new_history.mesh,
            order=order,
            mismatch=predicted + h * g[order] * (f1 - ahead.partial_sums[order]) - flat1,
        )
        if failed is False:
            result = diffrax.RESULTS.successful
        else:
            result = diffrax.RESULTS.where(
                failed, diffrax.RESULTS.nonlinear_divergence, diffrax.RESULTS.successful
            )
        return y1, estimate if self.tolerances.from_controller else None, dense_info, new_state, result

    def _norms(self, terms, y0, flat0, flat1, errors, chart):
        errors = errors / self.tolerances.scale(flat0, flat1)[None]
        free = free_components(terms, chart)
        if free is not None:
            errors = jnp.where(free[None], errors, jnp.zeros((), errors.dtype))
            errors = errors * jnp.sqrt(free.size / jnp.maximum(jnp.sum(free), 1)).astype(errors.dtype)
        return jnp.stack([self.tolerances.norm(unravel_like(y0, e)) for e in lax.stop_gradient(errors)])

    def _restart(self, terms, t0, t1, y0, args, state, made_jump) -> AdamsState:
        def restart():
            chart = next_chart(terms, t0, y0, state.chart, args)
            new = self._start(terms, t0, t1, y0, args, chart, state.tally)
            return jax.tree.map(lambda a, b: jnp.where(made_jump, a, b), new, state)

        return lax.cond(eqxi.unvmap_any(made_jump), restart, lambda: state)
