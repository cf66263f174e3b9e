"""Tyres by the Magic Formula on a wheel: contact forces, relaxation, free rolling, and derivatives."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from every_part import TYRE_FILE
from oracles import magic_formula as oracle

import jaxmb as mb
from jaxmb import spatial
from jaxmb.linalg import rotations as rot
from jaxmb.parts import tir

FOLDER = Path(oracle.__file__).parents[1]
FILES = {"5.2": FOLDER / "example_52.tir", "6.1": TYRE_FILE}
VERSIONS = pytest.mark.parametrize("version", FILES)
R0 = {"5.2": 0.32, "6.1": 0.32 * 0.997}
GRAVITY = mb.Gravity((0.0, 0.0, -9.81))


def part(given, **options):
    options = {"terrain": mb.terrain.Flat(), "smoothing": 1e-6} | options
    return spatial.MagicFormulaTyre("tyre", "wheel", given, **options)


def scene(tyre, *, forces=(), mass=400.0, inertia=(20.0, 1.0, 20.0), joints=(), **start):
    wheel = spatial.Body("wheel", mass=mass, inertia=inertia, **({"position": (0.0, 0.0, 0.3)} | start))
    return mb.Scene([wheel], joints=joints, forces=[tyre, *forces]).compile()


def leaning(steer, lean):
    """Euler parameters of a wheel that is turned to the left, and leans to its right."""
    return rot.multiply(rot.from_axis_angle((0.0, 0.0, 1.0), steer), rot.from_axis_angle((1.0, 0.0, 0.0), lean))


@pytest.mark.slow("5.2-left")
@pytest.mark.parametrize("version, side", [("5.2", "left"), ("6.1", "right")])
def test_the_contact_has_the_forces_of_the_equations(version, side):
    """In steady slip, of a wheel that is steered, leans, and slips in both directions; on its side and mirrored."""
    steer, lean, speed, spin, drift, height = 0.3, 0.2, 20.0, 66.0, -1.2, 0.3
    p, own = leaning(steer, lean), tir.read("", FILES[version]).coefficients
    c, s = np.cos(steer), np.sin(steer)
    forwards, left, up = np.array([c, s, 0.0]), np.array([-s, c, 0.0]), np.array([0.0, 0.0, 1.0])
    # The spin about the axle, and none else.
    start = {"position": (0.0, 0.0, height), "orientation": p, "angular_velocity": (0.0, spin, 0.0)}
    system = scene(part(FILES[version], side=side), **start, velocity=speed * forwards + drift * left)

    # The contact, by plane geometry.
    growth = 0.32 * 0.0008 * (spin * 0.32 / 16.0) ** 2 if version == "6.1" else 0.0
    depth = (R0[version]) * np.cos(lean) - height + growth
    loaded = R0[version] + growth - depth / np.cos(lean)
    if version == "6.1":
        first, dpi = np.sqrt((2e5 * 0.32 / 4000) ** 2 - 56.0), 0.1
        elastic = 4000 * (1 + 0.7 * dpi) * (first * depth / 0.32 + 14.0 * (depth / 0.32) ** 2)
        load = elastic * (1 + 0.04 * spin * 0.32 / 16.0)
        share, stiffness = load / 4000, 2e5 * (1 + 0.7 * dpi)
    else:
        load, share, stiffness = 2e5 * depth, 2e5 * depth / 4000, 2e5
    reach = R0[version] + growth - 4000 / stiffness * (0.25 * np.arctan(8.0 * share) + 0.02 * share)
    kappa, alpha = (spin * reach - speed) / speed, np.arctan(drift / speed)
    way = 1.0 if side == "left" else -1.0
    numbers = oracle.coefficients(FILES[version]) | own
    slips = load, kappa, way * alpha, way * lean
    if version == "6.1":
        expected, *sigma = oracle.version_61(numbers, *slips, 2.2e5, speed)
    else:
        expected, *sigma = oracle.version_52(numbers, *slips, speed)
    fx, fy, mx, my, mz = expected * np.array([1.0, way, way, 1.0, way])

    deflection = np.array([kappa * sigma[0], -np.tan(alpha) * sigma[1]])
    held = lambda z, q, u: (system.with_states(z).force(0.0, q, u), system.with_states(z).state_rates(0.0, q, u))
    found, rates = map(np.array, jit_quickly(held)(deflection, system.guess.q, system.guess.u))
    np.testing.assert_allclose(rates, 0.0, atol=1e-4)
    np.testing.assert_allclose(found[:3], fx * forwards + fy * left + load * up, rtol=1e-4)
    down = rot.rotate(np.array(p), np.array([0.0, 0.0, -1.0]))
    moment = mx * forwards + my * left + mz * up + np.cross(loaded * down, found[:3])
    np.testing.assert_allclose(rot.rotate(np.array(p), found[3:]), moment, rtol=1e-4, atol=0.02)


@pytest.mark.slow
def test_a_step_of_steer_builds_up_over_the_relaxation_length():
    """Of a wheel so heavy that nothing stops it: exponentially in the distance, to the steady slip."""
    speed, drift, tiny = 20.0, 0.8, 1e-9
    tyre = part(FILES["6.1"], transition_speed=tiny)
    heavy = {"mass": 1e12, "inertia": (1e12, 1e12, 1e12)}
    system = scene(tyre, **heavy, velocity=(speed, drift, 0.0), angular_velocity=(0.0, 60.0, 0.0))
    ts = np.linspace(0.0, 0.15, 7)
    motion = mb.simulate(system, mb.assemble(system), t1=ts[-1], saveat=ts, rtol=1e-10)
    rates_at = lambda z: system.with_states(z).state_rates(0.0, motion.ys.q[0], motion.ys.u[0])
    # The relaxation lengths, from the slope of the rates by the deflection.
    rates, slopes = (np.array(x) for x in jit_quickly(lambda z: (rates_at(z), jax.jacfwd(rates_at)(z)))(jnp.zeros(2)))
    sigma = -speed / np.diag(slopes)
    steady = sigma / speed * rates
    expected = steady * (1 - np.exp(-speed * ts[:, None] / sigma))
    np.testing.assert_allclose(rates[1], -drift, rtol=1e-9)
    np.testing.assert_allclose(motion["tyre"].deflection, expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(steady[1] / sigma[1], -drift / speed, rtol=1e-9)


def rolling_on(version, **changes):
    """The file, without offsets, so that an upright wheel rolls straight."""
    skew = """PHX1 PHX2 PVX1 PVX2 PHY1 PHY2 PVY1 PVY2 QHZ1 QHZ2 QDZ6 QDZ7 RVY1 RVY2 SSZ1 QSX1 RHX1 RBY3 RHY1 RHY2"""
    own = tir.read("", FILES[version]).coefficients | dict.fromkeys(skew.split(), 0.0)
    return own | {"FITTYP": {"5.2": 6, "6.1": 61}[version], "TYRESIDE": "left"} | changes


@pytest.mark.slow
def test_rolling_resistance_slows_a_wheel_down():
    resistance = dict.fromkeys(("QSY2", "QSY3", "QSY4", "QSY8", "Q_V1", "Q_V2"), 0.0)
    resistance |= {"VERTICAL_DAMPING": 2e4, "QSY7": 1.0}
    load = 400.0 * 9.81
    own = rolling_on("6.1", **resistance)
    wheel = {"velocity": (15.0, 0.0, 0.0), "angular_velocity": (0.0, 15.0 / 0.316, 0.0)}
    system = scene(part(own), forces=[GRAVITY], **wheel, position=(0.0, 0.0, 0.3003))
    ts = np.linspace(0.0, 3.0, 4)
    motion = mb.simulate(system, mb.assemble(system), t1=3.0, saveat=ts, rtol=1e-9)
    speed, spin = motion["wheel"].velocity[:, 0], motion["wheel"].angular_velocity[:, 1]
    height = float(motion["wheel"].position[-1, 2])
    # Moments about the axle, with the same slip before and after.
    ratio = (spin / speed)[-1]
    slowing = load * 0.32 * own["QSY1"] / (400.0 * height + 1.0 * ratio)
    np.testing.assert_allclose(-np.diff(speed[1:]) / np.diff(ts[1:]), slowing, rtol=1e-4)


@pytest.mark.slow
@VERSIONS
def test_a_wheel_is_quiet_at_rest_and_off_the_ground(version):
    """Values and derivatives are finite, and nothing moves a wheel that stands."""
    system = scene(part(FILES[version], smoothing=1e-3), forces=[GRAVITY])
    names = ["tyre.LMUX", "tyre.PKY1", "tyre.QDZ1", "tyre.FNOMIN", "tyre.VERTICAL_STIFFNESS"]
    base = {name: mb.parameters(system)[name] for name in names}

    def outputs(values, q, u, z):
        own = mb.with_parameters(system, values).with_states(z)
        return jnp.concatenate([own.force(0.0, q, u), own.state_rates(0.0, q, u)])

    both = lambda q, u, z: (outputs(base, q, u, z), jax.jacrev(outputs, (0, 1, 2, 3))(base, q, u, z))
    both = jit_quickly(jax.vmap(both))
    heights = np.array([0.2, 0.3, R0[version], 0.321, 0.4, 3.0, 0.3])
    q = np.zeros((7, 7))
    q[:, 2], q[:, 3] = heights, 1.0
    u, z = np.zeros((7, 6)), np.zeros((7, 2))
    u[6, 2] = 50.0  # Lifts off faster than damping allows.
    values, derivatives = both(jnp.array(q), jnp.array(u), jnp.array(z))
    for leaf in jax.tree.leaves((values, derivatives)):
        assert np.all(np.isfinite(leaf))
    still = np.array(values)[:6]
    np.testing.assert_allclose(still[:, [0, 1, 4, 5, 6, 7]], 0.0, atol=1e-9)
    np.testing.assert_allclose(still[4:, 2], -400.0 * 9.81, rtol=2e-3)


@pytest.mark.slow
def test_one_load_and_its_energy():
    """At any speed of rotation the force along the normal is the slope of the energy with damping left out, and with
    damping it does not pull; the Magic Formula has the same load.
    """
    width, own = 2e-3, rolling_on("6.1", Q_V1=0.002, Q_V2=0.5, VERTICAL_DAMPING=2e4)
    system = scene(part(own, smoothing=width), position=(0.0, 0.0, 0.315))
    q, z = system.guess.q, jnp.array([0.0, -0.02])

    def seen(damping, rise, spin):
        numbers = mb.with_parameters(system, {"tyre.VERTICAL_DAMPING": damping}).with_states(z)
        u = jnp.array([20.0, 0.0, rise, 0.0, spin, 0.0])
        slope = jax.grad(lambda q: numbers.energy_in_motion(0.0, q, u))(q)
        return numbers.force(0.0, q, u)[:3], slope[2], numbers.potential_energy(0.0, q)

    cases = jnp.array([(0.0, 0.0, 0.0), (0.0, 0.0, 66.0), (0.0, 0.0, 120.0), (2e4, 0.05, 66.0), (2e4, 5.0, 66.0)])
    force, slope, energy = jit_quickly(jax.vmap(seen))(*cases.T)
    np.testing.assert_allclose(force[:3, 2], -slope[:3], rtol=1e-9)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-14)
    assert force[1, 2] > 1.3 * force[0, 2] and 0 < force[3, 2] < force[1, 2] - 50.0
    np.testing.assert_allclose(force[4], 0.0, atol=1e-9)
    # The lateral force of the equations at the load that presses, and at the slip of the deflection.
    for found in np.array(force[:4]):
        at = lambda alpha, load=found[2]: oracle.version_61(own, load, 0.0, alpha, 0.0, 2.2e5, 20.0)
        *_, sigma = at(0.0)
        expected, *_ = at(np.arctan(0.02 / sigma))
        np.testing.assert_allclose(found[1], expected[1], rtol=1e-6)


def force_at(system, states):
    """The force at the initial guess."""
    function = lambda z, q, u: system.with_states(z).force(0.0, q, u)
    return jit_quickly(function)(states, system.guess.q, system.guess.u)


@pytest.mark.slow
def test_tyres_of_both_sides_are_computed_together():
    wheels = [
        spatial.Body(side, mass=20.0, inertia=(0.5, 0.9, 0.5), position=(0.0, y, 0.3)) for side, y in SIDES.items()
    ]
    ground = mb.terrain.Flat()
    tyres = [spatial.MagicFormulaTyre(f"{side} tyre", side, FILES["6.1"], side=side, terrain=ground) for side in SIDES]
    system = mb.Scene(wheels, forces=tyres).compile()
    assert len(system.forces.groups) == 1
    force = np.array(force_at(system, jnp.zeros(4))).reshape(2, 6)
    np.testing.assert_allclose(force[0] * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0]), force[1], rtol=1e-12, atol=1e-9)


SIDES = {"left": 0.7, "right": -0.7}


@pytest.mark.slow
def test_a_law_of_the_user_gives_the_load():
    system = scene(part(FILES["6.1"], normal=mb.contact.Linear(1e5)))
    np.testing.assert_allclose(force_at(system, jnp.zeros(2))[2], 1e5 * (R0["6.1"] - 0.3), rtol=1e-5)
    energy = jit_quickly(lambda q: system.potential_energy(0.0, q))(system.guess.q)
    np.testing.assert_allclose(energy, 5e4 * (R0["6.1"] - 0.3) ** 2, rtol=1e-4)
    assert "tyre.normal.stiffness" in mb.parameters(system)
