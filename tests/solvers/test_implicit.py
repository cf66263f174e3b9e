"""The derivative of an implicit step, against that of the equation solved to rounding."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.solvers._dense import DenseLinearization
from jaxmb.solvers._field import derivatives
from jaxmb.solvers._newton import KnownStep, at_end

pytestmark = pytest.mark.slow


class Field(eqx.Module):
    parameter: jax.Array

    def __call__(self, t, y):
        f = jnp.stack([-self.parameter * jnp.sin(y[0]) + y[1] * t, -3.0 * y[1] + y[0] ** 2])
        return (y, f), None


def along(field, t, y, f, rate):
    del f
    (y, f), (_, g) = jax.jvp(lambda t, y: field(t, y)[0], (t, y), (jnp.ones_like(t), rate))
    return y, f, g


def solved(x, a, b):
    """The step's end as unrolled Newton iterations, which autodiff goes through."""
    field, t, past = Field(x[0]), x[1], x[2:]

    def residual(y):
        _, f, g, _ = derivatives(field, t, y)
        return y - past - a * f - b * g

    y = past
    for _ in range(8):
        y = y - jnp.linalg.solve(jax.jacfwd(residual)(y), residual(y))
    return derivatives(field, t, y)[:3]


@pytest.mark.parametrize("b", [-0.02, -0.002, 0.003], ids=["complex roots", "real roots", "of opposite signs"])
def test_derivative_of_a_step(b):
    a, x = 0.15, jnp.array([4.0, 0.7, 0.3, -0.5])
    end, one, free = jax.lax.stop_gradient(solved(x, a, b)), jnp.asarray(1.0), jnp.arange(2)
    matrix = DenseLinearization.unknown(end[0], free)

    def stepped(x):
        solution = eqx.Partial(along, Field(x[0]))
        return at_end(end, KnownStep(solution, x[1], x[2:], a * one, b * one, free), matrix, None)

    expected = jax.jacfwd(lambda x: solved(x, a, b))(x)
    for mode in (jax.jacfwd, jax.jacrev):
        for own, other in zip(jax.jit(mode(stepped))(x), expected, strict=True):
            np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-12)
