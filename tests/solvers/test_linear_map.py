"""Linear maps with transposes of their own: all modes of derivatives, nested and batched."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb.solvers.linear_map import linear_map

RESIDUAL = np.array([[0.1, 0.7, -0.4], [1.3, 0.2, 0.5]])
X = np.array([1.0, -2.0, 0.5])


def there(residual, x, used):
    # What is not used may be anything.
    first = jnp.sin(residual) @ x["x"] if used["first"] else jnp.full(2, jnp.nan)
    return {"first": first, "unused": None, "sum": jnp.sum(residual) * x["x"] if used["sum"] else jnp.full(3, jnp.nan)}


def back(residual, cotangents):
    out = [] if cotangents["first"] is None else [jnp.sin(residual).T @ cotangents["first"]]
    out += [] if cotangents["sum"] is None else [jnp.sum(residual) * cotangents["sum"]]
    return {"x": sum(out[1:], start=out[0]) if out else None, "nothing": None}


def mapped(residual, x):
    x, like = {"x": x, "nothing": None}, {"first": jnp.zeros(2), "unused": None, "sum": jnp.zeros(3)}
    out = linear_map(there, back, (there, back), residual, x, like)
    return jnp.concatenate([out["first"], out["sum"]])


def plain(residual, x):
    out = there(residual, {"x": x}, {"first": True, "sum": True})
    return jnp.concatenate([out["first"], out["sum"]])


def test_values_that_are_not_used_are_not_asked_for():
    asked = []

    def watched(residual, x, used):
        asked.append(used)
        return there(residual, x, used)

    def sum_only(x):
        x, like = {"x": x, "nothing": None}, {"first": jnp.zeros(2), "unused": None, "sum": jnp.zeros(3)}
        return linear_map(watched, back, (watched, back), RESIDUAL, x, like)["sum"]

    for function, shape in ((sum_only, ()), (jax.vmap(sum_only), (2,)), (jax.vmap(jax.vmap(sum_only)), (2, 2))):
        asked.clear()
        x = np.broadcast_to(X, (*shape, 3))
        np.testing.assert_allclose(jax.jit(function)(x), np.sum(RESIDUAL) * x, rtol=1e-14)
        assert asked and all(used["sum"] and not used["first"] for used in asked)


@pytest.mark.slow
def test_derivatives_are_those_of_the_map():
    """Of the first order, with a cotangent of one output alone, of the second, and of batches."""
    several, points = np.stack([RESIDUAL, 2 * RESIDUAL]), np.stack([X, X + 1])

    def every(f):
        energy = lambda r, x: jnp.sum(jnp.cos(f(r, x)))
        squares = lambda r, x: jnp.sum(jax.grad(energy, 1)(r, x) ** 2)
        yield from (through(RESIDUAL, X) for through in (f, jax.jacfwd(f, 1), jax.jacrev(f, 1), jax.jacfwd(f, 0)))
        yield jax.grad(lambda x: jnp.sum(f(RESIDUAL, x)[:2] ** 2))(X)
        yield jax.jacfwd(squares, 0)(RESIDUAL, X), jax.hessian(energy, 1)(RESIDUAL, X)
        for axis, members in ((0, several), (None, RESIDUAL)):
            yield jax.vmap(jax.grad(energy, 1), (axis, 0))(members, points)

    found, expected = jax.jit(lambda: (list(every(mapped)), list(every(plain))))()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13), found, expected)


def test_a_derivative_is_not_differentiated_in_reverse_mode():
    squares = lambda r: jnp.sum(jax.grad(lambda x: jnp.sum(mapped(r, x) ** 2))(X) ** 2)
    with pytest.raises(TypeError, match=r"differentiated in forward mode only: take jax\.hessian"):
        jax.jit(jax.grad(squares))(RESIDUAL)
