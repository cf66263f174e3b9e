"""Coefficients of dry friction as inputs: brakes that close, fail and wear, against closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar

G = 9.81


@functools.cache
def slider(angle=0.0, static=None):
    """A block of 2 kg on an inclined rail, with a brake."""
    along = np.array([np.cos(angle), np.sin(angle)])
    rail = planar.Prismatic("rail", "ground", "block", axis=along, point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    block = planar.Body("block", mass=2.0, inertia=0.1)
    rub = mb.DryFriction("rub", "rail", coefficient=0.3, static_coefficient=static)
    return mb.Scene([block], joints=[rail], forces=[mb.Gravity((0.0, -G)), rub]).compile()


def state_of(system, speed):
    return mb.assemble(system, rates={"rail.displacement": speed})


def test_coefficients_and_forces_follow_their_inputs():
    """The numbers of the laws at each time; stick never has the smaller one."""
    brake = mb.Series([0.0, 1.0], [0.2, 0.6], "linear")
    limits = {None: [0.3, 0.5], 0.4: [0.4, 0.5]}
    for static, expected in limits.items():
        numbers = [
            mb.with_inputs(slider(static=static), {"rub.coefficient": brake}).contact_numbers(t) for t in (0.25, 0.75)
        ]
        np.testing.assert_allclose([x.coefficient[0] for x in numbers], [0.3, 0.5])
        np.testing.assert_allclose([x.limit[0] for x in numbers], expected)
    numbers = [mb.with_inputs(clamped(), {"clamp.force": brake}).contact_numbers(t) for t in (0.25, 0.75)]
    np.testing.assert_allclose([x.coefficient[0] for x in numbers], [0.3, 0.5])
    np.testing.assert_allclose([x.limit[0] for x in numbers], [0.3, 0.5])


@pytest.mark.slow
def test_a_brake_that_closes_in_steps():
    """The deceleration is G times the coefficient at each time; where that jumps, the velocity has a kink."""
    system = slider()
    brake = mb.Series([0.0, 0.2, 0.4, 1.0], [0.1, 0.5, 0.2, 0.2], "held")
    motion = mb.simulate(
        system, state_of(system, 2.0), t1=1.0, saveat=[0.2, 0.4, 1.0], inputs={"rub.coefficient": brake}, rtol=1e-10
    )
    v1, v2 = 2.0 - 0.1 * G * 0.2, 2.0 - 0.1 * G * 0.2 - 0.5 * G * 0.2
    np.testing.assert_allclose(motion["block"].velocity[:2, 0], [v1, v2], rtol=1e-10)
    (stop,) = motion.events
    np.testing.assert_allclose(stop.time, 0.4 + v2 / (0.2 * G), rtol=1e-9)
    way = 0.2 * (2.0 + v1) / 2 + 0.2 * (v1 + v2) / 2 + v2**2 / (2 * 0.2 * G)
    np.testing.assert_allclose(motion["block"].position[-1, 0], way, rtol=1e-9)


@functools.cache
def clamped():
    """A block of 2 kg on a level rail, with friction of constant size."""
    rail = planar.Prismatic("rail", "ground", "block", axis=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    block = planar.Body("block", mass=2.0, inertia=0.1)
    clamp = mb.JointFriction("clamp", "rail.displacement", force=1.0, exact=True)
    push = mb.JointForce("push", "rail.displacement", force=0.0)
    return mb.Scene([block], joints=[rail], forces=[clamp, push]).compile()


@pytest.mark.slow
def test_a_clamp_of_constant_size_closes_and_fails():
    """It stops the block, holds it against a push, and lets it go when its force falls below that push."""
    system = clamped()
    force = mb.Series([0.0, 0.5, 1.25, 2.25], [2.0, 6.0, 6.0, 0.0], "linear")

    def found(push):
        pushed = mb.with_parameters(system, {"push.force": push})
        motion = mb.simulate(pushed, state_of(system, 1.0), t1=2.15, inputs={"clamp.force": force}, rtol=1e-10)
        return motion["rail"].displacement_rate[-1], motion.events

    # 2 v' = 3 - 2 - 8 t until t = 0.5, then 3 - 6; it goes on when 13.5 - 6 t = 3.
    rate, events = found(3.0)
    at_half = 1.0 + (0.5 - 4 * 0.5**2) / 2
    stop, go = 0.5 + at_half / 1.5, 1.75
    np.testing.assert_allclose([event.time for event in events], [stop, go], rtol=1e-8)
    assert [event.kind for event in events] == ["stick", "slip"]
    np.testing.assert_allclose(rate, 1.5 * (2.15 - go) ** 2, rtol=1e-7)
    # The derivative by P of the integral of (P - 13.5 + 6 t) / 2 from 2.25 - P / 6 on.
    slope = (2.15 - go) / 2
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(lambda push: found(push)[0]))(3.0), slope, rtol=1e-6)


@pytest.mark.slow
def test_a_brake_that_fails_on_a_slope():
    """It holds until the coefficient falls below the slope: at a jump, or at the time at which a line crosses it."""
    slope = 0.2
    system, limit = slider(slope), np.tan(slope)
    cases = {
        "jump": (mb.Series([0.0, 0.3, 1.0], [0.5, 0.1, 0.1], "held"), 0.3),
        "line": (mb.Series([0.0, 1.0], [0.5, 0.0], "linear"), (0.5 - limit) / 0.5),
        "function": (lambda t: 0.5 * jnp.exp(-t), np.log(0.5 / limit)),
    }
    for name, (brake, begins) in cases.items():
        motion = mb.simulate(
            system, state_of(system, 0.0), t1=0.99, saveat=[0.25, 0.99], inputs={"rub.coefficient": brake}, rtol=1e-10
        )
        np.testing.assert_allclose(motion["block"].position[0], 0.0, atol=1e-12)
        if name != "jump":
            np.testing.assert_allclose(motion.events.times, [begins], rtol=1e-8)
        known = {"jump": lambda t: 0.1 + 0 * t, "line": lambda t: 0.5 - 0.5 * t, "function": lambda t: 0.5 * np.exp(-t)}
        coefficient = known[name]
        times, weights = np.polynomial.legendre.leggauss(20)
        times, weights = begins + (0.99 - begins) * (times + 1) / 2, weights * (0.99 - begins) / 2
        rate = -G * weights @ (np.sin(slope) - coefficient(times) * np.cos(slope))
        np.testing.assert_allclose(motion["rail"].displacement_rate[-1], rate, rtol=1e-7)


@pytest.mark.slow
def test_stick_never_has_the_smaller_coefficient():
    """An input that exceeds the static coefficient counts in stick as well."""
    slope, system = 0.2, slider(0.2, static=0.3)
    brake = mb.Series([0.0, 0.5], [0.25, 0.6], "linear")
    motion = mb.simulate(system, state_of(system, 0.0), t1=0.5, inputs={"rub.coefficient": brake})
    assert len(motion.events) == 0 and np.tan(slope) < 0.25


@pytest.mark.slow
def test_derivatives_by_the_values_of_a_brake():
    """Of the way to the stop and the time of the stop, in both modes, under jit and in a batch."""
    system = slider()
    start = state_of(system, 2.0)

    def found(values):
        brake = mb.Series([0.0, 0.2, 1.5], values[jnp.array([0, 1, 1])], "held")
        motion = mb.simulate(system, start, t1=1.5, inputs={"rub.coefficient": brake}, rtol=1e-11)
        return jnp.array([motion["block"].position[-1, 0], motion.events.times[0]])

    def known(values):
        later = 2.0 - values[0] * G * 0.2
        way = 0.4 - 0.5 * values[0] * G * 0.04 + later**2 / (2 * values[1] * G)
        return jnp.array([way, 0.2 + later / (values[1] * G)])

    at = jnp.array([0.3, 0.4])
    np.testing.assert_allclose(jax.jit(found)(at), known(at), rtol=1e-9)
    expected = jax.jacfwd(known)(at)
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(found))(at), expected, rtol=1e-7)
    batch = jnp.stack([at, at + 0.1])
    np.testing.assert_allclose(jax.vmap(found)(batch), jax.vmap(known)(batch), rtol=1e-9)


def test_what_cannot_be_an_input_says_how_else():
    ball = planar.PointMass("ball", mass=1.0, position=(0.0, 0.1))
    floor = mb.RigidContact("floor", "ball", terrain=mb.terrain.Flat(), restitution=0.5)
    system = mb.Scene([ball], joints=[floor]).compile()
    with pytest.raises(ValueError, match=r"'floor\.restitution' must be constant: .*restitution.*with_parameters"):
        mb.with_inputs(system, {"floor.restitution": mb.Series([0.0, 1.0], [0.5, 0.1])})
