"""Newton's method for the implicit equation of a step that uses the second derivative.

A step solves `y = past + a f(t, y) + b g(t, y)`. The time derivative `g` of `f` along the solution is exact: one
directional derivative. The iteration is the same for all linearisations: full matrices (`_dense`), and matrices that
know their structure (`_structured`).
"""

import abc
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from .._branches import cond_of_any_lane
from ._field import Derivatives, Field, Solution, derivatives, linearized
from .linear_map import filled

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

_MAX_ITERATIONS = 10
# After a matrix of an earlier step has failed, this number of steps compute new matrices.
_DISTRUST = 10
# After a correction larger than this fraction of the state and its change, the matrix is unreliable.
_FAR = 0.1
# The largest number of matrices for a step; and the code for success.
_ATTEMPTS, _DONE = 4, 9


class StepEquation(eqx.Module):
    """The equation `y = past + a f(t, y) + b g(t, y)` of a step.

    **Fields:** `field`; `jacobian(y)`: the field's derivative with known structure and the direction of time, or None;
    `t`: the end of the step; `h`: its length; `past`, `a`, `b`; `free`: indices of the unknowns in the state.
    """

    field: Field
    jacobian: Callable[[Float[Array, " n"]], Any]
    t: Any
    h: Any
    past: Float[Array, " n"]
    a: Any
    b: Any
    free: Int[Array, " free"]


class AbstractLinearization(eqx.Module):
    """How a state and its time derivatives change with the unknowns of a step `y = past + a f + b g`.

    **Fields:** `spectrum`: eigenvalues of the derivative J of the field; `renewals`: the number of next steps that must
    compute a new linearisation.

    The method `inverses` returns the solved form of Newton's equation, the argument `inverses` of other methods.
    """

    spectrum: AbstractVar[Complex[Array, " k"]]
    renewals: AbstractVar[Int[Array, ""]]

    @property
    @abc.abstractmethod
    def patience(self) -> int:
        """The number of iterations that cost about as much as a new linearisation."""

    @property
    @abc.abstractmethod
    def slow(self) -> float:
        """The linearisation is renewed after a step whose corrections shrank more slowly than by this factor."""

    @abc.abstractmethod
    def probed(
        self, field: Field, t: Any, y: Float[Array, " n"], size: Float[Array, " n"] | None
    ) -> tuple[Derivatives, Bool[Array, ""]]:
        """The derivatives of the field, and whether its differences contradict them; `size` of the components."""

    @abc.abstractmethod
    def renewed(self, equation: StepEquation, y: Float[Array, " n"], rate: Float[Array, " n"]) -> Any:
        """The linearisation at another state, for a rate."""

    @abc.abstractmethod
    def inverses(self, a: Any, b: Any, free: Int[Array, " free"]) -> Any:
        """The solved form of Newton's equation, for a step with these `a`, `b` and unknowns."""

    @abc.abstractmethod
    def no_inverses(self, a: Any, b: Any, free: Int[Array, " free"]) -> Any:
        """Zeros in place of `inverses`."""

    @abc.abstractmethod
    def observed(self, inverses: Any, anew: Bool[Array, ""]) -> Any:
        """The linearisation with its spectrum, if this needs the inverses; `anew`: whether the linearisation is new."""

    @abc.abstractmethod
    def moved(self, change: Float[Array, " free"]) -> Float[Array, " n"]:
        """The change of the state for a change of the unknowns."""

    @abc.abstractmethod
    def correction(
        self,
        inverses: Any,
        equation: StepEquation,
        y: Float[Array, " n"],
        f: Float[Array, " n"],
        g: Float[Array, " n"],
        along: Float[Array, " n"],
    ) -> tuple[Float[Array, " free"], Float[Array, " free"], Float[Array, " n"], Float[Array, " n"]]:
        """The correction of the unknowns, with and without the derivative of g for a held rate; f and g after it.

        **Arguments:** `f`, `g`: at y; `along`: the rate that g is along, which approaches f.
        """

    @abc.abstractmethod
    def errors(
        self, inverses: Any, free: Int[Array, " free"], changes: Float[Array, "formulas n"]
    ) -> Float[Array, "formulas n"]:
        """The changes of the solution by changes of the past, also in components that do not depend on the unknowns."""

    @abc.abstractmethod
    def tangents(
        self,
        inverses: Any,
        a: Any,
        b: Any,
        free: Int[Array, " free"],
        push: Callable[..., tuple[Array, Array, Array]],
    ) -> Callable[..., tuple[Array, Array, Array]]:
        """The tangents of `(y, f, g)` at the end of a step, as a linear function of `(by_numbers, load)`.

        `by_numbers`: the tangents of `(y, f, g)` for a held y and rate; `load`: the tangent of `past + a f + b g` for
        held f and g.

        **Arguments:** `push`: the tangents of `(y, f, g)` by the tangents of y and of the rate that g is along.
        """


