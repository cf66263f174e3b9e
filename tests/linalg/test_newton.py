"""Newton's method and its chord variant: what they find, how many corrections they make, and the derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.newton import chord, newton, root


def square_root(c):
    """√c by Newton's method, elementwise."""

    def solve(residual, start):
        def correct(x):
            step = residual(x) / (2 * x)
            return x - step, jnp.max(jnp.abs(step))

        return newton(correct, lambda x, size: size > 1e-14 * jnp.max(x), start, most=50, dtype=start.dtype)[0]

    return root(lambda x: x * x - c, jnp.ones_like(c), solve)


@pytest.mark.slow
def test_root_and_its_derivatives():
    c = jnp.array([0.5, 2.0, 9.0])
    np.testing.assert_allclose(square_root(c), np.sqrt(c), rtol=1e-14)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(square_root)(c), np.diag(0.5 / np.sqrt(c)), rtol=1e-13, atol=1e-15)
    first = lambda x: jnp.sum(jax.jacfwd(square_root)(x))
    np.testing.assert_allclose(jax.grad(first)(c), -0.25 * c**-1.5, rtol=1e-12)


def test_newton_stops_at_its_bound_and_where_there_is_no_number():
    count = lambda far, most: int(newton(lambda x: (x + 1, x * 0.0), far, jnp.array(0.0), most=most, dtype=float)[0])
    assert count(lambda x, size: x < 3, 10) == 3
    assert count(lambda x, size: x < 30, 10) == 10
    lost, size = newton(lambda x: (x / 0.0, x / 0.0), lambda _, size: size > 0, jnp.array(0.0), most=9, dtype=float)
    assert np.isnan(lost) and np.isnan(size)


@pytest.mark.parametrize(("first", "corrections"), [(1.0, 1), (0.0, 2)])
def test_chord_with_the_right_matrix(first, corrections):
    correct = lambda x: (x - (x - 5e-10), jnp.abs(x - 5e-10))
    x, k, failed = chord(correct, jnp.array(0.0), first=jnp.array(first), tol=1e-12, most=12)
    assert int(k) == corrections and not failed
    assert float(x) == pytest.approx(5e-10, abs=1e-20)


def test_chord_converges_at_the_rate_of_its_matrix_or_fails():
    wrong = lambda slope: lambda x: (x - (2 * x - 0.1) / slope, jnp.abs(2 * x - 0.1) / slope)
    run = lambda slope: chord(wrong(slope), jnp.array(0.0), first=jnp.array(1.0), tol=1e-12, most=12)
    x, k, failed = run(2.1)
    # Corrections shrink by a factor of 21; the last one that is made need not be below the tolerance.
    assert not failed and float(x) == pytest.approx(0.05, abs=1e-12) and 8 <= int(k) <= 10
    _, k, failed = run(0.5)
    assert failed and int(k) <= 12
