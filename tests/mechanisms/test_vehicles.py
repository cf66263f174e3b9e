"""Tracked vehicles: against a model in minimal coordinates, derivatives for design, and rough treatment."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_to_run_long
from oracles import tracked_vehicle as oracle

import jaxmb as mb
from jaxmb import mechanisms
from jaxmb.mechanisms import ride

pytestmark = pytest.mark.slow

DESIGN = np.pi + np.arctan2(0.134, 0.288)


@functools.cache
def vehicle(units):
    return mechanisms.tracked_vehicle(units=units)


def poses(model, z):
    """Poses of all bodies in the order of the scene from minimal coordinates."""
    r, angles = model.positions(z).reshape(model.units, 13, 2)[:, :11], z[2:].reshape(model.units, 11)
    angles = angles + np.r_[0.0, [DESIGN] * 5, [0.0] * 5]
    return np.concatenate([r, angles[..., None]], axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("units", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_degrees_of_freedom_statics_and_motion(units):
    made, model = vehicle(units), oracle.Vehicle(units)
    system = made.system
    assert (system.nu, system.velocity_rank) == {1: (33, 20), 2: (66, 42)}[units]
    assert system.nu - system.velocity_rank == {1: 13, 2: 24}[units]
    np.testing.assert_allclose(made.state.q.reshape(-1, 3), poses(model, model.equilibrium()), rtol=0, atol=1e-11)

    times = jnp.linspace(0.0, 1.5, 301)
    run = eqx.filter_jit(lambda rtol: mb.simulate(system, made.state, t1=1.5, rtol=rtol, saveat=times))
    sol = run(jnp.asarray(1e-10))
    z, _ = model.motion(np.asarray(times)[::100], rtol=1e-11)
    for k, own in enumerate(z):
        np.testing.assert_allclose(sol.ys.q[100 * k].reshape(-1, 3), poses(model, own), rtol=0, atol=1e-8)
    residual = jax.jit(jax.vmap(lambda y: system.position_residual(0.0, y.q)))(sol.ys)
    assert np.max(np.abs(residual)) <= 1e-12
    check_order(run, sol, poses(model, z[-1]))
    # Values of the literature's kind of vehicle, of another program.
    if units == 2:
        np.testing.assert_allclose(sol.ys.q[-1, :3], [8.39247455, 0.90757530, -0.00108488], rtol=0, atol=1e-8)
    else:
        np.testing.assert_allclose(made.state.q[1:3], [0.90007965, -1.02477921e-3], rtol=0, atol=1e-8)
        travel = ride.arm_travel(sol)
        np.testing.assert_allclose(
            travel[0], [-1.504123e-2, -2.210896e-3, -6.570996e-4, 6.325571e-4, -4.122447e-3], rtol=0, atol=1e-8
        )
        np.testing.assert_allclose(sol.ys.q[-1, :3], [8.240145425, 0.898593480, -0.018680345], rtol=0, atol=1e-8)
        assert np.max(sol["hull"].position[:, 1]) == pytest.approx(0.95084, abs=2e-4)
        assert np.min(travel) == pytest.approx(-0.14804, abs=1e-4)
        check_outputs(system, sol)


def check_order(run, tight, exact):
    """Of convergence, as seen from error and work: far above that of formulas of low order, in spite of the bump."""
    loose = run(jnp.asarray(1e-6))
    errors = [np.max(np.abs(sol.ys.q[-1].reshape(-1, 3) - exact)) for sol in (loose, tight)]
    work = [int(sol.stats["num_evaluations"]) for sol in (loose, tight)]
    assert errors[0] <= 1e-5
    assert np.log(errors[0] / errors[1]) / np.log(work[1] / work[0]) >= 5


def check_outputs(system, sol):
    """Loads at rest bear the weight, and the seat's acceleration adds up to its velocity."""
    loads = ride.wheel_loads(sol)
    assert float(np.sum(loads[0])) == pytest.approx(9.81 * float(np.sum(system.mass)), rel=1e-9)
    h = float(sol.ts[1])
    acceleration = ride.seat_acceleration(sol, (0.5, 0.4))
    hull = sol["hull"]
    arm = np.stack(
        [np.cos(hull.angle) * 0.5 - np.sin(hull.angle) * 0.4, np.sin(hull.angle) * 0.5 + np.cos(hull.angle) * 0.4]
    )
    acceleration = np.asarray(acceleration)
    velocity = np.asarray(hull.velocity) + np.asarray(hull.angular_velocity)[:, None] * np.stack(
        [-arm[1], arm[0]], axis=1
    )
    gained = np.cumsum(0.5 * h * (acceleration[1:] + acceleration[:-1]), axis=0)
    np.testing.assert_allclose(gained, velocity[1:] - velocity[0], rtol=0, atol=5e-3)
    rms = np.sqrt(np.trapezoid(acceleration[:, 1] ** 2, sol.ts) / 1.5)
    assert float(ride.vertical_rms(sol, (0.5, 0.4))) == pytest.approx(rms, rel=1e-12)


