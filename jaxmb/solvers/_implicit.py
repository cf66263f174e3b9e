"""Implicit steps that use the second derivative: Newton's method, and the exact derivative of its solution.

A step solves `y = past + a f(t, y) + b g(t, y)`, where `g` is the time derivative of `f` along the solution: one
directional derivative of `f`, exact. On a manifold the unknowns are the free components only; the others, and with
them f and g, follow from the constraints.
"""

import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from .._compat import cond_of_any_lane, sequential_vmap
from ._damping import eigenvalues
from ._field import Derivatives, Field, derivatives, filled, linearized
from ._linearization import AbstractLinearization

_MAX_ITERATIONS = 10
# The matrix is renewed after a step whose corrections shrank more slowly than by this factor.
_SLOW = 0.2
# If a matrix of an earlier step has failed, this number of steps compute their own.
_DISTRUST = 10
# If a correction is larger than this fraction of the state and its change, the matrix is not reliable at its end.
_FAR = 0.1
# The largest number of matrices for a step; and the code for success.
_ATTEMPTS, _DONE = 4, 9
# The derivative of the Jacobian along the motion is a difference over this power of the rounding unit, in steps: with
# longer differences the truncation error, which is stiff, slows Newton's method, with shorter ones the rounding error.
_AHEAD = 0.4


class Linearization(AbstractLinearization):
    """Full matrices: how a state and its derivatives in time change with the free components.

    **Fields:** derivatives of the `state`, of its `rate` f, and of the `acceleration` g where f is held; `spectrum`:
    the eigenvalues of J, the free rows of `rate`; `renewals`: the number of next steps that must compute their own
    matrix.
    """

    state: Float[Array, "n free"]
    rate: Float[Array, "n free"]
    acceleration: Float[Array, "n free"]
    spectrum: Complex[Array, " free"]
    renewals: Int[Array, ""]

    is_structured: ClassVar[bool] = False

    # A new matrix costs about as much as half an iteration per column, and two or three iterations follow.
    @property
    def patience(self) -> int:
        return 2 + self.spectrum.size // 2

    @property
    def slow(self) -> float:
        return _SLOW

    def inverses(self, a: Any, b: Any, free: Int[Array, " free"]) -> "Inverses":
        return inverses_of(self.rate[free], self.acceleration[free], a, b)

    def no_inverses(self, a: Any, b: Any, free: Int[Array, " free"]) -> "Inverses":
        del a, b
        zeros = jnp.zeros((free.size, free.size), self.state.dtype)
        return Inverses(zeros, zeros, zeros[0, 0], zeros)

    def observed(self, inverses: "Inverses", anew: Bool[Array, ""]) -> "Linearization":
        del inverses, anew
        return self

    def moved(self, change: Float[Array, " free"]) -> Float[Array, " n"]:
        return self.state @ change

    def correction(self, inverses: "Inverses", offset, f, g, along, b, free):
        # The stiffest part of g is combined with f: both are large and nearly cancel.
        mismatch = g[free] - self.rate[free] @ along[free]
        without = inverses.p @ (offset[free] - b * mismatch) - inverses.p_rate @ f[free]
        change = inverses.c @ without
        corrected = f - self.rate @ change
        g = g + self.rate @ (corrected - along)[free] - self.acceleration @ change
        return change, without, corrected, g

    def errors(self, inverses: "Inverses", changes: Float[Array, "formulas n"], free: Int[Array, " free"]):
        errors = changes[:, free] @ (self.state @ inverses.p).T
        if free.size < changes.shape[1]:
            errors = errors + (changes - changes[:, free] @ self.state.T)
        return errors


def linearize(
    field: Field,
    t: Any,
    y: Float[Array, " n"],
    rate: Float[Array, " n"],
    h: Any,
    free: Int[Array, " free"],
) -> Linearization:
    """The derivatives of a field with respect to the free components, for a step h and a held `rate`.

    That of g is the derivative of the Jacobian along the motion. A difference is accurate enough for Newton's method;
    third derivatives of the field would dominate compile time.
    """
    unit = jnp.zeros((free.shape[0], y.size), y.dtype).at[jnp.arange(free.shape[0]), free].set(1)

    def columns(place):
        _, push = jax.linearize(lambda t, y: field(t, y)[0], *place)
        return jax.vmap(lambda along: push(jnp.zeros_like(t), along), out_axes=-1)(unit)

    ahead = jnp.asarray(jnp.finfo(y.dtype).eps ** _AHEAD, y.dtype) * h
    later = t + ahead.astype(t.dtype), y + ahead * rate
    # A loop, so that the field is compiled once for both places.
    states, rates = lax.map(columns, jax.tree.map(lambda *x: jnp.stack(x), (t, y), later))
    return Linearization(
        states[0],
        rates[0],
        (rates[1] - rates[0]) / ahead,
        eigenvalues(rates[0][free]),
        jnp.array(0, jnp.int32),
    )


