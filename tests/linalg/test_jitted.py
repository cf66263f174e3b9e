"""Compiled functions of pytrees: what belongs to the program, and what is an argument of it."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxmb.linalg.jitted import jitted


def test_arrays_are_arguments_and_the_rest_belongs_to_the_program():
    traced = []

    @jitted
    def function(held, power, *, offset=None):
        traced.append(power)
        total = sum(held["x"] ** power)
        return {"total": total if offset is None else total + offset, "none": None}

    x = np.array([1.0, 2.0, 3.0])
    for value in (x, jnp.asarray(2 * x)):
        out = function({"x": value, "name": "a"}, 2)
        np.testing.assert_allclose(out["total"], np.sum(np.asarray(value) ** 2))
        assert out["none"] is None
    assert traced == [2]
    assert function({"x": x, "name": "a"}, 3)["total"] == 36.0
    assert function({"x": x, "name": "b"}, 3)["total"] == 36.0
    assert function({"x": x, "name": "b"}, 3, offset=np.float64(1.0))["total"] == 37.0
    assert traced == [2, 3, 3, 3]


def test_derivatives_and_batches():
    function, x = jitted(lambda x, scale: jnp.sum(x["x"] ** 2) * scale), np.array([1.0, -2.0])
    slope = lambda x: function({"x": x}, 3.0)
    several = jax.jit(lambda x, both: (jax.grad(slope)(x), jax.jacfwd(slope)(x), jax.vmap(slope)(both)))
    reverse, forward, batch = several(x, np.stack([x, 2 * x]))
    np.testing.assert_allclose([reverse, forward], [6 * x, 6 * x])
    np.testing.assert_allclose(batch, [15.0, 60.0])
