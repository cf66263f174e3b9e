"""Functions that close over traced values: derivatives by these, however they are reached."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxmb.solvers import Adams, MultistepController, integrate
from jaxmb.solvers.closures import opened


def reached(x, way):
    """A function of t that multiplies by x, which it has in some way."""
    inner = lambda t: x * t
    match way:
        case "cell":
            return inner
        case "nested":
            return lambda t: inner(t)
        case "tree":
            held = {"factors": [x, 1.0]}
            return lambda t: held["factors"][0] * t
        case "default":
            return lambda t, factor=x: factor * t
        case "keyword":
            return eqx.Partial(lambda t, *, factor: factor * t, factor=x)
        case "partial":
            return functools.partial(lambda factor, t: factor * t, x)
        case "itself":

            def again(t, times=1):
                return x * t if times == 0 else again(t, times - 1)

            return again


@pytest.mark.parametrize("way", ["cell", "nested", "tree", "default", "keyword", "partial", "itself"])
def test_traced_values_are_leaves(way):
    def slope(x):
        function = opened(reached(x, way))
        assert any(leaf is x for leaf in jax.tree.leaves(function))
        return function(2.0)

    assert jax.grad(slope)(3.0) == 2.0
    assert jax.jit(slope)(3.0) == 6.0
    # Nothing is traced, and the function stays what it is.
    plain = reached(3.0, way)
    assert opened(plain) is plain


def test_functions_that_are_written_anew_are_one_program():
    traced = []

    @eqx.filter_jit
    def called(function):
        traced.append(None)
        return function(2.0)

    for x in (1.0, 2.0, 3.0):
        assert jax.grad(lambda x: called(opened(lambda t: x * t)))(x) == 2.0
    assert len(traced) == 1
    jax.grad(lambda x: called(opened(lambda t: x * t + 1)))(1.0)
    assert len(traced) == 2


@pytest.mark.slow
def test_vector_field_of_a_solve_on_its_mesh():
    """The end is exp(-rate), the time of an event log(1 / level) / rate."""

    def run(rate, level):
        event = diffrax.Event(lambda t, y, args, **_: y - level, optx.Newton(1e-10, 1e-10))
        return integrate(
            diffrax.ODETerm(lambda t, y, args: -rate * y),
            Adams(),
            0.0,
            1.0,
            None,
            jnp.ones(()),
            stepsize_controller=MultistepController(1e-9, 1e-9),
            event=None if level is None else event,
        )

    end, time = lambda rate: run(rate, None).ys[-1], lambda level: run(1.3, level).ts[-1]
    for mode in (jax.grad, jax.jacfwd):
        for through in (lambda f: f, jax.jit):
            np.testing.assert_allclose(through(mode(end))(1.3), -np.exp(-1.3), rtol=1e-7)
            np.testing.assert_allclose(through(mode(time))(0.5), -1 / (1.3 * 0.5), rtol=1e-7)
