"""Reciprocal roots and their derivatives, which are products."""

import jax
import numpy as np

from jaxmb.linalg.roots import reciprocal_root


def test_reciprocal_root_and_its_derivatives():
    x, function, functions = np.array([0.3, 2.0, 1e6]), reciprocal_root, []
    for order in range(4):
        functions.append(function)
        function = jax.grad(function) if order % 2 else jax.jacfwd(function)
    found, factor = jax.jit(lambda x: [jax.vmap(own)(x) for own in functions])(x), 1.0
    for order, own in enumerate(found):
        np.testing.assert_allclose(own, factor * x ** (-0.5 - order), rtol=1e-14)
        factor = factor * (-0.5 - order)
    out = reciprocal_root(np.array([4.0]))
    assert isinstance(out, np.ndarray) and out == [0.5]
