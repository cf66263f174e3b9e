"""At equal tolerance the error of a result is about the same with every method."""

import functools

import diffrax
import numpy as np
import pytest

import jaxmb as mb

TOLERANCES = 10.0 ** -np.arange(4.0, 11.1, 1.0)
SOLVERS = {"Adams": mb.solvers.Adams(), "Dopri8": diffrax.Dopri8(), "Hermite": mb.solvers.Hermite()}

# Mechanisms, with the end of a short motion [s]; planar, spatial, nonholonomic and from Lagrangians.
MOTIONS = {
    "pendulum": 3.0,
    "four_bar": 2.0,
    "slider_crank": 0.2,
    "andrews": 0.03,
    "rod_chain": 1.0,
    "car_axis": 1.0,
    "hanging_chain": 1.0,
    "knife_edge": 3.0,
    "chaplygin_sleigh": 3.0,
    "heavy_top": 1.0,
    "free_body": 5.0,
    "rolling_disc": 1.0,
    "roller_racer": 2.0,
    "nonholonomic_cart": 2.0,
    "three_platform_snake": 2.0,
    "spherical_four_bar": 1.0,
    "benenti": 2.0,
    "rough_ring": 2.0,
}
IMPLICIT = ("four_bar", "slider_crank", "andrews", "heavy_top", "pendulum", "roller_racer", "benenti")


@functools.cache
def mechanism(name):
    return mb.mechanisms.get(name)


def states(name, solver, rtol):
    """Coordinates and velocities in natural units at five times."""
    system, end = mechanism(name).system, MOTIONS[name]
    times = np.linspace(0.0, end, 6)[1:]
    sol = mb.simulate(
        system, mechanism(name).state, t1=end, saveat=times, rtol=rtol, solver=SOLVERS[solver], max_steps=20000
    )
    return np.asarray(sol.ys.q / system.coordinate_scale()[None]), np.asarray(sol.ys.u / system.velocity_scale()[None])


@functools.cache
def errors(name, solver):
    """The largest error relative to the largest coordinate, or velocity, at each tolerance."""
    exact = states(name, "Adams", 2e-14)
    largest = lambda found: max(np.max(np.abs(a - b)) / np.max(np.abs(b)) for a, b in zip(found, exact, strict=True))
    return np.array([largest(states(name, solver, rtol)) for rtol in TOLERANCES])


def check(ratios):
    assert np.median(ratios) <= 3 and np.max(ratios) <= 15, np.round(ratios, 1)


@pytest.mark.long
@pytest.mark.parametrize("name", MOTIONS)
def test_errors_of_adams_method_are_those_of_a_runge_kutta_method(name):
    check(errors(name, "Adams") / errors(name, "Dopri8"))


@pytest.mark.long
@pytest.mark.parametrize("name", IMPLICIT)
def test_errors_of_hermite_are_those_of_a_runge_kutta_method(name):
    check(errors(name, "Hermite") / errors(name, "Dopri8"))


@pytest.mark.parametrize("solver, finest", [("Adams", 1e-13), pytest.param("Hermite", 1e-12, marks=pytest.mark.long)])
def test_steps_do_not_creep_where_rounding_limits_them(solver, finest):
    system, state = mechanism("four_bar").system, mechanism("four_bar").state
    run = lambda rtol: mb.simulate(system, state, t1=1.0, rtol=rtol, solver=SOLVERS[solver], max_steps=5000)
    steps = [int(run(rtol).stats["num_steps"]) for rtol in (100 * finest, 10 * finest, finest)]
    assert steps[0] < steps[1] <= steps[2] < 2 * steps[0]