class Inverses(NamedTuple):
    """Inverses for `(P - C) x = r`, with `P = 1 - a J - b J²` and `C = b K`, K the derivative of g at a held rate.

    **Fields:** `p`: P⁻¹; `p_rate`: `P⁻¹ (a + b J)`; `missing`: how much less than b the factor of J² in P is; `c`:
    `(1 - P⁻¹ (C + missing J²))⁻¹`, to be applied after P⁻¹. With a wrong rate `c` can be so small that it hides errors:
    errors of a step are measured by P⁻¹ alone.
    """

    p: Float[Array, "free free"]
    p_rate: Float[Array, "free free"]
    missing: Float[Array, ""]
    c: Float[Array, "free free"]


def inverses_of(jacobian: Float[Array, "free free"], held: Float[Array, "free free"], a: Any, b: Any) -> Inverses:
    """The inverses of Newton's method, each as accurate as one of a matrix with a single J; `held` is the derivative of
    g at a held rate.
    """
    identity = jnp.eye(jacobian.shape[0], dtype=jacobian.dtype)
    # 1 - a x - b x^2 = (1 - r x)(1 - r* x): one complex matrix instead of the square of a large one. The roots are
    # complex for all formulas with equal steps; real roots are replaced by the nearest complex ones.
    product, least = -b - a**2 / 4, a**2 / 1000
    real, imaginary = a / 2, jnp.sqrt(jnp.maximum(product, least))
    once = inverse(lax.complex(identity - real * jacobian, -imaginary * jacobian))
    # The imaginary parts of r, r^2 and 1 times this inverse, over that of r.
    along, across = jnp.real(once), jnp.imag(once) / imaginary
    p_rate = a * along + (real**2 - imaginary**2) * across
    p = along + real * across
    missing = jnp.maximum(least - product, jnp.zeros_like(product))
    c = inverse(identity - p @ (b * held + missing * jacobian @ jacobian))
    return Inverses(p, p_rate, missing, c)


# Members of a batch are treated one after the other; see `jaxmb.linalg`.
@sequential_vmap
def _lapack_inverse(matrix):
    return jnp.linalg.inv(matrix)


@jax.custom_jvp
def inverse(matrix: Array) -> Array:
    """The inverse of a matrix."""
    return _lapack_inverse(matrix)


@inverse.defjvp
def _inverse_jvp(primals, tangents):
    out = inverse(*primals)
    return out, -out @ tangents[0] @ out


class Solved(NamedTuple):
    """The end of a step, without derivatives; whether Newton's method `converged`; its last matrix, with the inverses;
    and its `work`: numbers of evaluations of f and g, and of matrices.
    """

    end: Derivatives
    converged: Bool[Array, ""]
    matrix: AbstractLinearization
    inverses: Any
    work: Int[Array, "2"]


class _Iterate(NamedTuple):
    """`change` is the next correction, `size` its norm (the larger of those with and without the derivative of g at a
    held rate), and `rate` the ratio of `size` to the previous one.
    """

    end: Derivatives
    change: Float[Array, " free"]
    size: Float[Array, ""]
    rate: Float[Array, ""]
    iterations: Int[Array, ""]


