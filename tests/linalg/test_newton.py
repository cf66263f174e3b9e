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


def test_root_and_its_derivatives():
    c = np.array([0.5, 2.0, 9.0])

    @jax.jit
    def run(c):
        first = lambda x: jnp.sum(jax.jacfwd(square_root)(x))
        return square_root(c), jax.jacfwd(square_root)(c), jax.jacrev(square_root)(c), jax.grad(first)(c)

    value, forward, reverse, second = run(c)
    np.testing.assert_allclose(value, np.sqrt(c), rtol=1e-14)
    for slope in (forward, reverse):
        np.testing.assert_allclose(slope, np.diag(0.5 / np.sqrt(c)), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(second, -0.25 * c**-1.5, rtol=1e-12)


def test_newton_stops_at_its_bound_and_where_there_is_no_number():
    @jax.jit
    def run(start):
        count = lambda far: newton(lambda x: (x + 1, x * 0.0), far, start, most=10, dtype=float)[0]
        lost = newton(lambda x: (x / 0.0, x / 0.0), lambda _, size: size > 0, start, most=9, dtype=float)
        return count(lambda x, size: x < 3), count(lambda x, size: x < 30), lost

    near, most, lost = run(0.0)
    assert (near, most) == (3, 10) and np.all(np.isnan(lost))


def test_chord_converges_at_the_rate_of_its_matrix_or_fails():
    run = jax.jit(
        lambda correct, first: chord(correct, jnp.array(0.0), first=first, tol=1e-12, most=12), static_argnums=0
    )
    # With the right matrix one correction suffices, if it is known to be right.
    right = lambda x: (x - (x - 5e-10), jnp.abs(x - 5e-10))
    for first, corrections in ((1.0, 1), (0.0, 2)):
        x, k, failed = run(right, first)
        assert int(k) == corrections and not failed
        assert float(x) == pytest.approx(5e-10, abs=1e-20)
    wrong = lambda slope: lambda x: (x - (2 * x - 0.1) / slope, jnp.abs(2 * x - 0.1) / slope)
    x, k, failed = run(wrong(2.1), 1.0)
    # Corrections shrink by a factor of 21; the last one that is made need not be below the tolerance.
    assert not failed and float(x) == pytest.approx(0.05, abs=1e-12) and 8 <= int(k) <= 10
    _, k, failed = run(wrong(0.5), 1.0)
    assert failed and int(k) <= 12
