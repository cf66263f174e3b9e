"""Reciprocal roots and their derivatives, which are products."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.roots import reciprocal_root


@pytest.mark.slow
def test_derivatives_of_a_reciprocal_root():
    function, factor = reciprocal_root, 1.0
    x = jnp.array([0.3, 2.0, 1e6])
    for order in range(4):
        np.testing.assert_allclose(jax.vmap(function)(x), factor * x ** (-0.5 - order), rtol=1e-14)
        function, factor = jax.grad(function) if order % 2 else jax.jacfwd(function), factor * (-0.5 - order)


def test_numpy_in_numpy_out():
    out = reciprocal_root(np.array([4.0]))
    assert isinstance(out, np.ndarray)
    np.testing.assert_allclose(out, [0.5], rtol=1e-15)
