"""What is known of the numbers that a function is given."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.linalg.arrays import derivatives_of

AROUND = [
    (lambda f: f, 0, True),
    (jax.jit, 0, False),
    (lambda f: lambda x: jax.vmap(f)(np.ones(2)), 0, False),
    (jax.grad, 1, True),
    (jax.jacfwd, 1, True),
    (jax.jacrev, 1, True),
    (lambda f: lambda x: jax.jvp(f, (x,), (x,)), 1, True),
    (lambda f: jax.jit(jax.grad(f)), 1, False),
    (lambda f: lambda x: jax.vmap(jax.grad(f))(np.ones(2)), 1, False),
    (lambda f: jax.grad(lambda x: jnp.sum(jax.vmap(f)(x * jnp.ones(2)))), 1, False),
    (lambda f: jax.grad(lambda x: f(jax.lax.stop_gradient(x)) + x), 0, True),
    (jax.hessian, 2, True),
    (lambda f: jax.jit(jax.hessian(f)), 2, False),
    # It is differentiated as a whole, and traced before.
    (lambda f: jax.grad(jax.jit(f)), 0, False),
]


@pytest.mark.parametrize(("around", "order", "known"), AROUND)
def test_derivatives_that_are_taken(around, order, known):
    found = []

    def f(x):
        found.append(derivatives_of({"known": 1.0, "x": x, "count": 3, "other": jax.lax.stop_gradient(x)}))
        return x

    around(f)(jnp.array(1.0))
    assert found == [((0, 0, 0, order), known, order)]


def test_mixed_derivatives_are_nested_twice_though_each_order_is_one():
    found = []

    def f(x, y):
        found.append(derivatives_of((x, y)))
        return x * y

    jax.jacfwd(jax.grad(f, argnums=0), argnums=1)(jnp.array(1.0), jnp.array(2.0))
    assert found == [((1, 1), True, 2)]


def test_a_traced_count_is_not_known():
    found = []
    jax.eval_shape(lambda n: found.append(derivatives_of({"n": n}).known), 3)
    assert found == [False]
