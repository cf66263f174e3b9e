"""What is known of the numbers that a function is given."""

import jax
import jax.numpy as jnp
import pytest

from jaxmb.linalg.arrays import derivative_orders


@pytest.mark.parametrize(
    ("around", "order"),
    [
        (lambda f: f, 0),
        (jax.jit, 0),
        (lambda f: lambda x: jax.vmap(f)(x * jnp.ones(2)), 0),
        (jax.grad, 1),
        (lambda f: lambda x: jax.jvp(f, (x,), (x,)), 1),
        (lambda f: jax.jit(jax.grad(f)), 1),
        (lambda f: lambda x: jax.vmap(jax.grad(f))(x * jnp.ones(2)), 1),
        (lambda f: jax.grad(lambda x: jnp.sum(jax.vmap(f)(x * jnp.ones(2)))), 1),
        (lambda f: jax.grad(lambda x: f(jax.lax.stop_gradient(x)) + x), 0),
        (jax.hessian, 2),
        (lambda f: jax.jit(jax.hessian(f)), 2),
        # It is differentiated as a whole, and traced before.
        (lambda f: jax.grad(jax.jit(f)), 0),
    ],
)
def test_order_of_the_derivatives_that_are_taken(around, order):
    found = []

    def f(x):
        found.append(derivative_orders({"known": 1.0, "x": x, "count": 3, "other": 2.0 * jax.lax.stop_gradient(x)}))
        return jnp.sin(x)

    around(f)(jnp.array(1.0))
    assert found == [(0, 0, 0, order)]