# Design and rough treatment

START = jnp.array([5e4, 5e3, 0.12])


def changed(x, more=None):
    """The vehicle with another torsion stiffness and damping, and another height of the bump."""
    values = {f"bar{k}.{name}": x[i] for k in range(1, 6) for i, name in enumerate(("stiffness", "damping"))}
    return values | {"road.terrain.peak": x[2], "road.terrain.start": 1.7} | (more or {})


def ride_at(x, state, dt):
    """RMS of the seat's acceleration in 0.15 s, at steps that do not depend on anything."""
    system = mb.with_parameters(vehicle(1).system, changed(x))
    sol = mb.simulate(
        system,
        state,
        t1=0.15,
        dt0=dt,
        saveat=jnp.linspace(0.0, 0.15, 41),
        solver=diffrax.Tsit5(),
        stepsize_controller=diffrax.ConstantStepSize(),
        max_steps=1024,
    )
    return ride.vertical_rms(sol)


def test_derivatives_of_the_ride():
    """With respect to torsion bars, dampers and the obstacle: of the same steps forward and back, and of finer ones."""
    state = vehicle(1).state
    twice = lambda x, dt: (ride_at(x, state, dt),) * 2
    derivatives_and_value = jit_to_run_long(jax.jacfwd(twice, has_aux=True))
    forward, _ = derivatives_and_value(START, 5e-4)
    reverse = jax.jit(jax.grad(lambda x: ride_at(x, state, 5e-4)))(START)
    assert np.all(np.abs(forward) * START > 1e-3)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    h = 1e-4 * START
    value = lambda k: np.array([derivatives_and_value(START + k * step, 2.5e-4)[1] for step in np.diag(h)])
    plain, double = (value(1.0) - value(-1.0)) / (2 * h), (value(2.0) - value(-2.0)) / (4 * h)
    np.testing.assert_allclose(forward, (4 * plain - double) / 3, rtol=1e-5)


HARD = {
    "lands": {"speed": 15.0, "peak": 0.3, "t1": 0.7},
    "strikes its stops": {"speed": 15.0, "peak": 0.6, "t1": 0.4},
    **{f"{k:.0e} N/m": {"stiffness": k} for k in (1e4, 1e6, 1e9)},
    **{f"{v:.0e} m/s": {"speed": v, "t1": t1} for v, t1 in ((1e-6, 0.3), (1e-3, 0.3), (1e2, 0.1))},
}


@functools.cache
def motion():
    vehicle(1)

    @jax.jit
    def run(values, state, t1, rtol):
        system = mb.with_parameters(vehicle(1).system, values)
        times = t1 * jnp.linspace(0.0, 1.0, 101)
        sol = mb.simulate(system, state, t1=t1, saveat=times, rtol=rtol, max_steps=8192, throw=False)
        return sol.ys.q[:, :3], ride.wheel_loads(sol), ride.arm_travel(sol), sol.result == mb.RESULTS.successful

    return run


@pytest.mark.parametrize("name", HARD)
def test_rough_treatment_is_as_accurate(name):
    """All by one program: motions that differ by as little as their tolerances ask for."""
    setting = {"speed": 5.0, "peak": 0.12, "t1": 0.3, "stiffness": 8e5} | HARD[name]
    values = changed(START.at[2].set(setting["peak"]), {"road.normal.stiffness": setting["stiffness"]})
    state = vehicle(1).with_parameters(values).state
    state = mb.State(state.q, state.u * setting["speed"] / 5.0)
    (loose, loads, _, fine), (tight, _, travel, _) = (motion()(values, state, setting["t1"], r) for r in (1e-7, 1e-10))
    assert fine
    np.testing.assert_allclose(loose, tight, rtol=0, atol=1e-6)
    if name == "lands":
        # Some wheel is off the ground, and comes down again.
        loads = np.asarray(loads)
        assert np.any(np.logical_or.accumulate(np.abs(loads) < 200.0)[:-1] & (loads[1:] > 1e4))
    if name == "strikes its stops":
        assert np.min(travel) < -0.65
    if setting["t1"] == 0.3:
        # At first the wheels bear the weight: each in the ground by its share.
        np.testing.assert_allclose(np.sum(loads[0]), 9.81 * np.sum(vehicle(1).system.mass), rtol=1e-6)
