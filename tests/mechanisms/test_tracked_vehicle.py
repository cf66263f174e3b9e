"""Tracked vehicles: against a model in minimal coordinates, derivatives for design, rough treatment, and shoes."""

import functools
import types

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
from jaxmb.mechanisms._shoe_track import laid

DESIGN = np.pi + np.arctan2(0.134, 0.288)


@functools.cache
def elastic(units):
    return mechanisms.tracked_vehicle(units=units)


def poses(model, z):
    """Poses of all bodies in the order of the scene from minimal coordinates."""
    r, angles = model.positions(z).reshape(model.units, 13, 2)[:, :11], z[2:].reshape(model.units, 11)
    angles = angles + np.r_[0.0, [DESIGN] * 5, [0.0] * 5]
    return np.concatenate([r, angles[..., None]], axis=-1).reshape(-1, 3)


@pytest.mark.slow
@pytest.mark.parametrize("units", [1, 2])
def test_tracked_vehicle_moves_as_a_model_in_minimal_coordinates(units):
    made, model = elastic(units), oracle.Vehicle(units)
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
    system = mb.with_parameters(elastic(1).system, changed(x))
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


@pytest.mark.slow
def test_tracked_vehicle_derivatives_of_the_ride():
    """With respect to torsion bars, dampers and the obstacle: of the same steps forward and back, and of finer ones."""
    state = elastic(1).state
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
    "on soft ground": {"stiffness": 1e4},
    "on hard ground": {"stiffness": 1e9},
    "at rest": {"speed": 1e-6},
    "at 100 m/s": {"speed": 1e2, "t1": 0.1},
}


@pytest.mark.slow
def test_tracked_vehicle_is_as_accurate_under_rough_treatment():
    """All by one program: motions that differ by as little as their tolerances ask for."""
    made = elastic(1)

    @jax.jit
    def run(values, state, t1, rtol):
        system = mb.with_parameters(made.system, values)
        times = t1 * jnp.linspace(0.0, 1.0, 101)
        sol = mb.simulate(system, state, t1=t1, saveat=times, rtol=rtol, max_steps=8192, throw=False)
        return sol.ys.q[:, :3], ride.wheel_loads(sol), ride.arm_travel(sol), sol.result == mb.RESULTS.successful

    for name, changes in HARD.items():
        setting = {"speed": 5.0, "peak": 0.12, "t1": 0.3, "stiffness": 8e5} | changes
        values = changed(START.at[2].set(setting["peak"]), {"road.normal.stiffness": setting["stiffness"]})
        state = made.with_parameters(values).state
        state = mb.State(state.q, state.u * setting["speed"] / 5.0)
        (loose, loads, _, fine), (tight, _, travel, _) = (run(values, state, setting["t1"], r) for r in (1e-7, 1e-10))
        assert fine, name
        np.testing.assert_allclose(loose, tight, rtol=0, atol=1e-6, err_msg=name)
        if name == "lands":
            # Some wheel is off the ground, and comes down again.
            loads = np.asarray(loads)
            assert np.any(np.logical_or.accumulate(np.abs(loads) < 200.0)[:-1] & (loads[1:] > 1e4))
        if name == "strikes its stops":
            assert np.min(travel) < -0.65
        if setting["t1"] == 0.3:
            # At first the wheels bear the weight: each in the ground by its share.
            np.testing.assert_allclose(np.sum(loads[0]), 9.81 * np.sum(made.system.mass), rtol=1e-6)


# Tracks of shoes

SHOE, PITCH, HEIGHT = 36.0, 0.1524, 0.06
BUMP = {"length": 5.0, "peak": 0.15}
WHEELS = np.array([[1.351 - 0.667 * k, 0.365] for k in range(5)])


@functools.cache
def on_shoes():
    return mechanisms.tracked_vehicle(track="shoes")


@functools.cache
def motion_on_shoes():
    """One program for all motions of the vehicle."""
    make = lambda values, state, times, rtol: mb.simulate(
        mb.with_parameters(on_shoes().system, values),
        state,
        t1=times[-1],
        saveat=times,
        rtol=rtol,
        max_steps=200_000,
    )
    return jit_to_run_long(make)


def driven(drive, start=4.0, without_losses=False):
    """Parameters by name: the torque of the drive, where the bump starts, and no damping and friction."""
    lossy = [name for name in mb.parameters(on_shoes().system) if name.endswith((".damping", "friction.coefficient"))]
    known = mb.parameters(on_shoes().system)
    values = {name: known[name] * (0.0 if without_losses else 1.0) for name in lossy}
    return values | {"drive.torque": drive, "road.terrain.start": start, "road_behind.terrain.start": start}