def solve(
    field: Field,
    t: Any,
    past: Float[Array, " n"],
    a: Any,
    b: Any,
    predicted: tuple[Float[Array, " n"], Float[Array, " n"]],
    before: tuple[Float[Array, " n"], Float[Array, " n"]],
    free: Int[Array, " free"],
    matrix: AbstractLinearization,
    size: Callable[[Array], Any],
    tol: float,
    renew: Callable[[Float[Array, " n"], Float[Array, " n"]], Any],
) -> Solved:
    """Solve `y = past + a f + b g` for the free components by Newton's method.

    The iteration starts from the `predicted` y and rate, with the current iteration matrix (modified Newton). If
    iterations with it would cost more than a new matrix, one is computed at the best y so far, for the rate there. The
    prediction is not good enough where the direction of a stiff spring turns: the error of its rate is multiplied by
    the stiffness and changes the matrix considerably.

    **Arguments:** `before`: the state before the step and its rate, where Newton's method restarts if the field was not
    finite; `matrix`: the current one; `size`: the norm of a correction in units of the tolerance, and `tol`: the norm
    of the last correction, which is not applied to y, and to f and g only through the current matrix, since stiffness
    would multiply its error there and spoil predictions; `renew`: computes a matrix at a state, for a rate.

    g is evaluated along the predicted rate, then along the f after each correction. In f itself the error of y is
    multiplied by the stiffness; in g it would spoil other components by the change of the Jacobian, times the square of
    the step: Newton's method would converge only from nearby, and on Robertson's reaction only inside a basin smaller
    than round-off.

    If the error of the prediction is as large as the state, as at the end of a fast transient, the matrix there may be
    so large that the second correction appears negligible far from any solution; it is not computed.
    """

    shapes = eqx.filter_eval_shape(derivatives, field, t, predicted[0])
    blank = lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, jax.ShapeDtypeStruct) else jnp.asarray(x)
    nothing = jax.tree.map(blank, shapes)
    none, one = jnp.zeros((), jnp.int32), jnp.ones((), past.dtype)

    def iterate(matrix, inverses, carry: _Iterate) -> _Iterate:
        (y, f), push, rest = jax.linearize(field, t, carry.end.y - matrix.moved(carry.change), has_aux=True)
        along = carry.end.f
        g = push(jnp.ones_like(t), along)[1]
        change, without, corrected, g = matrix.correction(inverses, y - past, f, g, along, b, free)
        now = jnp.maximum(size(matrix.moved(change)), size(matrix.moved(without)))
        return _Iterate(Derivatives(y, corrected, g, rest), change, now, now / carry.size, carry.iterations + 1)

    patience = matrix.patience
    far = jnp.maximum(_FAR * (size(before[0]) + size(a * before[1])), 1.0)

    def proceed(carry: _Iterate) -> Bool[Array, ""]:
        hopeful = (carry.iterations < 2) | (carry.size * carry.rate**patience <= tol)
        hopeful = hopeful & ((carry.iterations < 1) | (carry.size <= far))
        # Before the first iteration the size is infinite.
        return ~(carry.size <= tol) & (carry.iterations < _MAX_ITERATIONS) & hopeful

    def attempt(carry):
        k, (start, rate), matrix, _, _, work = carry
        anew = (matrix.renewals > 0) | (k > 0)
        renewed = lambda old: eqx.tree_at(lambda m: m.renewals, renew(start, rate), old.renewals)
        matrix = cond_of_any_lane(anew, renewed, lambda old: old, matrix)
        inverses = matrix.inverses(a, b, free)
        matrix = matrix.observed(inverses, anew)
        first = _Iterate(nothing._replace(y=start, f=rate), jnp.zeros(free.size, past.dtype), one * jnp.inf, one, none)
        last = lax.while_loop(proceed, functools.partial(iterate, matrix, inverses), first)
        converged = last.size <= tol
        slow = (last.iterations > 2) & (last.rate > matrix.slow)
        renewals = jnp.maximum(matrix.renewals - 1, slow.astype(jnp.int32))
        renewals = jnp.where(converged, renewals, jnp.asarray(_DISTRUST, jnp.int32))
        matrix = eqx.tree_at(lambda m: m.renewals, matrix, renewals)
        # A matrix is not computed for the same state again.
        farther = jnp.where(anew, last.end.y, start)
        nearest = jnp.where(last.rate < 1, last.end.y - matrix.moved(last.change), farther)
        finite = jnp.isfinite(last.size)
        place = jnp.where(finite, nearest, before[0]), jnp.where(finite, last.end.f, before[1])
        work = work + jnp.stack([last.iterations, anew.astype(jnp.int32)])
        return jnp.where(converged, _DONE, k + 1).astype(jnp.int32), place, matrix, inverses, last.end, work

    inverses = matrix.no_inverses(a, b, free)
    carry = none, predicted, matrix, inverses, nothing, jnp.zeros(2, jnp.int32)
    k, _, matrix, inverses, end, work = lax.while_loop(lambda carry: carry[0] < _ATTEMPTS, attempt, carry)
    return Solved(end, k == _DONE, matrix, inverses, work)


@eqx.filter_custom_jvp
def differentiable(
    end: tuple[Array, Array, Array],
    field: Field,
    t: Any,
    past: Float[Array, " n"],
    a: Any,
    b: Any,
    free: Int[Array, " free"],
) -> tuple[Array, Array, Array]:
    """`(y, f, g)` at the `end` of a step, a solution of `y = past + a f + b g`, with its derivatives."""
    del field, t, past, a, b, free
    return end


@differentiable.def_jvp
def _differentiable_jvp(primals, tangents):
    _, field, t, past, a, b, free = primals
    _, dfield, dt, dpast, da, db, _ = tangents
    y, f, g = differentiable(*primals)
    still = jnp.zeros(free.shape[0], y.dtype)
    moved, push = linearized(field, dfield, t, dt, lambda change: y.at[free].add(change), still, f)
    columns = jax.vmap(push, out_axes=-1)(jnp.eye(still.size, dtype=still.dtype))
    jacobian, held = columns[1][free], columns[2][free]
    inverses = inverses_of(jacobian, held, a, b)
    load = (filled(dpast, past) + filled(da, a) * f + filled(db, b) * g + b * moved[2])[free]

    def correction(change):
        # Large terms are combined as in `solve`, so the result does not depend on the last digits of an inverse.
        rate = moved[1][free] + jacobian @ change
        mismatch = change - load - b * held @ change - inverses.missing * jacobian @ rate
        return inverses.c @ (inverses.p @ mismatch - inverses.p_rate @ rate), rate

    change = -correction(still)[0]
    left, rate = correction(change)
    rate = rate - jacobian @ left
    dy, df, dg = (along + column @ change for along, column in zip(moved, columns, strict=True))
    df = df.at[free].set(rate, unique_indices=True)
    return (y, f, g), (dy, df, dg + columns[1] @ rate)
