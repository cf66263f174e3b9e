"""Newton's method with full matrices, for the free components of a state.

On a manifold the unknowns are the free components only; the others, and with them f and g, follow from the constraints.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from .._compat import sequential_vmap
from ._damping import eigenvalues
from ._field import Field, probed_derivatives
from ._newton import AbstractLinearization, StepEquation

# The matrix is renewed after a step whose corrections shrank more slowly than by this factor.
_SLOW = 0.2
# The derivative of the Jacobian along the motion is a difference over a time of this power of the rounding unit, in
# steps. Over longer times the stiff truncation error slows Newton's method, over shorter times the rounding error.
_AHEAD = 0.4


class DenseLinearization(AbstractLinearization):
    """Full matrices: how a state and its time derivatives change with the free components.

    **Fields:** derivatives of the `state`, of its `rate` f, and of the `acceleration` g for a held f; `spectrum`: the
    eigenvalues of J, the free rows of `rate`; `renewals`: the number of next steps that must compute a new matrix.
    """

    state: Float[Array, "n free"]
    rate: Float[Array, "n free"]
    acceleration: Float[Array, "n free"]
    spectrum: Complex[Array, " free"]
    renewals: Int[Array, ""]

    @classmethod
    def unknown(cls, y: Float[Array, " n"], free: Int[Array, " free"]) -> "DenseLinearization":
        """Zeros, so that the first step computes its matrix."""
        none = jnp.zeros((y.size, free.size), y.dtype)
        spectrum = lax.complex(*[jnp.zeros(free.size, y.dtype)] * 2)
        return cls(none, none, none, spectrum, jnp.asarray(1, jnp.int32))

    # A new matrix costs about as much as half an iteration per column, and two or three iterations follow.
    @property
    def patience(self) -> int:
        return 2 + self.spectrum.size // 2

    @property
    def slow(self) -> float:
        return _SLOW

    def probed(self, field: Field, t: Any, y: Float[Array, " n"], size: Float[Array, " n"] | None):
        return probed_derivatives(field, t, y, size)

    def renewed(self, equation: StepEquation, y: Float[Array, " n"], rate: Float[Array, " n"]) -> "DenseLinearization":
        return linearize(equation.field, equation.t, y, rate, equation.h, equation.free)

    def inverses(self, a: Any, b: Any, free: Int[Array, " free"]) -> "Inverses":
        return inverses_of(self.rate[free], self.acceleration[free], a, b)

    def no_inverses(self, a: Any, b: Any, free: Int[Array, " free"]) -> "Inverses":
        del a, b
        zeros = jnp.zeros((free.size, free.size), self.state.dtype)
        return Inverses(zeros, zeros, zeros[0, 0], zeros)

    def observed(self, inverses: "Inverses", anew: Bool[Array, ""]) -> "DenseLinearization":
        del inverses, anew
        return self

    def moved(self, change: Float[Array, " free"]) -> Float[Array, " n"]:
        return self.state @ change

    def correction(self, inverses: "Inverses", equation: StepEquation, y, f, g, along):
        offset, b, free = y - equation.past, equation.b, equation.free
        # The stiffest part of g is combined with f: both are large and nearly cancel.
        mismatch = g[free] - self.rate[free] @ along[free]
        without = inverses.p @ (offset[free] - b * mismatch) - inverses.p_rate @ f[free]
        change = inverses.c @ without
        corrected = f - self.rate @ change
        g = g + self.rate @ (corrected - along)[free] - self.acceleration @ change
        return change, without, corrected, g

    def errors(self, inverses: "Inverses", free: Int[Array, " free"], changes: Float[Array, "formulas n"]):
        errors = changes[:, free] @ (self.state @ inverses.p).T
        if free.size < changes.shape[1]:
            errors = errors + (changes - changes[:, free] @ self.state.T)
        return errors

    def tangents(self, inverses: "Inverses", a: Any, b: Any, free: Int[Array, " free"], push):
        del inverses
        units = jnp.zeros((free.size, self.state.shape[0]), self.state.dtype).at[jnp.arange(free.size), free].set(1)
        state, rate, _ = jax.vmap(lambda x: push(x, None), out_axes=-1)(units)
        jacobian = rate[free]
        # A rate with held free components still satisfies the constraints at the moved state.
        turned = (rate - state @ jacobian).T
        _, _, acceleration = jax.vmap(push, out_axes=-1)(units, turned)
        of_g, exact = acceleration[free], inverses_of(jacobian, acceleration[free], a, b)

        def solve(by_numbers, load):
            y, f, g = by_numbers
            moved = f[free]
            g = g + push(None, f - state @ moved)[2]

            def correction(change):
                # Large terms are combined as in `correction` above, so the last digits of an inverse do not matter.
                slope = moved + jacobian @ change
                mismatch = change - (load + b * g)[free] - b * of_g @ change
                mismatch = mismatch - exact.missing * jacobian @ slope
                return exact.c @ (exact.p @ mismatch - exact.p_rate @ slope), slope

            change = -correction(jnp.zeros_like(moved))[0]
            remainder, slope = correction(change)
            slope = slope - jacobian @ remainder
            f = (f + rate @ change).at[free].set(slope, unique_indices=True)
            return y + state @ change, f, g + acceleration @ change + rate @ slope

        return solve


def linearize(
    field: Field,
    t: Any,
    y: Float[Array, " n"],
    rate: Float[Array, " n"],
    h: Any,
    free: Int[Array, " free"],
) -> DenseLinearization:
    """The derivatives of a field by the free components, for a step h and a held `rate`.

    The derivative of g contains the derivative of the Jacobian along the motion. A difference is accurate enough for
    Newton's method; third derivatives of the field would dominate compile time.
    """
    unit = jnp.zeros((free.shape[0], y.size), y.dtype).at[jnp.arange(free.shape[0]), free].set(1)

    def columns(place):
        _, push = jax.linearize(lambda t, y: field(t, y)[0], *place)
        return jax.vmap(lambda along: push(jnp.zeros_like(t), along), out_axes=-1)(unit)

    ahead = jnp.asarray(jnp.finfo(y.dtype).eps ** _AHEAD, y.dtype) * h
    later = t + ahead.astype(t.dtype), y + ahead * rate
    # A loop, so that the field is compiled once for both places.
    states, rates = lax.map(columns, jax.tree.map(lambda *x: jnp.stack(x), (t, y), later))
    return DenseLinearization(
        states[0],
        rates[0],
        (rates[1] - rates[0]) / ahead,
        eigenvalues(rates[0][free]),
        jnp.array(0, jnp.int32),
    )


class Inverses(NamedTuple):
    """Inverses for `(1 - a J - b J² - C) x = r`. `C = b K`, with the derivative K of g for a held rate.

    The part of `1 - a J - b J²` with complex roots is `P = 1 - a J - (b - missing) J²`.

    **Fields:** `p`: P⁻¹; `p_rate`: `P⁻¹ (a + (b - missing) J)`; `missing`: the part of b that P leaves out, zero for
    complex roots; `c`: `(1 - P⁻¹ (C + missing J²))⁻¹`, to be applied after P⁻¹. With a wrong rate a small `c` hides
    errors, so errors of a step are measured by P⁻¹ alone.
    """

    p: Float[Array, "free free"]
    p_rate: Float[Array, "free free"]
    missing: Float[Array, ""]
    c: Float[Array, "free free"]


def inverses_of(
    jacobian: Float[Array, "free free"], held_acceleration: Float[Array, "free free"], a: Any, b: Any
) -> Inverses:
    """The inverses of Newton's method, each as accurate as the inverse of a matrix with a single J.

    **Arguments:** `held_acceleration`: the derivative of g for a held rate.
    """
    identity = jnp.eye(jacobian.shape[0], dtype=jacobian.dtype)
    # 1 - a x - b x^2 = (1 - r x)(1 - r* x): one complex matrix instead of the square of a large one. The roots are
    # complex for all formulas with equal steps; real roots are replaced by the nearest complex ones.
    product, least = -b - a**2 / 4, a**2 / 1000 + jnp.finfo(jacobian.dtype).tiny
    real, imaginary = a / 2, jnp.sqrt(jnp.maximum(product, least))
    once = inverse(lax.complex(identity - real * jacobian, -imaginary * jacobian))
    # `p`, `p_rate` and `across`: the imaginary parts of r, r^2 and 1 times this inverse, over the imaginary part of r.
    along, across = jnp.real(once), jnp.imag(once) / imaginary
    p_rate = a * along + (real**2 - imaginary**2) * across
    p = along + real * across
    missing = jnp.maximum(least - product, jnp.zeros_like(product))
    c = inverse(identity - p @ (b * held_acceleration + missing * jacobian @ jacobian))
    return Inverses(p, p_rate, missing, c)


# Members of a batch are computed one after the other; see `jaxmb.linalg`.
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
