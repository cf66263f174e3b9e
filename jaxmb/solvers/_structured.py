"""Newton's method with a Jacobian of known structure, which some terms on a manifold provide.

All components of the state are unknowns, and each iterate is projected on the manifold. The solution is the projection
of `past + a f + b g`. With `1 - a x - b x² = (1 - r x)(1 - r* x)`, one factorisation of `1 - r J` for a complex number
r solves for corrections. The eigenvalues of J near 1 / r decide which formulas and steps are stable; they follow from
Arnoldi's method with the same factorisation. It leaves out some terms of the exact derivative, so Newton's method
converges linearly. The derivative of the solution is found by iteration with the exact function, preconditioned by the
factorisation.

Sources: Y. Saad, "Numerical Methods for Large Eigenvalue Problems", SIAM, 2011 (shift-and-invert Arnoldi); S. C.
Eisenstat, H. C. Elman and M. H. Schultz, SIAM J. Numer. Anal. 20(2), 1983 (generalized conjugate residuals).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from .._branches import cond_of_any_lane
from ._damping import eigenvalues
from ._field import Field, probed_derivatives
from ._newton import AbstractLinearization, StepEquation
from .evaluation import freeze
from .manifold_term import AbstractFieldJacobian, AbstractResolvent

# Steps of Arnoldi's method for the spectrum.
_ARNOLDI = 16
# Eigenvalues of the inverse below this fraction of the largest belong to components that decay, or change, in much less
# than a step.
_SMALL = 0.02
# A smaller part of a vector outside the space of the preceding vectors consists of rounding errors.
_ROUNDING = 1e-10
# A matrix is renewed after a step whose corrections shrank more slowly than by `_SLOW`. It is renewed in a step that
# would need more than about `_PATIENCE` further iterations.
_SLOW, _PATIENCE = 0.35, 8
# The largest number of iterations for derivatives; in rounding units, the relative residual at which they end, and the
# largest residual of a usable derivative.
_ITERATIONS, _RESIDUAL, _LARGEST_RESIDUAL = 40, 50, 1e5


class StructuredInverses(eqx.Module):
    """The factorisation of `1 - r J`, and the numbers of the step.

    **Fields:** `resolvent`; `a`, `b`; `r`.
    """

    resolvent: AbstractResolvent
    a: Float[Array, ""]
    b: Float[Array, ""]
    r: Complex[Array, ""]

    def solve(self, x: Float[Array, " n"], rates: Float[Array, " n"] | None = None) -> Any:
        """`(1 - a J - b J²)⁻¹ (x + (a + b J) rates)` of tangent vectors, and J times this result."""
        real, imaginary = jnp.real(self.r), jnp.imag(self.r)
        load = lax.complex(x, -real / imaginary * x)
        if rates is not None:
            load = load + lax.complex(self.a * rates, -(real**2 - imaginary**2) / imaginary * rates)
        solved = self.resolvent.solve(load)
        return jnp.real(solved), jnp.real((solved - load) / self.r)

    def transpose_solve(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """The transpose of `solve`, without rates."""
        real, imaginary = jnp.real(self.r), jnp.imag(self.r)
        solved = self.resolvent.transpose_solve(x.astype(self.r.dtype))
        return jnp.real(solved) + real / imaginary * jnp.imag(solved)


class StructuredLinearization(AbstractLinearization):
    """A matrix that knows its structure; the unknowns are all components of the state.

    **Fields:** the `jacobian` J of the term; `direction` of time; `spectrum`: eigenvalues of J of the sizes that
    formulas may amplify; `renewals`: the number of next steps that must compute a new matrix.
    """

    jacobian: AbstractFieldJacobian
    direction: Float[Array, ""]
    spectrum: Complex[Array, " k"]
    renewals: Int[Array, ""]

    @property
    def patience(self) -> int:
        return _PATIENCE

    @property
    def slow(self) -> float:
        return _SLOW

    def probed(self, field: Field, t: Any, y: Float[Array, " n"], size: Float[Array, " n"] | None):
        return probed_derivatives(field, t, y, size, along=True)

    def renewed(self, equation: StepEquation, y: Float[Array, " n"], rate: Float[Array, " n"]):
        del rate
        return structured(equation.jacobian, y)

    def inverses(self, a: Any, b: Any, free: Int[Array, " free"] | None = None) -> StructuredInverses:
        del free
        # The roots are complex for all formulas with equal steps; real roots are replaced by the nearest complex ones.
        product, least = -b - a**2 / 4, a**2 / 1000 + jnp.finfo(jnp.result_type(a)).tiny
        r = lax.complex(a / 2, jnp.sqrt(jnp.maximum(product, least)))
        return StructuredInverses(self.jacobian.resolvent(r * self.direction.astype(r.dtype)), a, b, r)

    def no_inverses(self, a: Any, b: Any, free: Int[Array, " free"]) -> StructuredInverses:
        shapes = eqx.filter_eval_shape(self.inverses, a, b)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def observed(self, inverses: StructuredInverses, anew: Bool[Array, ""]) -> "StructuredLinearization":
        """The same with the spectrum, computed if the matrix is new."""
        find = lambda old: _spectrum(inverses, self.jacobian.project)
        return eqx.tree_at(lambda m: m.spectrum, self, cond_of_any_lane(anew, find, lambda old: old, self.spectrum))

    def moved(self, change: Float[Array, " n"]) -> Float[Array, " n"]:
        return change

    def correction(self, inverses: StructuredInverses, equation: StepEquation, y, f, g, along):
        b = equation.b
        mismatch, lag = y - equation.past - inverses.a * along - b * g, along - f
        mismatch, lag = lax.map(self.jacobian.project, jnp.stack([mismatch, lag]))
        change, rate = inverses.solve(mismatch, lag)
        # This is f at y - change, for which y - change = past + a f + b g along the manifold.
        corrected = f - rate
        g = g - (change - mismatch - inverses.a * (lag + rate)) / b
        return change, change, corrected, g

    def errors(self, inverses: StructuredInverses, free: Int[Array, " free"], changes: Float[Array, "formulas n"]):
        del free

        def error(change):
            along = self.jacobian.project(change)
            return inverses.solve(along)[0] + change - along

        return lax.map(error, changes)

    def tangents(self, inverses: StructuredInverses, a: Any, b: Any, free: Int[Array, " free"], push):
        del free
        matrix, inverses = freeze((self, inverses))
        project = matrix.jacobian.project

        def twice(change):
            """The changes of y, f and g by a change of y; a loop, so that the linear function is compiled once."""
            still = jnp.zeros_like(change)
            _, changes = lax.scan(
                lambda rate, _: (lambda out: (out[1], out))(push(change, rate)), still, None, length=2
            )
            y, rate, acceleration = (x[1] for x in changes)
            return y, rate, acceleration

        def apply(change):
            _, rate, acceleration = twice(change)
            return change - a * rate - b * acceleration

        def precondition(x):
            tangent = project(x)
            return inverses.solve(tangent)[0] + x - tangent

        def precondition_transpose(x):
            pull = jax.linear_transpose(project, x)
            return x + pull(inverses.transpose_solve(x) - x)[0]

        def solve(by_numbers, load):
            acceleration = by_numbers[2] + push(None, by_numbers[1])[2]
            change = lax.custom_linear_solve(
                apply,
                load + a * by_numbers[1] + b * acceleration,
                lambda apply, x: _iterate(apply, precondition, x),
                lambda apply, x: _iterate(apply, precondition_transpose, x),
            )
            y, rate, by_change = twice(change)
            return by_numbers[0] + y, by_numbers[1] + rate, acceleration + by_change

        return solve


def structured(jacobian: Callable[[Float[Array, " n"]], Any], y: Float[Array, " n"]) -> StructuredLinearization | None:
    """The linearisation of a term that knows the structure of its Jacobian, without its spectrum; else None."""
    given = jacobian(y)
    if given is None:
        return None
    matrix, direction = given
    spectrum = lax.complex(*[jnp.zeros(_ARNOLDI, y.dtype)] * 2)
    return freeze(StructuredLinearization(matrix, direction.astype(y.dtype), spectrum, jnp.array(0, jnp.int32)))


def unknown_structure(
    jacobian: Callable[[Float[Array, " n"]], Any], y: Float[Array, " n"]
) -> StructuredLinearization | None:
    """Zeros for a term that knows the structure of its Jacobian, so that the first step computes it; else None."""
    shapes = eqx.filter_eval_shape(structured, jacobian, y)
    if shapes is None:
        return None
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return eqx.tree_at(lambda matrix: matrix.renewals, zeros, jnp.asarray(1, jnp.int32))


def _spectrum(inverses: StructuredInverses, project: Callable[[Array], Array]) -> Complex[Array, " k"]:
    """Eigenvalues of J near 1 / r, by Arnoldi's method for the inverse of `1 - r J`; zero for the others."""
    weights = inverses.resolvent.weights()
    n, m = weights.size, _ARNOLDI
    # Any start that excites all components.
    places = jnp.arange(n, dtype=weights.dtype)
    start = jnp.stack([jnp.cos(1.0 + 2.3 * places + 0.1 * places**2), jnp.sin(0.5 + 1.7 * places + 0.1 * places**2)])
    start = lax.map(lambda x: weights * project(x / weights), start)
    start = lax.complex(start[0], start[1])
    floor = jnp.finfo(weights.dtype).tiny
    size = lambda x: jnp.sqrt(jnp.sum(jnp.real(x * jnp.conj(x)))) + floor
    basis = jnp.zeros((m + 1, n), start.dtype).at[0].set(start / size(start).astype(start.dtype))

    scale = weights.astype(start.dtype)

    def extend(basis, k):
        x = scale * inverses.resolvent.solve(basis[k] / scale)
        column, whole = jnp.zeros(m + 1, x.dtype), size(x)
        # Two passes of Gram-Schmidt are enough.
        for _ in range(2):
            along = jnp.conj(basis) @ x
            column, x = column + along, x - along @ basis
        # Small machines have fewer eigenvalues than steps. The rest of x is then rounding errors, whose direction must
        # not enter the basis.
        length = size(x)
        new = length > _ROUNDING * whole
        x = jnp.where(new, x / length.astype(x.dtype), jnp.zeros_like(x))
        return basis.at[k + 1].set(x), column.at[k + 1].set(jnp.where(new, length, 0.0).astype(x.dtype))

    _, columns = lax.scan(extend, basis, jnp.arange(m))
    ritz_values = eigenvalues(columns[:, :m].T)
    magnitude = jnp.abs(ritz_values)
    counts = magnitude > _SMALL * jnp.max(magnitude)
    safe = jnp.where(counts, ritz_values, jnp.ones_like(ritz_values))
    return jnp.where(counts & jnp.isfinite(magnitude), (1 - 1 / safe) / inverses.r, jnp.zeros_like(ritz_values))


