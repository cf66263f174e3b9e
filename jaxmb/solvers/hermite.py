"""Implicit multistep methods with second derivatives, of variable order and variable step."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._arguments import whole_number
from ._damping import is_resolved
from ._dense import DenseLinearization
from ._field import at_start, derivatives, linearized
from ._formulas import FAMILIES, Formulas, double, formulas, is_start, spacing_of, start
from ._history import History, advance, basis, before_each, step_end
from ._interpolation import MultistepInterpolation, RateInterpolation, StateInterpolation
from ._neighbours import a_stable, damped_growth, ladder, responses
from ._newton import AbstractLinearization, KnownStep, Newton, Solved, StepEquation, at_end, tangents_nearby
from ._structured import unknown_structure
from .controller import ControllerState, states_inside
from .evaluation import (
    field_of,
    free_components,
    freeze,
    jacobian_of,
    kept_of_chart,
    next_chart,
    ravel,
    solution_of,
    unravel_like,
)
from .hermite_steps import HermiteSteps
from .manifold_term import Chart
from .multistep import AbstractAttempt, AbstractMultistep, AbstractMultistepState, tolerances_of
from .order import LOWER, choose_order, growth_factors
from .tangent import Tangent, TangentControl
from .tolerances import Tolerances

# Newton's method ends when the next correction is below this, in units of the tolerance.
_NEWTON = 0.01
# The target error of a step, in units of the tolerance.
_TARGET = 0.05


class HermiteState(AbstractMultistepState):
    """The state of `Hermite` between steps; `diffrax.SaveAt(solver_state=True)` returns it.

    **Fields:**

    - `history`: the mesh, and scaled divided differences: of f and y in the families that integrate, otherwise of y.
    - `slope`: the time derivatives of the same quantities at the latest point.
    - `order_index`: k, the number of points of the past in the formula of the next step.
    - `matrix`: the linearisation for Newton's method.
    - `step_counts`: `step_counts[0]` counts the starts (the first, and the restarts after jumps), `step_counts[k]` the
        accepted steps with k points.
    - `work`: evaluations of f with g, and matrices computed, in accepted steps. The first evaluation after a start is
        in `step_counts`, the evaluations of rejected steps are in `ControllerState`.
    - `chart`: the chart of an `AbstractManifoldTerm`, otherwise `None`.
    - `sizes`: the sizes that the absolute tolerance is relative to, with the controller's `scales`; otherwise `None`.
    - `tangents`: the tangents whose errors are controlled beside the state's error, otherwise `None`.
    - `wrong_derivative`: whether differences of the vector field contradict its derivative at the first start.
    """

    history: History
    slope: Float[Array, " m"]
    order_index: Int[Array, ""]
    matrix: AbstractLinearization
    step_counts: Int[Array, " length"]
    work: Int[Array, "2"]
    chart: Chart | None
    sizes: Float[Array, " sizes"] | None
    tangents: tuple[Tangent, ...] | None
    wrong_derivative: Bool[Array, ""]

    @property
    def memory(self) -> tuple[Float[Array, "length m"], Float[Array, " m"]]:
        return self.history.differences, self.slope

    @property
    def chosen(self) -> Int[Array, ""]:
        return self.order_index


class StepEnd(eqx.Module):
    """A step as a function of its end.

    **Fields:** the state `after` it, the history there and its `slope`; for interpolation the history with the last
    point `doubled`, and the `mismatch` of the formula at the end.
    """

    after: Float[Array, " n"]
    history: History
    slope: Float[Array, " m"]
    doubled: History
    mismatch: Float[Array, " n"]

    @property
    def memory(self) -> tuple[Float[Array, "length m"], Float[Array, " m"]]:
        return self.history.differences, self.slope


class _Step(AbstractAttempt):
    """The numbers of a step.

    **Fields:** its `end`; `ends`: the state there by every formula, for their errors; the `chart` there; whether the
    evaluation `broke` down; the result of Newton's method.
    """

    end: StepEnd
    ends: Float[Array, "formulas n"]
    chart: Chart | None
    broke: Bool[Array, ""]
    newton: Solved

    @property
    def after(self) -> Float[Array, " n"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.end.after

    @property
    def memory(self) -> tuple[Float[Array, "length m"], Float[Array, " m"]]:
        return self.end.memory


class PushedTangent(NamedTuple):
    """A tangent that is carried along: `before` a step, at its `end`, and there by every formula (`ends`)."""

    before: Tangent
    end: StepEnd
    ends: Float[Array, "formulas n"]


class Formula(NamedTuple):
    """The formula of a step on a mesh.

    **Fields:** the `end` of the step in time, and its length `h`; the `unit` of the values that it integrates; its
    `coefficients` for all numbers of nodes, and how many `nodes` it has; `values` of the basis at the end.
    """

    end: Any
    h: Float[Array, ""]
    unit: Float[Array, ""]
    coefficients: Formulas
    nodes: Int[Array, ""]
    values: Float[Array, " length"]

    @property
    def sums(self) -> Float[Array, "length length"]:
        """The matrix that evaluates the polynomials of all orders at the end, from differences."""
        return jnp.asarray(before_each(self.values.size), self.values.dtype) * self.values[None]


class Hermite(AbstractMultistep):
    """Implicit multistep methods that use `y″ = f_t + f_y f`, of variable order and step, for stiff problems.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, solver=jaxmb.solvers.Hermite())
    motion.stats["num_steps"]
    ```

    A step interpolates, in the sense of Hermite, at the new point and at k points of the past. The second derivative is
    exact: one directional derivative of the vector field, which must be differentiable. Families:

    - `"E"` (Enright), order `k + 2`, `k ≤ 7`: integrates the polynomial through values of `f`. A-stable for `k ≤ 2`,
        stiffly stable for all, and zero-stable for any sequence of steps. The default.
    - `"B"`, order `k + 1`, `k ≤ 8`: backward differentiation of `y` with the second derivative at the new point.
        A-stable for `k ≤ 3`; steps may only grow slowly at high orders.
    - `"H"`, order `2k + 2`, `k ≤ 3`: as E, with `f′` at every point. A-stable, without damping at infinity, for `k =
        1`; unsuitable for stiff problems otherwise.
    - `"Y"`, order `2k + 1`, `k ≤ 3`: as B, with `y′` at every point. A-stable for `k = 1`.

    Formulas that are not A-stable amplify lightly damped vibrations when a step covers a few radians of them. They are
    chosen only for steps at which no eigenvalue of the Jacobian causes amplification, unless `past_points` has no
    A-stable alternative. The eigenvalues are computed whenever Newton's method needs a new Jacobian. With large steps,
    implicit formulas damp components that should grow: no step covers more than two e-foldings of them.

    A term may know the structure of its Jacobian (`AbstractManifoldTerm.jacobian`); a step then costs as much as
    solving with that structure. Arnoldi's method finds sixteen of its eigenvalues near the inverse of the step, where
    lightly damped vibrations and growing components appear first. A single vibration among many well damped components
    may be missed; the error estimate then keeps steps short.

    At the start the derivative of the vector field is compared with its differences. If it contradicts them, as with
    `stop_gradient`, rounding or integers in the vector field, results would be wrong. `jaxmb.simulate` then warns,
    except under `jit` and `vmap`: see `stats["wrong_derivative"]`, or with `diffrax.diffeqsolve` the solver's state.

    Use it with `MultistepController`, as `Adams`; the term, `diffrax.SaveAt`, events, jumps, backward time, adjoints
    and derivatives work in the same way. Steps are differentiated by the implicit function theorem, with the exact
    Jacobian. Non-stiff problems are solved as accurately as by `Adams`, but more slowly.

    If a solution jumps from one slow motion to another, as in relaxation oscillations, give reverse mode a checkpoint
    for every step, `diffrax.RecursiveCheckpointAdjoint(checkpoints=max_steps)`. With fewer checkpoints it repeats
    steps. Rounding then changes their lengths slightly, and jumps occur too early or too late (van der Pol's equation
    with μ = 100 over a jump, at rtol 1e-9: 2e-4 of the derivative, instead of 3e-9).

    **Reference:**

    ```bibtex
    @article{enright1974second,
        author={Enright, W. H.},
        title={Second Derivative Multistep Methods for Stiff Ordinary Differential Equations},
        journal={SIAM Journal on Numerical Analysis},
        volume={11}, number={2}, pages={321--331}, year={1974},
    }
    ```
    """

    tolerances: Tolerances
    tangent_control: TangentControl | None
    family: str = eqx.field(static=True)
    past_points: tuple[int, ...] = eqx.field(static=True)

    term_structure: ClassVar = diffrax.AbstractTerm
    solves_implicitly: ClassVar[bool] = True
    finest: ClassVar[float] = 50000.0

    def __init__(
        self,
        family: Literal["E", "B", "H", "Y"] = "E",
        past_points: Sequence[int] | None = None,
        *,
        rtol: Any = None,
        atol: Any = None,
        norm: Callable[[PyTree], Any] = optx.rms_norm,
    ):
        """**Arguments:**

        - `family`: the family of formulas.
        - `past_points`: the numbers k of points of the past to choose from, increasing; default all useful ones. A pair
            such as `(2, 4)` is a method that switches between two formulas by their errors; a single number fixes the
            order. The method starts with k = 1.
        - `rtol`, `atol`, `norm`: only for steps that no error estimate controls (`diffrax.ConstantStepSize`,
            `diffrax.StepTo`). They then control the order and Newton's method. Otherwise leave them out.

        **Raises:** `ValueError` for an unknown family, for numbers of points that it does not have or that are not
        increasing, and if only one tolerance is given.
        """
        if family not in FAMILIES:
            raise ValueError(f"`Hermite` has the families {', '.join(FAMILIES)}; got `family={family!r}`.")
        highest = FAMILIES[family].highest
        past_points = tuple(range(1, highest + 1) if past_points is None else past_points)
        increasing = list(past_points) == sorted(set(past_points))
        if not past_points or not increasing or any(k != int(k) or not 1 <= k <= highest for k in past_points):
            raise ValueError(
                f"The formulas of family {family} have 1 to {highest} points of the past; `past_points` lists some of "
                f"these numbers, increasing. Got `past_points={past_points}`."
            )
        self.tolerances = tolerances_of("Hermite", rtol, atol, norm)
        self.tangent_control = None
        self.family = family
        self.past_points = tuple(whole_number("past_points", k) for k in past_points)

    @property
    def interpolation_cls(self) -> Callable[..., MultistepInterpolation]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return RateInterpolation if FAMILIES[self.family].integrated else StateInterpolation

    def order(self, terms: PyTree[diffrax.AbstractTerm]) -> int:
        del terms
        return FAMILIES[self.family].order(self.past_points[-1])

    def statistics(self, solver_state: HermiteState, controller_state, stats):
        controller_states = states_inside(controller_state, ControllerState)
        work = solver_state.work + sum(controller.wasted for controller in controller_states)
        return {
            "num_evaluations": solver_state.step_counts[0] + work[0],
            "num_matrices": work[1],
            "past_points": solver_state.step_counts[1:],
            "wrong_derivative": solver_state.wrong_derivative,
        }

    def initial_state(self, terms, t0, t1, y0, args, chart, before: HermiteState | None) -> HermiteState:
        family, flat = FAMILIES[self.family], ravel(y0)
        chart, scales = next_chart(terms, t0, y0, chart, args), self.tolerances.scales
        free = free_components(terms, flat, chart)
        if free.size == 0:
            raise ValueError(
                "`Hermite` has no equation to solve: constraints prescribe all components of the state. Use `Adams()`."
            )
        structured_matrix = unknown_structure(jacobian_of(terms, t0, y0, args), flat)
        matrix = DenseLinearization.unknown(flat, free) if structured_matrix is None else structured_matrix
        field, at = freeze((field_of(terms, t0, y0, chart, args), flat))
        if before is None:
            size = None if scales is None else scales.expected(at)
            first, wrong = matrix.probed(field, t0, at, size)
            step_counts, work = jnp.zeros(family.highest + 1, np.int32), jnp.zeros(2, np.int32)
        else:
            first, wrong = derivatives(field, t0, at), before.wrong_derivative
            step_counts, work = before.step_counts, before.work
        chart, failed = freeze(first.rest)
        # The NaN reaches the error estimate, so that the step is rejected.
        end = at, jnp.where(failed, jnp.full_like(first.f, jnp.nan), first.f), first.g

        solution = solution_of(terms, t0, y0, kept_of_chart(terms, chart), args)
        history, slope = self.begun(t0, t1 - t0, *at_start(end, solution, t0, flat))
        control, tangents = self.tangent_control, None
        if control is not None:
            # The first step computes their memory.
            ws = control.starts() if before is None else [tangent.w for tangent in before.tangents or ()]
            none = jax.tree.map(jnp.zeros_like, (history.differences, slope))
            tangents = tuple(Tangent(w, none, control.largest(w)) for w in ws)
        index = jnp.asarray(1, np.int32)
        sizes = self.first_sizes(flat, end[1], before)
        counts = step_counts.at[0].add(1)
        return HermiteState(history, slope, index, matrix, counts, work, chart, sizes, tangents, wrong)

    def attempt(self, terms, t1, before, like, args, state: HermiteState) -> _Step:
        history, n = state.history, before.size
        formula = self.formula(history.mesh, state.order_index, t1, before.dtype)
        past, a, b = self.equation(formula, before, history.differences)
        field = field_of(terms, t1, like, state.chart, args)
        free = free_components(terms, before, state.chart)
        equation = StepEquation(field, jacobian_of(terms, t1, like, args), t1, formula.h, past, a, b, free)

        predicted = self._predicted(formula, history, n)
        latest, scale = (before, state.slope[-n:]), self._tolerated(t1, before, state)
        size = lambda correction: self.weighted_norm(correction, freeze(scale), like)
        newton = Newton(freeze(equation), size, _NEWTON).solve(*freeze((predicted, latest, state.matrix)))

        chart, broke = newton.end.rest
        solution = solution_of(terms, t1, like, kept_of_chart(terms, freeze(chart)), args)
        step = KnownStep(solution, t1, past, a, b, free)
        y, f, g = at_end(newton.end[:3], step, *freeze((newton.matrix, newton.inverses)))
        end = self.ended(formula, history, (past, a, b), (y, f, g))
        return _Step(end, self._ends(formula, history, f, g), chart, broke, newton)

    def attempted(self, terms, t1, before, like, args, state: HermiteState):
        step, control = self.attempt(terms, t1, before, like, args, state), self.tangent_control
        if control is None:
            return step, []
        # Tangents that are carried along have no derivatives.
        terms, frozen_step, state, before = freeze((terms, step, state, before))
        along, newton, history = control.of_terms(terms), frozen_step.newton, state.history
        is_moved = jax.tree.map(lambda *parts: any(x is not None for x in parts), *along, is_leaf=lambda x: x is None)
        numbers, rest = eqx.partition(terms, is_moved)
        formula = self.formula(history.mesh, state.order_index, t1, before.dtype)
        free = free_components(terms, before, state.chart)
        start = history.mesh[0], before, state.slope[-before.size :], state.chart
        end = t1, frozen_step.after, newton.end.f, newton.end.rest[0]

        def pushed(x: Tangent, scale, by_numbers, by_state, begins):
            past_history = History(x.memory[0], history.mesh, history.known)
            past, a, b = self.equation(formula, x.w, past_history.differences)
            equation = StepEquation(None, None, t1, formula.h, past, a, b, free)  # pyright: ignore[reportArgumentType]
            size = lambda change: self.weighted_norm(change, scale, like)
            predicted = self._predicted(formula, past_history, before.size)
            predicted = jnp.where(begins, x.w, predicted[0]), predicted[1]
            solved = tangents_nearby(
                newton.matrix, newton.inverses, equation, by_state, by_numbers, predicted, size, _NEWTON, begins
            )
            first, slope = self.begun(*spacing_of(history), *solved)
            first = Tangent(solved[0], (first.differences, slope), control.largest(solved[0]))
            ended = self.ended(formula, past_history, (past, a, b), solved)
            out = PushedTangent(
                jax.tree.map(lambda a, b: jnp.where(begins, a, b), first, x),
                ended,
                self._ends(formula, past_history, *solved[1:]),
            )
            # A NaN derivative counts as zero.
            return jax.tree.map(lambda x: jnp.where(jnp.isnan(x), jnp.zeros_like(x), x), out)

        def advanced(carry):
            # In a first step the equations are linearised at its start, then at its end.
            k, last = carry
            begins = k == 0
            t, y, f, chart = jax.tree.map(lambda a, b: jnp.where(begins, a, b), start, end)
            solution = lambda numbers: solution_of(
                eqx.combine(numbers, rest), t, like, kept_of_chart(terms, chart), args
            )
            by_numbers, by_state = linearized(solution, numbers, t, y, f)
            tangents = [x.before for x in last]
            scales = control.scales(self.tolerances.rtol, tangents, [x.w for x in tangents])
            pairs = zip(tangents, scales, along, strict=True)
            return k + 1, [pushed(x, scale, by_numbers(of, None), by_state, begins) for x, scale, of in pairs]

        blank = jax.tree.map(jnp.zeros_like, (frozen_step.end, frozen_step.ends))
        carry = jnp.where(is_start(history), 0, 1), [PushedTangent(x, *blank) for x in state.tangents or ()]
        return step, lax.while_loop(lambda carry: carry[0] < 2, advanced, carry)[1]

    def _predicted(self, formula: Formula, history: History, n: int) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The state and the rate at the end of a step, extrapolated.

        The state is extrapolated, not f, in which the remaining error of stiff components is large. The prediction has
        the order of the formula, if there are enough points, since Newton's method converges only from nearby. Its
        slope follows from the logarithmic derivatives of the basis.
        """
        dtype, states = history.differences.dtype, history.differences[:, -n:]
        used = np.arange(FAMILIES[self.family].length, dtype=np.int32) <= formula.nodes + 2
        recent = jnp.where(used, formula.values, jnp.zeros((), dtype))
        rates = jnp.asarray(before_each(used.size), dtype) @ (1 / (formula.end - history.mesh)).astype(dtype)
        return recent @ states, (recent * rates) @ states

    def linearised(self, formula: Formula, equations, end, free, matrix: AbstractLinearization, begins: Any):
        """The end of a step as a linear map, on the mesh of the step: of the tangents of the numbers, and of the state
        and the history at its start.

        **Arguments:** `equations`: the solution of the equations, a function of the numbers, and the numbers; `end`:
        its time, and the state and the field there; the `free` unknowns; a `matrix` of Newton's method there; `begins`:
        whether this is the start of the step instead, whose history follows from the state.
        """
        (solution, numbers), (t, y, f) = equations, end
        by_numbers, by_state = linearized(solution, numbers, t, y, f)
        _, a, b = self.equation(formula, y, jnp.zeros((formula.values.size, y.size), y.dtype))
        a, b = (jnp.where(begins, jnp.zeros_like(x), x) for x in (a, b))
        solve = matrix.tangents(matrix.inverses(a, b, free), a, b, free, by_state)

        def push(along, w, history):
            past = jnp.where(begins, w, self.equation(formula, w, history.differences)[0])
            solved = solve(by_numbers(along, None), past)
            end = self.ended(formula, history, (past, a, b), solved)
            if begins is False:
                return end
            first, _ = self.begun(*spacing_of(history), *solved)
            differences = jnp.where(begins, first.differences, end.history.differences)
            return eqx.tree_at(lambda end: end.history.differences, end, differences)

        return push

    def begun(self, t, spacing, y, f, g) -> tuple[History, Float[Array, " m"]]:
        """The history at a start, with one point, and its slope there."""
        z, slope = self._recorded(y, f, g)
        return start(FAMILIES[self.family], t, z, slope, spacing), slope

    def formula(self, mesh: Float[Array, " length"], order_index: Int[Array, ""], t1: Any, dtype: Any) -> Formula:
        """The formula of a step from the latest point of a mesh to `t1`."""
        family, end = FAMILIES[self.family], step_end(mesh, t1)
        h = (end - mesh[0]).astype(dtype)
        unit = h if family.integrated else jnp.ones_like(h)
        values = basis(mesh, end[None])[:, 0].astype(dtype)
        return Formula(end, h, unit, formulas(family, mesh, end, dtype), family.multiplicity * order_index, values)

    def equation(
        self, formula: Formula, before: Float[Array, " n"], differences: Float[Array, "length m"]
    ) -> tuple[Float[Array, " n"], Float[Array, ""], Float[Array, ""]]:
        """`(past, a, b)` of the equation `y = past + a f + b g` of a step; `past` is linear in the arrays."""
        base = before if FAMILIES[self.family].integrated else jnp.zeros_like(before)
        of, nodes = formula.coefficients, formula.nodes
        past = base + formula.unit * (of.past[nodes] @ differences[:, : before.size])
        return past, formula.h * of.slope[nodes], formula.h**2 * of.curvature[nodes]

    def ended(
        self, formula: Formula, history: History, equation: tuple[Array, Any, Any], solved: tuple[Array, Array, Array]
    ) -> StepEnd:
        """A step from its end, linear in `(y, f, g)` there, in `past` and in the differences before it."""
        (past, a, b), (y, f, g) = equation, solved
        z, slope = self._recorded(y, f, g)
        advanced = advance(history, formula.end, z, formula.sums @ history.differences)
        doubled = double(advanced, slope)
        after = doubled if FAMILIES[self.family].multiplicity == 2 else advanced
        return StepEnd(y, after, slope, doubled, past + a * f + b * g - y)

    def _ends(self, formula: Formula, history: History, f, g) -> Float[Array, "formulas n"]:
        """The changes of the state in a step by all formulas."""
        of = formula.coefficients
        past = formula.unit * (of.past @ history.differences[:, : f.size])
        return past + (formula.h * of.slope)[:, None] * f[None] + (formula.h**2 * of.curvature)[:, None] * g[None]

    def dense_info(self, end: StepEnd, like: Any, order_index: Int[Array, ""]) -> dict[str, Any]:
        """The dense output of a step of an order."""
        family, n = FAMILIES[self.family], end.after.size
        used = (np.arange(family.length, dtype=np.int32) < family.multiplicity * order_index + 2)[:, None]
        return {
            "y1": unravel_like(like, end.after),
            "differences": jnp.where(used, end.doubled.differences[:, :n], jnp.zeros((), end.after.dtype)),
            "mesh": end.doubled.mesh,
            "mismatch": end.mismatch,
        }

    def linear_steps(self, jumps):
        return HermiteSteps(jumps, self.family)

    def advance(self, terms, t1, y0, args, state: HermiteState):
        family, history, k = FAMILIES[self.family], state.history, state.order_index
        before = ravel(y0)
        dtype = before.dtype
        h = (step_end(history.mesh, t1) - history.mesh[0]).astype(dtype)
        free = free_components(terms, before, state.chart)
        scale = self._tolerated(t1, before, state)
        step, along = self.attempted(terms, t1, before, y0, args, state)
        newton = freeze(step.newton)
        failed = ~newton.converged | step.broke | ~is_resolved(h, newton.matrix.spectrum)

        around = jnp.asarray(ladder(self.past_points))[k]
        stable = a_stable(self.family, self.past_points)
        candidates = jnp.append(around, stable or 1)
        sizes = self._sizes(step.ends, candidates, family, newton, free, scale, y0)
        tangents, scales = self.tangents_after(tuple(x.before for x in along), [x.end for x in along])
        for x, scale in zip(along, scales, strict=True):
            sizes = jnp.maximum(sizes, self._sizes(x.ends, candidates, family, newton, free, scale, y0))
        sizes = jnp.where(failed, jnp.asarray(jnp.inf, dtype), sizes)
        bounded = None
        if stable is not None:
            bounded = functools.partial(damped_growth, self.family, around, h, newton.matrix.spectrum)
        change, estimate = choose_order(
            sizes[:3],
            family.order(around) + 1,
            jnp.asarray(responses(family), dtype)[k],
            may_fall=k > self.past_points[0],
            may_rise=(k < self.past_points[-1]) & (family.multiplicity * (around[2] - 1) <= history.known),
            known=family.multiplicity * (around[2] + 1) <= history.known,
            target=_TARGET,
            work=newton.work,
            limit=jnp.asarray((1.0, *family.growth), dtype)[k],
            bounded=bounded,
        )
        order_index = around[1 + change]
        if stable is not None:
            # At this step length the formulas in between may be unstable.
            growth = LOWER * growth_factors(sizes[3], family.order(candidates[3]) + 1, _TARGET)
            better = (k > stable) & (growth > estimate.growth)
            order_index = jnp.where(better, candidates[3], order_index)
            estimate = eqx.tree_at(lambda e: e.growth, estimate, jnp.where(better, growth, estimate.growth))

        # No step from a start without a field has an estimate.
        lost = is_start(state.history) & ~jnp.all(jnp.isfinite(state.slope))
        retry = jnp.where(lost, jnp.asarray(-1.0, dtype), estimate.retry)
        estimate = eqx.tree_at(lambda e: e.retry, estimate, retry)

        y1 = unravel_like(y0, step.after)
        renewed = next_chart(terms, t1, y1, step.chart, args)
        matrix = newton.matrix
        if step.chart is not None:
            # A new choice of components invalidates the matrix.
            changed = jnp.any(free_components(terms, before, renewed) != free)
            matrix = eqx.tree_at(lambda m: m.renewals, matrix, jnp.maximum(matrix.renewals, changed.astype(jnp.int32)))
        new_state = HermiteState(
            history=step.end.history,
            slope=step.end.slope,
            order_index=order_index,
            matrix=matrix,
            step_counts=state.step_counts + (k == np.arange(family.highest + 1, dtype=np.int32)).astype(np.int32),
            work=state.work + newton.work,
            chart=renewed,
            sizes=self.grown_sizes(state.sizes, step.after),
            tangents=tangents,
            wrong_derivative=state.wrong_derivative,
        )
        return y1, estimate, self.dense_info(step.end, y0, k), new_state, failed

    def _tolerated(self, t1, before, state: HermiteState) -> Float[Array, " n"]:
        """The errors tolerated in the step, also of its iterations, by the state at its start."""
        h = step_end(state.history.mesh, t1) - state.history.mesh[0]
        return self.tolerances.of_step(before, before, h, state.sizes, self.finest)

    def _sizes(self, ends, points, family, newton, free, scale, like) -> Float[Array, " formulas"]:
        """Weighted norms of the errors of the formulas with these numbers of points.

        The error of a formula is the change by the next formula; Newton's matrix converts this residual to an error of
        y. If constraints determine the other components from few free ones, the error of the free components passes
        through zero now and then. So the change of the other components that does not follow from the free ones counts
        as well. (With the same evaluations of a four-bar, errors fall to a half or a fifth, and follow the tolerance.)
        """
        ends = lax.stop_gradient(ends)
        changes = ends[family.multiplicity * (points + 1)] - ends[family.multiplicity * points]
        matrix, inverses = freeze((newton.matrix, newton.inverses))
        errors = matrix.errors(inverses, free, changes)
        return jnp.stack([self.weighted_norm(error, scale, like) for error in errors])

    def _recorded(self, y, f, g):
        """The values in the history, and their time derivatives."""
        if not FAMILIES[self.family].integrated:
            return y, f
        return jnp.concatenate([f, y]), jnp.concatenate([g, f])
