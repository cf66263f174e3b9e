"""Branches and loops under `vmap`: values and derivatives are those of any other, and only lanes that need them pay."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmb import _branches
from jaxmb._branches import cond_of_any_lane, cond_of_lanes, loop_of_lanes


def test_conditions_of_a_batch():
    def branched(x):
        return cond_of_any_lane(x > 1, lambda x: 2 * x, lambda x: x, x)

    np.testing.assert_array_equal(jax.vmap(branched)(jnp.arange(3.0)), [0.0, 1.0, 4.0])
    names = [own.primitive.name for own in jax.make_jaxpr(jax.vmap(branched))(jnp.arange(3.0)).jaxpr.eqns]
    assert "cond" in names


@pytest.mark.slow
@pytest.mark.parametrize("lanes, at_once", [(1, None), (5, None), (5, 2)])
def test_conditions_of_lanes(monkeypatch, lanes, at_once):
    """A branch that only the lanes that take it go through, with the values and derivatives of any other.

    They go one after the other on a processor, and several at once elsewhere.
    """
    if at_once is not None:
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        monkeypatch.setattr(_branches, "_LANES", at_once)

    def branched(cond, x, a):
        return cond(x[0] > 1, lambda x: jnp.sin(a) * x, lambda x: x, x)

    own = lambda x, a: branched(cond_of_lanes, x, a)
    plain = lambda x, a: branched(lambda pred, *of: jax.lax.cond(pred, *of), x, a)
    x, a = jnp.arange(2.0 * lanes).reshape(lanes, 2) / 2, jnp.asarray(0.7)
    several = jnp.linspace(0.5, 1.0, lanes)
    for axes, of in (((0, None), (x, a)), ((0, 0), (x, several)), ((None, 0), (x[-1], several))):

        def every(function, *of, axes=axes):
            """Values, derivatives of a batch, and a batch of derivatives."""
            batch = jax.vmap(function, axes)
            total = lambda *of: jnp.sum(batch(*of) ** 2)
            return [
                batch(*of),
                *(derivative(total, 1)(*of) for derivative in (jax.grad, jax.jacfwd, jax.hessian)),
                *(jax.vmap(derivative(function, 1), axes)(*of) for derivative in (jax.jacrev, jax.jacfwd)),
            ]

        for found, expected in zip(*(jax.jit(every, static_argnums=0)(f, *of) for f in (own, plain)), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-13)
    text = jax.jit(jax.vmap(own, (0, None))).lower(x, a).as_text()
    kind = "stablehlo.case" if lanes == 1 else "stablehlo.while"
    assert kind in text, "a branch is computed for lanes that do not take it"


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 5])
def test_loops_of_lanes(lanes):
    """Each lane ends where it ends alone, and derivatives are zero."""

    def halved(limit, x, a):
        advance = lambda state: (state[0] + 1, jnp.where(state[1] > limit, a * state[1], 0.0))
        going = lambda state: (state[1] > 0) & (state[0] < 100)
        return loop_of_lanes(lambda state: going(state) & (state[0] < 2), going, advance, (jnp.array(0.0), x))[0]

    own = lambda x, a: halved(1.0, x, a) * x
    x, a = jnp.asarray(4.0 ** np.arange(lanes)), jnp.asarray(0.5)
    counts = 2.0 * np.arange(lanes) + 1
    np.testing.assert_array_equal([own(x, a) for x in x], counts * x)
    for axes, of in (((0, None), (x, a)), ((0, 0), (x, jnp.full(lanes, a)))):
        np.testing.assert_array_equal(jax.jit(jax.vmap(own, axes))(*of), counts * x)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_array_equal(jax.vmap(derivative(own), (0, None))(x, a), counts)
        np.testing.assert_array_equal(derivative(own, 1)(x[-1], a), 0.0)
