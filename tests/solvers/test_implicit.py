"""Corrections of an implicit step, and its derivative against that of the equation solved to rounding."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.solvers._dense import DenseLinearization, inverse
from jaxmb.solvers._field import derivatives
from jaxmb.solvers._newton import KnownStep, StepEquation, at_end


class Field(eqx.Module):
    parameter: jax.Array

    def __call__(self, t, y):
        f = jnp.stack([-self.parameter * jnp.sin(y[0]) + y[1] * t, -3.0 * y[1] + y[0] ** 2])
        return (y, f), None


def along(field, t, y, f, rate):
    del f
    (y, f), (_, g) = jax.jvp(lambda t, y: field(t, y)[0], (t, y), (jnp.ones_like(t), rate))
    return y, f, g


def solved(x, a, b, start, turns):
    """The step's end by Newton iterations; one, from the root, has its derivative."""
    field, t, past = Field(x[0]), x[1], x[2:]

    def residual(y):
        _, f, g, _ = derivatives(field, t, y)
        return y - past - a * f - b * g

    corrected = lambda y: y - jnp.linalg.solve(jax.jacfwd(residual)(y), residual(y))
    y = corrected(start) if turns == 1 else jax.lax.fori_loop(0, turns, lambda _, y: corrected(y), start)
    return derivatives(field, t, y)[:3]


def test_correction_follows_the_derivatives_along_the_motion():
    """f and g after a correction are those of the corrected state, up to its square."""
    field, t, h, free = Field(jnp.array(4.0)), jnp.asarray(0.7), 0.1, jnp.arange(2)
    A, along_A = np.random.default_rng(1).normal(size=(2, 3, 3))

    @jax.jit
    def run(y, shift):
        f = field(t, y)[0][1]
        matrix = DenseLinearization.unknown(y, free).renewed(StepEquation(field, None, t, h, y, h, 0.0, free), y, f)
        a, b = jnp.asarray(0.15), jnp.asarray(-0.02)
        _, f, g, _ = derivatives(field, t, y)
        equation = StepEquation(field, None, t, h, y - a * f - b * g + shift, a, b, free)
        change, _, corrected, acceleration = matrix.correction(matrix.inverses(a, b, free), equation, y, f, g, f)
        _, expected, rate, _ = derivatives(field, t, y - matrix.moved(change))
        turned = jax.jvp(inverse, (jnp.asarray(A),), (jnp.asarray(along_A),))[1]
        return change, corrected - expected, acceleration - rate, turned

    change, of_f, of_g, turned = run(np.array([0.3, -0.5]), np.array([1e-3, -2e-3]))
    assert np.max(np.abs(change)) > 5e-4
    np.testing.assert_allclose(of_f, 0.0, atol=1e-5)
    np.testing.assert_allclose(of_g, 0.0, atol=1e-4)
    np.testing.assert_allclose(turned, -np.linalg.inv(A) @ along_A @ np.linalg.inv(A), rtol=1e-10, atol=1e-10)


def test_derivative_of_a_step():
    """With complex and real roots, and with roots of opposite signs; the length of the step changes as well."""
    x, rng = np.array([4.0, 0.7, 0.3, -0.5]), np.random.default_rng(0)
    direction, weights = rng.normal(size=4), tuple(rng.normal(size=(3, 2)))

    @jax.jit
    @jax.vmap
    def run(b):
        a, free = jnp.asarray(0.15), jnp.arange(2)
        end = solved(x, a, b, x[2:], 8)
        # Coefficients of the step with these values, and with derivatives.
        of_f, of_g = lambda x: a * x[1] / 0.7, lambda x: b * (x[1] / 0.7) ** 2
        matrix = DenseLinearization.unknown(end[0], free)
        solution = lambda x: eqx.Partial(along, Field(x[0]))
        stepped = lambda x: at_end(end, KnownStep(solution(x), x[1], x[2:], of_f(x), of_g(x), free), matrix, None)
        push = lambda f: jax.jvp(f, (jnp.asarray(x),), (jnp.asarray(direction),))[1]
        return (
            push(lambda x: solved(x, of_f(x), of_g(x), end[0], 1)),
            push(stepped),
            jax.vjp(stepped, jnp.asarray(x))[1](weights),
        )

    expected, forward, (reverse,) = run(np.array([-0.02, -0.002, 0.003]))
    for own, other in zip(forward, expected, strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-12)
    weighted = sum(np.asarray(own) @ w for own, w in zip(expected, weights, strict=True))
    np.testing.assert_allclose(reverse @ direction, weighted, rtol=1e-9)