class KnownStep(eqx.Module):
    """A step with a known end.

    **Fields:** the `solution` of its equations, and the end `t`; `past`, `a`, `b` and `free` as in `StepEquation`.
    """

    solution: Solution
    t: Any
    past: Float[Array, " n"]
    a: Any
    b: Any
    free: Int[Array, " free"]


@eqx.filter_custom_jvp
def at_end(
    end: tuple[Array, Array, Array], step: KnownStep, matrix: AbstractLinearization, inverses: Any
) -> tuple[Array, Array, Array]:
    """`(y, f, g)` at the end of a step, the solution of `y = past + a f + b g`, with its exact derivatives.

    **Arguments:** `end`: these numbers; `matrix`: the last matrix of Newton's method.
    """
    del step, matrix, inverses
    return end


@at_end.def_jvp
def _at_end_jvp(primals, tangents):
    _, step, matrix, inverses = primals
    along = tangents[1]
    y, f, g = out = at_end(*primals)
    has_tangent = jax.tree.map(lambda d: d is not None, along.solution, is_leaf=lambda x: x is None)
    numbers, rest = eqx.partition(step.solution, has_tangent)
    by_numbers, by_state = linearized(lambda x: eqx.combine(x, rest), numbers, step.t, y, f)
    solve = matrix.tangents(inverses, step.a, step.b, step.free, by_state)
    load = filled(step.past, along.past) + filled(step.a, along.a) * f + filled(step.b, along.b) * g
    return out, solve(by_numbers(along.solution, along.t), load)


class Solved(NamedTuple):
    """The end of a step, without derivatives.

    **Fields:** whether Newton's method `converged`; its last `matrix`, with the `inverses`; `work`: numbers of
    evaluations of f and g, and of matrices.
    """

    end: Derivatives
    converged: Bool[Array, ""]
    matrix: AbstractLinearization
    inverses: Any
    work: Int[Array, "2"]


class _Iterate(NamedTuple):
    """**Fields:** `change`: the next correction; `size`: its norm, the larger of both with and without the derivative
    of g for a held rate; `rate`: the ratio of `size` to the previous one.
    """

    end: Derivatives
    change: Float[Array, " free"]
    size: Float[Array, ""]
    rate: Float[Array, ""]
    iterations: Int[Array, ""]


