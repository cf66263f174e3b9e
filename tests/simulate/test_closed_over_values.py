"""Derivatives of motions by values that a user's functions close over, against those of more accurate solutions."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxmb as mb
from jaxmb import planar

MOST_PROGRAMS = 100

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
def test_what_functions_close_over_has_derivatives(run, x):
    step = 1e-3
    value = lambda x: run(x, rtol=1e-12)
    central = (8 * (value(x + step) - value(x - step)) - (value(x + 2 * step) - value(x - 2 * step))) / (12 * step)
    assert abs(central) > 0.01
    found, reverse = jax.jit(jax.value_and_grad(run))(x)
    np.testing.assert_allclose(found, run(x), rtol=1e-8)
    np.testing.assert_allclose(reverse, central, rtol=1e-5)
    forward = jax.jit(jax.vmap(jax.jacfwd(run)))(jnp.array([x, 1.1 * x]))
    np.testing.assert_allclose(forward[0], reverse, rtol=1e-9)


# A stone that falls.
STONE = mb.Scene([planar.PointMass("stone", mass=1.0)], forces=[mb.Gravity((0.0, -10.0))]).compile()


@pytest.mark.slow
def test_motion_of_numbers_within_a_trace_is_computed_there():
    """And its failure is told there."""
    fallen = lambda **options: mb.simulate(STONE, STONE.guess, t1=0.6, **options).ys.q[-1, 1]
    both = jax.jit(jax.vmap(jax.value_and_grad(lambda factor: factor * fallen())))(np.array([0.0, 2.0]))
    np.testing.assert_allclose(both, [[0.0, -3.6], [-1.8, -1.8]], rtol=1e-9, atol=1e-15)
    with pytest.raises(RuntimeError, match="The motion came to"):
        jax.jit(lambda factor: factor * fallen(max_steps=1))(2.0)


def test_values_that_cannot_be_found_are_refused():
    class Hidden:
        pass

    def run(target):
        Hidden.target = target
        event = diffrax.Event(lambda t, y, args, **_: y.q[0] - Hidden.target)
        return mb.simulate(STONE, STONE.guess, t1=2.0, event=event).ts[-1]

    with pytest.raises(ValueError, match="uses a value that JAX traces and cannot find"):
        jax.jit(run)(0.5)
