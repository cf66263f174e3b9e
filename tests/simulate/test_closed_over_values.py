"""Derivatives of motions by values that a user's functions close over, against those of more accurate solutions."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxmb as mb
from jaxmb import planar

PENDULUM = mb.mechanisms.pendulum()
BAR = mb.Scene(
    [planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(0.5, 0.0))],
    joints=[planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))],
    forces=[mb.Gravity((0.0, -9.81)), planar.Torque("motor", "bar", torque=0.0)],
).compile()


def time_of_event(target, **options):
    event = diffrax.Event(lambda t, y, args, **_: y.q[0] - target, optx.Newton(1e-12, 1e-12))
    return mb.simulate(PENDULUM.system, PENDULUM.state, t1=2.0, event=event, **options).ts[-1]


def saved(weight, **options):
    saveat = diffrax.SaveAt(ts=jnp.linspace(0.0, 0.5, 4), fn=lambda t, y, args: weight**2 * y.q)
    return jnp.sum(mb.simulate(PENDULUM.system, PENDULUM.state, t1=0.5, saveat=saveat, **options).ys)


def driven(amplitude, **options):
    inputs = {"motor.torque": lambda t: amplitude * jnp.sin(3 * t)}
    return mb.simulate(BAR, mb.assemble(BAR), t1=0.5, inputs=inputs, **options)["bar"].angle[-1]


@pytest.mark.slow
@pytest.mark.parametrize("run, x", [(time_of_event, 0.5), (saved, 1.5), (driven, 2.0)])
def test_derivatives_by_what_functions_close_over(run, x):
    step = 1e-3
    value = lambda x: run(x, rtol=1e-12)
    central = (8 * (value(x + step) - value(x - step)) - (value(x + 2 * step) - value(x - 2 * step))) / (12 * step)
    assert abs(central) > 0.01
    reverse = jax.jit(jax.grad(run))(x)
    np.testing.assert_allclose(reverse, central, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(run))(x), reverse, rtol=1e-11)
    np.testing.assert_allclose(jax.jit(run)(x), run(x), rtol=1e-8)
    both = jax.jit(jax.vmap(jax.grad(run)))(jnp.array([x, 1.1 * x]))
    np.testing.assert_allclose(both[0], reverse, rtol=1e-9)


def test_a_motion_of_numbers_within_a_trace():
    """It is computed once, at the trace, and its failure is told there."""
    end = lambda t1=0.5: mb.simulate(PENDULUM.system, PENDULUM.state, t1=t1).ys.q[-1]
    expected = end()
    np.testing.assert_allclose(jax.jit(lambda factor: factor * end())(2.0), 2.0 * expected, rtol=1e-12)
    slope = jax.jit(jax.grad(lambda factor: jnp.sum(factor * end())))(2.0)
    np.testing.assert_allclose(slope, np.sum(expected), rtol=1e-12)
    both = jax.jit(jax.vmap(lambda factor: factor * end()))(jnp.arange(2.0))
    np.testing.assert_allclose(both, np.outer([0.0, 1.0], expected), rtol=1e-12)
    with pytest.raises(RuntimeError, match="The motion came to"):
        run = lambda: mb.simulate(PENDULUM.system, PENDULUM.state, t1=0.5, max_steps=3)
        jax.jit(lambda factor: factor * run().ys.q[-1])(2.0)


def test_values_that_cannot_be_found():
    class Hidden:
        pass

    def run(target):
        Hidden.target = target
        event = diffrax.Event(lambda t, y, args, **_: y.q[0] - Hidden.target)
        return mb.simulate(PENDULUM.system, PENDULUM.state, t1=2.0, event=event).ts[-1]

    with pytest.raises(ValueError, match="uses a value that JAX traces and cannot find"):
        jax.jit(run)(0.5)
