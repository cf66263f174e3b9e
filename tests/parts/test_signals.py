"""Signals that start and end at rest: clamped series and smooth steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivative_checks import central_differences, in_both_modes
from scipy.interpolate import CubicSpline

import jaxmb as mb
from jaxmb import planar, spatial

MASS, LENGTH = 1.3, 0.7


@pytest.mark.parametrize("count", [2, 8])
def test_the_clamped_spline(count):
    random = np.random.default_rng(count)
    ts, values = np.sort(random.uniform(-1.0, 2.0, count)), random.normal(size=(count, 2))
    spline = CubicSpline(ts, values, bc_type="clamped")
    at = np.concatenate([ts[:-1], np.linspace(ts[0], ts[-1], 23)[:-1]])
    series = mb.Series(ts, values, "clamped")
    found, rates = jax.jit(jax.vmap(lambda t: jax.jvp(series, (t,), (jnp.ones(()),))))(at)
    np.testing.assert_allclose(found, spline(at), rtol=0, atol=1e-12 * np.abs(spline(at)).max())
    np.testing.assert_allclose(rates, spline(at, 1), rtol=0, atol=1e-12 * np.abs(spline(at, 1)).max())


def test_a_held_series_keeps_each_value_until_the_next_time():
    ts, values = np.array([0.0, 1.0, 3.0, 3.5]), np.array([5.0, 6.0, -8.0, 2.0])
    at = np.array([-1.0, 0.0, 0.9, 1.0, 2.9, 3.0, 3.4, 3.5, 7.0])
    found = jax.jit(jax.vmap(mb.Series(ts, values, "held")))(at)
    np.testing.assert_array_equal(found, [5.0, 5.0, 5.0, 6.0, 6.0, -8.0, -8.0, 2.0, 2.0])


def test_derivatives_by_values_and_times_of_a_clamped_series():
    def at(x):
        return mb.Series(x[:4], x[4:], "clamped")(0.83)

    x = np.array([0.1, 0.6, 0.9, 1.7, 0.3, -0.5, 1.2, 0.8])
    _, derivative = in_both_modes(lambda x: at(x)[None], jnp.asarray(x))
    differences = central_differences(lambda x: CubicSpline(x[:4], x[4:], bc_type="clamped")(0.83)[None], x)
    np.testing.assert_allclose(derivative, differences, rtol=0, atol=1e-9)


def test_a_smooth_step():
    """The polynomial in NumPy, constant before and after; its rate and acceleration are continuous."""
    start, end, duration = np.array([0.4, -1.0]), np.array([1.5, 2.0]), 1.6
    s = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    ts = np.array([-3.0, 0.0, 0.2, 0.8, 1.3, duration, 9.0])
    step = lambda t: mb.smooth_step(t, start, end, duration)
    rate = jax.jacfwd(step)
    found = jax.jit(jax.vmap(lambda t: (step(t), rate(t), jax.jacfwd(rate)(t))))(ts)
    for order, values in enumerate(found):
        expected = np.where((ts < 0) | (ts > duration), 0.0, s.deriv(order)(ts / duration) / duration**order)
        expected = expected[:, None] * (end - start) + (start + (ts[:, None] > duration) * (end - start)) * (order == 0)
        np.testing.assert_allclose(values, expected, rtol=0, atol=1e-13)
    fine = np.linspace(0.0, duration, 2001)
    sizes = [np.abs(s.deriv(k)(fine / duration)).max() / duration**k for k in (1, 2)]
    np.testing.assert_allclose(sizes, [1.875 / duration, 5.774 / duration**2], rtol=1e-4)


@pytest.mark.parametrize("duration", [0.0, -1.0, np.nan, np.ones(2)])
def test_a_duration_that_is_not_positive(duration):
    with pytest.raises(ValueError, match="smooth_step: duration must be a positive number"):
        mb.smooth_step(0.3, 0.0, 1.0, duration)


def test_an_interpolation_that_does_not_exist():
    with pytest.raises(ValueError, match="'linear', 'cubic', 'clamped' or 'held', got 'natural'"):
        mb.Series([0.0, 1.0], [0.0, 1.0], "natural")


def driven_rod(space, motion, parameters):
    """A rod on a pin that a driver turns without gravity."""
    if space is planar:
        rod = planar.Body("rod", mass=MASS, inertia=planar.rod(MASS, LENGTH), position=(LENGTH / 2, 0.0))
        pin, axis = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0)), {}
    else:
        inertia = (0.01, *2 * (MASS * LENGTH**2 / 12,))
        rod = spatial.Body("rod", mass=MASS, inertia=inertia, position=(LENGTH / 2, 0.0, 0.0))
        axis = {"axis": (0.0, 0.0, 1.0)}
        pin = spatial.Revolute("pin", "ground", "rod", point=(0.0, 0.0, 0.0), **axis)
    turn = space.Driver("turn", "ground", "rod", quantity="angle", motion=motion, parameters=parameters, **axis)
    return mb.Scene([rod], joints=[pin, turn]).compile()


@pytest.mark.slow
@pytest.mark.parametrize("space, by_input", [(planar, False), (spatial, True)])
def test_a_move_from_rest_to_rest(space, by_input):
    """As the motion of a driver and as an input: angle, rate, and the moment that accelerates the rod."""
    rise, duration, late = 0.9, 0.6, 0.2
    move = lambda t: mb.smooth_step(t - late, 0.0, rise, duration)
    if by_input:
        system = mb.with_inputs(driven_rod(space, lambda t, p: p["angle"], {"angle": 0.0}), {"turn.angle": move})
    else:
        system = driven_rod(space, lambda t, p: mb.smooth_step(t - late, 0.0, p["rise"], duration), {"rise": rise})
    ts = np.array([0.0, 0.1, 0.35, 0.6, 0.9])
    motion = mb.simulate(system, mb.assemble(system), t1=ts[-1], saveat=ts, rtol=1e-9)
    s = np.clip((ts - late) / duration, 0.0, 1.0)
    np.testing.assert_allclose(motion["pin"].angle, rise * s**3 * (10 - 15 * s + 6 * s**2), rtol=0, atol=1e-9)
    acceleration = rise * (60 * s - 180 * s**2 + 120 * s**3) / duration**2
    moment = motion.reactions["turn"].moment[:, -1] if space is spatial else motion.reactions["turn"].moment
    about_pin = MASS * LENGTH**2 / 3
    np.testing.assert_allclose(moment, about_pin * acceleration, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_clamped_series_as_an_input_of_a_driver():
    ts, angles = np.array([0.0, 0.3, 0.7, 1.0]), np.array([0.0, 0.5, -0.2, 0.4])
    system = driven_rod(planar, lambda t, p: p["angle"], {"angle": 0.0})
    driven = mb.with_inputs(system, {"turn.angle": mb.Series(ts, angles, "clamped")})
    motion = mb.simulate(driven, mb.assemble(driven), t1=1.0, saveat=np.linspace(0.0, 1.0, 7))
    spline = CubicSpline(ts, angles, bc_type="clamped")
    np.testing.assert_allclose(motion["rod"].angle, spline(motion.ts), rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion["rod"].angular_velocity, spline(motion.ts, 1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion["rod"].angular_velocity[jnp.array([0, -1])], 0.0, rtol=0, atol=1e-12)
