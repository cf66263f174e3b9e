"""Derivatives by the times of a run where they are traced: of events, saved states and what is made of them."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from compiling import jit_quickly

import jaxmb as mb
from jaxmb import planar

pytestmark = pytest.mark.slow

START = 0.1


@pytest.fixture(scope="module")
def pendulum():
    bar = planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    system = mb.Scene([bar], joints=[pin], forces=[mb.Gravity((0.0, -9.81))]).compile()
    return system, mb.assemble(system, fix={"bar.angle": 0.3}, rates={"bar.angle": 1.0})


def saved(pendulum, start, end, saveat, **options):
    system, state = pendulum
    return mb.simulate(system, state, t0=start, t1=end, saveat=saveat, rtol=1e-10, throw=False, **options)


def field(pendulum, end):
    """The angle and its rate at a time, and the derivatives of both by it."""
    state = saved(pendulum, START, end, None).ys
    angle, rate = state.q[-1, 2], state.u[-1, 2]
    return np.array([angle, rate]), np.array([rate, -0.5 * 9.81 * np.cos(angle) / (1 / 3)])


def test_the_state_at_an_event_where_the_end_is_traced(pendulum):
    """It moves with the event, and not with the end, which is later."""
    system, _ = pendulum
    event = diffrax.Event(lambda t, y, args, **_: y.q[2] + 0.5, optimistix.Newton(1e-12, 1e-12))

    def crossing(rate, end):
        state = mb.assemble(system, fix={"bar.angle": 0.3}, rates={"bar.angle": rate}, throw=False)
        motion = mb.simulate(system, state, t1=end, event=event, rtol=1e-10, throw=False)
        return jnp.stack([motion.ts[-1], motion.ys.q[-1, 2], motion.ys.u[-1, 2]])

    by_rate, by_end = jit_quickly(jax.jacfwd(crossing, argnums=(0, 1)))(1.0, 2.0)
    alone = jit_quickly(jax.jacfwd(lambda rate: crossing(rate, 2.0)))(1.0)
    np.testing.assert_allclose(by_rate, alone, atol=1e-9)
    # The energy at the event is that of the start.
    speed = float(crossing(1.0, 2.0)[2])
    np.testing.assert_allclose(alone[1:], [0.0, 1.0 / speed], atol=1e-8)
    np.testing.assert_array_equal(by_end, 0.0)


def test_what_a_function_makes_of_states_moves_with_their_times(pendulum):
    def values(end):
        saveat = diffrax.SaveAt(ts=jnp.stack([0.5 * end, end]), fn=lambda t, y, args: t * y.q[2])
        return saved(pendulum, START, end, saveat).ys

    found, slopes = jit_quickly(lambda end: jax.jvp(values, (end,), (1.0,)))(0.9)
    for k, share in enumerate((0.5, 1.0)):
        (angle, _), (rate, _) = field(pendulum, share * 0.9)
        np.testing.assert_allclose(found[k], share * 0.9 * angle, rtol=1e-8)
        np.testing.assert_allclose(slopes[k], share * (angle + share * 0.9 * rate), rtol=1e-8)


def test_a_function_may_return_a_state(pendulum):
    """What it returns is not a motion, which would be returned to the constraints."""
    doubled = diffrax.SaveAt(ts=[0.5], fn=lambda t, y, args: mb.State(2 * y.q, 3 * y.u))
    found, plain = saved(pendulum, START, 0.9, doubled), saved(pendulum, START, 0.9, [0.5])
    np.testing.assert_allclose(found.ys.q, 2 * plain.ys.q, rtol=1e-8)
    np.testing.assert_allclose(found.ys.u, 3 * plain.ys.u, rtol=1e-8)


def test_a_saved_start_does_not_move_with_its_time(pendulum):
    angles = lambda start: saved(pendulum, start, 0.9, diffrax.SaveAt(t0=True, t1=True)).ys.q[:, 2]
    slopes = jit_quickly(jax.jacfwd(angles))(START)
    (_, (rate, _)) = field(pendulum, 0.9)
    # The equations do not depend on time.
    np.testing.assert_allclose(slopes, [0.0, -rate], rtol=1e-8)


def test_a_time_that_rounding_puts_behind_the_end_moves_as_well(pendulum):
    times = lambda end: end / 7 * jnp.arange(1.0, 8.0)
    assert times(0.9)[-1] > 0.9
    last = jit_quickly(jax.grad(lambda end: saved(pendulum, 0.0, end, times(end)).ys.q[-1, 2]))
    system, state = pendulum
    rate = mb.simulate(system, state, t1=0.9, rtol=1e-10).ys.u[-1, 2]
    np.testing.assert_allclose(last(0.9), rate, rtol=1e-8)


def test_the_start_of_a_block_that_slips():
    """The state at a start that moves follows the field with friction, which acts from there on."""
    slide = planar.Prismatic("slide", "ground", "block", point=(0.0, 0.0), axis=(1.0, 0.0))
    forces = [
        mb.DryFriction("rub", "slide", coefficient=0.3),
        mb.Gravity((0.0, -9.81)),
        mb.JointForce("push", "slide.displacement", force=1.0),
    ]
    system = mb.Scene([planar.Body("block", mass=1.0, inertia=0.1)], joints=[slide], forces=forces).compile()
    state = mb.assemble(system, rates={"slide.displacement": 3.0})

    def end(start):
        motion = mb.simulate(system, state, t0=start, t1=1.0, rtol=1e-10, throw=False)
        return jnp.stack([motion.ys.q[-1, 0], motion.ys.u[-1, 0]])

    slowing = 0.3 * 9.81 - 1.0
    found = jit_quickly(jax.jacfwd(end))(START)
    np.testing.assert_allclose(found, [slowing * (1.0 - START) - 3.0, slowing], rtol=1e-8)


def test_a_third_derivative_by_times_is_refused(pendulum):
    """States move with their times by two terms of a series, whose third derivative would be zero."""
    angle = lambda end: saved(pendulum, START, end, None).ys.q[-1, 2]
    with pytest.raises(ValueError, match="third derivative by times"):
        jax.jit(jax.jacfwd(jax.hessian(angle))).trace(0.9)