@pytest.mark.parametrize("number", [60, 62])
def test_shoes_of_a_taut_track_lie_around_its_discs(number):
    """Its pins are one pitch apart, and none of its shoes is deep in a disc or farther out than the hull of all."""
    sprocket, idler = np.array([2.006, 0.58]), np.array([-1.824, 0.46])
    offset, pins = laid(mechanisms.Shoes(number=number), sprocket, idler, WHEELS, 0.305)
    assert len(pins) == number
    sides = np.roll(pins, -1, axis=0) - pins
    np.testing.assert_allclose(np.linalg.norm(sides, axis=1), PITCH, rtol=0, atol=1e-6)
    turns = np.diff(np.unwrap(np.arctan2(sides[:, 1], sides[:, 0])))
    # Counter-clockwise, never back but for the sides of the polygon that stands for circles.
    assert np.all(turns > -1e-3) and np.sum(turns) > 5.0
    normal = np.stack([-sides[:, 1], sides[:, 0]], axis=1) / PITCH
    discs = [(sprocket, 0.2), (idler - [offset, 0.0], 0.2), *((wheel, 0.305) for wheel in WHEELS)]
    gaps = [np.min(np.sum((centre - pins) * normal, axis=1)) - radius - HEIGHT / 2 for centre, radius in discs]
    assert np.all(np.abs(gaps[:2]) < 1e-2) and np.all(np.abs(gaps[2:]) < 1e-2)


def test_shoes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="pitch must be positive"):
        mechanisms.Shoes(pitch=0.0)
    with pytest.raises(ValueError, match=r"number must be an integer, got 60\.5"):
        mechanisms.Shoes(number=60.5)
    with pytest.raises(ValueError, match=r"40 shoes of .* fit; about 6"):
        mechanisms.tracked_vehicle(track=mechanisms.Shoes(number=40))
    with pytest.raises(ValueError, match="needs the pins of shoes"):
        ride.track_tension(types.SimpleNamespace(system=mechanisms.pendulum().system))


@pytest.mark.slow
def test_shoes_keep_energy_without_losses():
    state, times = on_shoes().state, jnp.linspace(0.0, 0.2, 21)
    sol = motion_on_shoes()(driven(0.0, start=2.0, without_losses=True), state, times, 1e-9)
    size = np.max(np.abs(sol.kinetic_energy))
    assert np.ptp(sol.potential_energy) > 1e-3 * size
    np.testing.assert_allclose(sol.energy, sol.energy[0], rtol=0, atol=1e-8 * size)


@pytest.mark.slow
def test_shoes_run_over_a_long_bump_as_an_elastic_track():
    """At one place the hull is about as high and as much inclined as that of the vehicle on elastic tracks; over a
    bump as short as the distance of two wheels shoes bridge the slopes and lift it higher.
    """
    made, times = on_shoes(), jnp.linspace(0.0, 1.5, 151)
    assert made.references is None
    system = made.system
    assert len(system.body_names) == 74 and system.nu - system.velocity_rank == 77
    longer = {f"{road}.terrain.{name}": x for road in ("road", "road_behind") for name, x in BUMP.items()}
    sol = motion_on_shoes()(driven(1200.0) | longer, made.state, times, 1e-5)
    loop = mechanisms.tracked_vehicle(torque=0.0, terrain=mb.terrain.Bump(start=4.0, **BUMP))
    other = mb.simulate(loop.system, loop.state, t1=1.5, saveat=times)
    at = np.linspace(0.1, 7.1, 141)

    def along(sol, values):
        return np.interp(at, sol["hull"].position[:, 0], values - values[0])

    for of, bound in ((lambda hull: hull.position[:, 1], 0.015), (lambda hull: hull.angle, 0.012)):
        found, expected = (along(own, np.asarray(of(own["hull"]))) for own in (sol, other))
        np.testing.assert_allclose(found, expected, rtol=0, atol=bound)
        assert np.max(found) == pytest.approx(np.max(expected), rel=0.08)
    assert np.all(sol.constraint_violation.position <= 1e-12)
    assert np.all(sol.constraint_violation.velocity <= 1e-12)
    closer = motion_on_shoes()(driven(1200.0) | longer, made.state, times, 1e-7)
    np.testing.assert_allclose(sol["hull"].position, closer["hull"].position, rtol=0, atol=1e-4)
    # Running needs the tension that turns the shoes' momentum around, m v² / pitch, on top of that at rest.
    tension = np.mean(ride.track_tension(sol)[10:50])
    assert tension == pytest.approx(1.5e4 + SHOE * 5.0**2 / PITCH, rel=0.1)