def _iterate(
    apply: Callable[[Array], Array], precondition: Callable[[Array], Array], load: Float[Array, " n"]
) -> Array:
    """The solution of a linear equation by generalized conjugate residuals; NaN without convergence."""
    n, dtype = load.size, load.dtype
    size = lambda x: jnp.sqrt(jnp.sum(x**2))
    unit = jnp.finfo(dtype).eps * size(load)

    def proceed(carry):
        k, _, residual, _, _ = carry
        return (k < _ITERATIONS) & (size(residual) > _RESIDUAL * unit)

    def step(carry):
        k, x, residual, directions, images = carry
        direction = precondition(residual)
        image = apply(direction)
        for _ in range(2):
            along = images @ image
            image, direction = image - along @ images, direction - along @ directions
        length = size(image) + jnp.finfo(dtype).tiny
        image, direction = image / length, direction / length
        part = jnp.sum(image * residual)
        return (
            k + 1,
            x + part * direction,
            residual - part * image,
            directions.at[k].set(direction),
            images.at[k].set(image),
        )

    blank = jnp.zeros((_ITERATIONS, n), dtype)
    start = jnp.array(0), jnp.zeros_like(load), load, blank, blank
    _, x, residual, _, _ = lax.while_loop(proceed, step, start)
    # A derivative that has not converged may look like one that has.
    return jnp.where(size(residual) <= _LARGEST_RESIDUAL * unit, x, jnp.full_like(x, jnp.nan))