class Newton(eqx.Module):
    """Newton's method for the equation of a step.

    The iteration starts from the predicted y and rate, with the current iteration matrix (modified Newton). If
    iterations with it would cost more than a new matrix, a new one is computed at the best y so far, for the rate
    there. Where the direction of a stiff spring turns, the prediction is too inaccurate for a new matrix: stiffness
    multiplies the error of the predicted rate, and this error changes the matrix considerably.

    g is evaluated along the predicted rate, then along the f after each correction. In f itself, stiffness multiplies
    the error of y. In g this error would spoil other components by the change of the Jacobian, times the square of the
    step. Newton's method would then converge only from nearby: for Robertson's reaction, from a basin below round-off.

    If the error of the prediction is as large as the state, as at the end of a fast transient, there is no second
    correction. With a large matrix the second correction might appear negligible far from any solution.

    The last correction is not applied to y. It is applied to f and g only through the current matrix, since stiffness
    would multiply its error there and spoil predictions.

    **Fields:** the `equation`; `size`: the norm of a correction in units of the tolerance; `tol`: the largest norm of
    the last correction.
    """

    equation: StepEquation
    size: Callable[[Array], Any]
    tol: float

    def solve(
        self,
        predicted: tuple[Float[Array, " n"], Float[Array, " n"]],
        before: tuple[Float[Array, " n"], Float[Array, " n"]],
        matrix: AbstractLinearization,
    ) -> Solved:
        """The end of the step, from the `predicted` y and rate, with the current matrix.

        **Arguments:** `before`: the state before the step and its rate, from which Newton's method restarts if the
        field was not finite.
        """
        equation, size, tol = self.equation, self.size, self.tol
        field, t = equation.field, equation.t
        shapes = eqx.filter_eval_shape(derivatives, field, t, predicted[0])
        blank = lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else jnp.asarray(x)
        blank_end = jax.tree.map(blank, shapes)
        zero, one = jnp.zeros((), jnp.int32), jnp.ones((), equation.past.dtype)

        def iterate(matrix, inverses, carry: _Iterate) -> _Iterate:
            (y, f), push, rest = jax.linearize(field, t, carry.end.y - matrix.moved(carry.change), has_aux=True)
            along = carry.end.f
            g = push(jnp.ones_like(t), along)[1]
            change, without, corrected, g = matrix.correction(inverses, equation, y, f, g, along)
            now = jnp.maximum(size(matrix.moved(change)), size(matrix.moved(without)))
            return _Iterate(Derivatives(y, corrected, g, rest), change, now, now / carry.size, carry.iterations + 1)

        patience = matrix.patience
        far = jnp.maximum(_FAR * (size(before[0]) + size(equation.a * before[1])), 1.0)

        def proceed(carry: _Iterate) -> Bool[Array, ""]:
            hopeful = (carry.iterations < 2) | (carry.size * carry.rate**patience <= tol)
            hopeful = hopeful & ((carry.iterations < 1) | (carry.size <= far))
            # Before the first iteration the size is infinite.
            return ~(carry.size <= tol) & (carry.iterations < _MAX_ITERATIONS) & hopeful

        def attempt(carry):
            k, (start, rate), matrix, _, _, work = carry
            anew = (matrix.renewals > 0) | (k > 0)
            renewed = lambda old: eqx.tree_at(lambda m: m.renewals, old.renewed(equation, start, rate), old.renewals)
            matrix = cond_of_any_lane(anew, renewed, lambda old: old, matrix)
            inverses = matrix.inverses(equation.a, equation.b, equation.free)
            matrix = matrix.observed(inverses, anew)
            first = _Iterate(
                blank_end._replace(y=start, f=rate), jnp.zeros(equation.free.size, one.dtype), one * jnp.inf, one, zero
            )
            last = lax.while_loop(proceed, functools.partial(iterate, matrix, inverses), first)
            converged = last.size <= tol
            slow = (last.iterations > 2) & (last.rate > matrix.slow)
            renewals = jnp.maximum(matrix.renewals - 1, slow.astype(jnp.int32))
            renewals = jnp.where(converged, renewals, jnp.asarray(_DISTRUST, jnp.int32))
            matrix = eqx.tree_at(lambda m: m.renewals, matrix, renewals)
            # A matrix is not computed twice for the same state.
            farther = jnp.where(anew, last.end.y, start)
            nearest = jnp.where(last.rate < 1, last.end.y - matrix.moved(last.change), farther)
            finite = jnp.isfinite(last.size)
            place = jnp.where(finite, nearest, before[0]), jnp.where(finite, last.end.f, before[1])
            work = work + jnp.stack([last.iterations, anew.astype(jnp.int32)])
            return jnp.where(converged, _DONE, k + 1).astype(jnp.int32), place, matrix, inverses, last.end, work

        inverses = matrix.no_inverses(equation.a, equation.b, equation.free)
        carry = zero, predicted, matrix, inverses, blank_end, jnp.zeros(2, jnp.int32)
        k, _, matrix, inverses, end, work = lax.while_loop(lambda carry: carry[0] < _ATTEMPTS, attempt, carry)
        return Solved(end, k == _DONE, matrix, inverses, work)


def tangents_nearby(
    matrix: AbstractLinearization,
    inverses: Any,
    equation: StepEquation,
    push: Callable[..., tuple[Array, Array, Array]],
    by_numbers: tuple[Array, Array, Array],
    predicted: tuple[Float[Array, " n"], Float[Array, " n"]],
    size: Callable[[Array], Any],
    tol: float,
    begins: Bool[Array, ""],
) -> tuple[Array, Array, Array]:
    """The tangents of `(y, f, g)` at the end of a step, by Newton's method with the step's matrix.

    **Arguments:** `equation`: of the tangents, for its `past`, `a`, `b` and `free`; `push`, `by_numbers`: as of
    `AbstractLinearization.tangents`; the `predicted` tangents of the state and of the rate; `size`, `tol`: as of
    `Newton`; `begins`: whether this is a start, whose state is the predicted one.
    """

    def proceed(carry):
        k, _, _, _, last, before = carry
        return (k < _MAX_ITERATIONS) & ~(last <= tol) & ((k < 2) | (last < before))

    def iterate(carry):
        k, x, along, _, last, _ = carry
        y, f, g = map(jnp.add, by_numbers, push(x, along))
        change, without, *corrected = matrix.correction(inverses, equation, y, f, g, along)
        now = jnp.maximum(size(matrix.moved(change)), size(matrix.moved(without)))
        # At a start the first evaluation gives the rate, the second gives g along this rate.
        now = jnp.where(begins, jnp.where(k == 0, jnp.inf, 0.0).astype(now.dtype), now)
        f, g = (jnp.where(begins, *both) for both in zip((f, g), corrected, strict=True))
        return k + 1, jnp.where(begins, x, x - matrix.moved(change)), f, (y, f, g), now, last

    infinite = jnp.full((), jnp.inf, by_numbers[0].dtype)
    start = jnp.zeros((), jnp.int32), predicted[0] - by_numbers[0], predicted[1], by_numbers, infinite, infinite
    return lax.while_loop(proceed, iterate, start)[3]
