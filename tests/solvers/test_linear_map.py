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


@pytest.mark.slow
def test_derivatives_are_those_of_the_map():
    for through in (
        lambda f: f,
        jax.jit,
        lambda f: jax.jacfwd(f, 1),
        lambda f: jax.jacrev(f, 1),
        lambda f: jax.jacfwd(f, 0),
    ):
        np.testing.assert_allclose(through(mapped)(RESIDUAL, X), through(plain)(RESIDUAL, X), rtol=1e-14)
    # Only one of the outputs has a cotangent.
    one = lambda f: jax.grad(lambda x: jnp.sum(f(RESIDUAL, x)[:2] ** 2))
    np.testing.assert_allclose(one(mapped)(X), one(plain)(X), rtol=1e-14)


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
def test_derivatives_of_derivatives_and_batches():
    energy = lambda f: lambda r, x: jnp.sum(jnp.cos(f(r, x)))
    second = lambda f: jax.jacfwd(lambda r, x: jnp.sum(jax.grad(energy(f), 1)(r, x) ** 2), 0)
    np.testing.assert_allclose(second(mapped)(RESIDUAL, X), second(plain)(RESIDUAL, X), rtol=1e-12)
    np.testing.assert_allclose(
        jax.hessian(energy(mapped), 1)(RESIDUAL, X), jax.hessian(energy(plain), 1)(RESIDUAL, X), rtol=1e-12
    )
    several = np.stack([RESIDUAL, 2 * RESIDUAL])
    for axes in ((0, None), (None, None)):
        members = several if axes[0] == 0 else RESIDUAL
        batch = lambda f, axes=axes: jax.jit(jax.vmap(jax.grad(energy(f), 1), (axes[0], 0)))
        points = np.stack([X, X + 1])
        np.testing.assert_allclose(batch(mapped)(members, points), batch(plain)(members, points), rtol=1e-12)


def test_a_derivative_is_not_differentiated_in_reverse_mode():
    squares = lambda r: jnp.sum(jax.grad(lambda x: jnp.sum(mapped(r, x) ** 2))(X) ** 2)
    for through in (lambda f: f, jax.jit):
        with pytest.raises(TypeError, match=r"differentiated in forward mode only: take jax\.hessian"):
            through(jax.grad(squares))(RESIDUAL)
