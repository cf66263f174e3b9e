"""The derivatives of tangents between circles are those of the formula for the tangents."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.parts import tangents

RANDOM = np.random.default_rng(3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_first_and_second_derivatives(dimension):
    between, offsets = RANDOM.normal(size=(4, dimension)) * 2.0, 0.2 * RANDOM.normal(size=4)
    tilts = RANDOM.normal(size=(4, 3))
    weights = RANDOM.normal(size=4), RANDOM.normal(size=(4, dimension))

    def measure(lines):
        def of_numbers(between, offsets, tilts):
            # Axes of unit length, also as they change.
            axes = tilts / jnp.sqrt(jnp.sum(tilts**2, axis=1, keepdims=True)) if dimension == 3 else None
            return sum(jnp.sum(w * x) for w, x in zip(weights, lines(between, offsets, axes), strict=True))

        return of_numbers

    own, formula = measure(tangents.tangent_lines), measure(tangents._lines.fun)
    numbers = tuple(map(jnp.asarray, (between, offsets, tilts)))
    for derivative in (jax.grad, jax.jacfwd, jax.hessian):
        found, expected = (derivative(function, (0, 1, 2))(*numbers) for function in (own, formula))
        compare = lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
        jax.tree.map(compare, found, expected)
