"""Contact of bodies with terrain, and its laws of normal force and friction."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_quickly
from laws import BUMP, FRICTION, JANOSI, LAWS
from oracles import tracked_vehicle as oracle
from scipy.integrate import quad

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.mechanisms._wheel_contact import WheelContact
from jaxmb.parts import contact, terrain
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE


def three_wheels(kind=planar.Contact, **changes):
    """Contact of three bodies with a bump."""
    options = {
        "terrain": BUMP,
        "normal": contact.Linear(8e5),
        "friction": contact.Coulomb(0.7, transition_speed=0.3),
        "radius": 0.305,
        "damping": 2e4,
    }
    return kind("road", ("a", "b", "c"), **(options | changes))


# Laws

SLIPS = np.array([1e-9, 1e-4, 0.02, 1.0, -3.0])


@pytest.fixture(scope="module")
def laws():
    """Of each law of the normal force its force at many depths, and its energy; of each of friction its force."""
    vector = lambda x: jnp.stack([x, 0.0])
    engaged, one = 0.5 * jnp.ones(()), jnp.ones(())
    normal = lambda law, depth: (law.force(depth), law.energy(depth))
    rubs = lambda law, slip: law.force(2e3 * one, engaged, vector(slip), vector(4.0 * one))

    @jax.jit
    def every(depths, slips):
        of = {name: jax.vmap(lambda depth, law=law: normal(law, depth))(depths) for name, law in LAWS.items()}
        return of | {name: jax.vmap(lambda slip, law=law: rubs(law, slip))(slips) for name, law in FRICTION.items()}

    # A power of the depth that is a multiple of a tenth is a polynomial of its tenth root.
    nodes, weights = np.polynomial.legendre.leggauss(24)
    root = 0.5 * 0.03**0.1 * (1 + nodes)
    found = jax.tree.map(np.asarray, every(np.append(root**10, [0.03, 0.04]), SLIPS))
    return found, 0.5 * 0.03**0.1 * weights * 10 * root**9


@pytest.mark.parametrize("name", LAWS)
def test_energy_is_the_work_of_the_normal_force(laws, name):
    found, weights = laws
    force, energy = found[name]
    np.testing.assert_allclose(energy[-2], weights @ force[:-2], rtol=1e-10)


def test_bekker_is_pressure_times_area(laws):
    np.testing.assert_allclose(laws[0]["soft soil"][0][-1], 0.05 * (2e3 / 0.3 + 8e5) * 0.04**0.7, rtol=1e-14)


def test_coulomb_friction(laws):
    expected = np.stack([-0.7 * 2e3 * np.tanh(SLIPS / 0.3), 0.0 * SLIPS], axis=1)
    np.testing.assert_allclose(laws[0]["coulomb"], expected, rtol=1e-13)


def test_janosi_friction_is_the_mean_shear_stress_over_the_patch(laws):
    """In half contact there is half of the cohesion."""
    speed = lambda v: np.hypot(v, 0.05)
    for slip, found in zip(SLIPS, laws[0]["janosi"], strict=True):
        ratio = abs(slip) / (0.5 * (speed(4.0) + speed(4.0 - slip) + speed(slip)))
        mean, _ = quad(lambda s, ratio=ratio: -np.expm1(-ratio * 0.4 * s / 0.02), 0.0, 1.0, epsrel=1e-13)
        np.testing.assert_allclose(
            found, [-np.sign(slip) * (0.5 * 3e3 * 0.1 + 2e3 * np.tan(0.5)) * mean, 0.0], rtol=1e-9
        )


# Contact


def states(rng, space, k):
    poses = np.asarray(rng.normal(size=(k, space.pose_size)))
    poses[:, space.dimension - 1] = rng.uniform(0.2, 0.45, size=k)
    poses[:, 0] = rng.uniform(3.9, 5.6, size=k)
    if space is SPACE:
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return poses, np.asarray(rng.normal(size=(k, space.velocity_size)))


def test_wheels_of_the_tracked_vehicle():
    """Spring with the slope's share, damping that sets in linearly, traction at the rim: as in the model's equations,
    deep in the ground, at its surface and far above.
    """
    part = three_wheels(WheelContact).resolve(PLANE, np.zeros((3, 3)))
    q = np.array([[4.3, 0.2, 0.4], [5.0, 0.4071, 0.1], [4.5, 30.0, 0.0]])
    v = np.array([[1.0, 0.3, -1.0], [0.3, 0.2, 0.5], [1.0, -1.0, 0.0]])
    ground, slope = oracle.bump(q[:, 0])
    depth, share = oracle.plus(0.305 + ground - q[:, 1])
    traction = -0.7 * 8e5 * depth * np.tanh((v[:, 0] + 0.305 * v[:, 2]) / 0.3)
    normal = 8e5 * depth * share
    damped = normal - 2e4 * np.clip(depth / 0.01, 0, 1) * v[:, 1]
    expected = np.stack([traction - normal * slope, damped, 0.305 * traction], axis=1)
    found = jax.jit(lambda q, v: part.wrenches(PLANE, q, v, 0.0))(q, v)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize(
    "space, kind, law",
    [(PLANE, planar.Contact, "soft soil"), (PLANE, WheelContact, "linear"), (SPACE, spatial.Contact, "hertz")],
    ids=["plane", "wheels", "space"],
)
def test_power_of_the_spring_is_loss_of_energy_and_the_rest_dissipates(space, kind, law):
    rng = np.random.default_rng(1)
    poses, velocities = states(rng, space, 3)
    places = {} if kind is WheelContact else {"centres": 0.1 * rng.normal(size=(3, space.dimension))}
    build = lambda **options: three_wheels(kind, normal=LAWS[law], **places, **options).resolve(space, poses)
    smooth = contact.Coulomb(0.0, transition_speed=1.0)
    elastic, rough = build(friction=smooth, damping=0.0), build(friction=JANOSI, damping=3e3)

    @jax.jit
    def seen(poses, velocities):
        rates = jax.vmap(space.rates)(poses, velocities)
        energy = jax.jvp(lambda q: elastic.energy(space, q, 0.0), (poses,), (rates,))
        return energy, [jnp.sum(part.wrenches(space, poses, velocities, 0.0) * velocities) for part in (elastic, rough)]

    (energy, rate), (power, loss) = seen(poses, velocities)
    assert energy > 1.0
    np.testing.assert_allclose(power, -rate, rtol=1e-10)
    assert loss + rate < -1.0


@pytest.mark.parametrize("friction, law", [("coulomb", "hertz"), ("janosi", "soft soil")])
def test_derivatives_are_finite_where_laws_have_kinks(friction, law):
    """At the surface, far off it, and without slip or speed."""
    part = three_wheels(normal=LAWS[law], friction=FRICTION[friction]).resolve(PLANE, np.zeros((3, 3)))
    poses, still = np.array([[0.0, 0.305, 0.0], [1.0, 1e4, 0.0], [2.0, 0.2, 0.0]]), np.zeros((3, 3))
    wrenches = lambda *args: (part.wrenches(PLANE, *args, 0.0),) * 2
    jacobians, value = jax.jit(jax.jacfwd(wrenches, (0, 1), has_aux=True))(poses, still)
    assert all(np.all(np.isfinite(jacobian)) for jacobian in jacobians)
    np.testing.assert_array_equal(np.asarray(value)[:, [0, 2]], 0.0)


def test_one_terrain_for_all_bodies_is_one_parameter():
    wheel = lambda name, x: planar.Body(name, mass=1.0, inertia=0.1, position=(x, 0.3))
    bodies = [wheel(name, x) for name, x in (("a", 4.3), ("b", 4.6), ("c", 4.9))]
    system = mb.Scene(bodies, forces=[three_wheels()]).compile()
    known = mb.parameters(system)
    assert {name: float(known[name]) for name in known if "terrain" in name} == {
        "road.terrain.start": 4.0,
        "road.terrain.length": 1.5,
        "road.terrain.peak": pytest.approx(0.12),
    }
    assert "road.friction.transition_speed" in known and "road.normal.stiffness" in known
    q = system.guess.q
    lift = jax.jit(lambda peak: mb.with_parameters(system, {"road.terrain.peak": peak}).force(0.0, q, 0.0 * q)[1::3])
    assert np.all(np.asarray(lift(0.13)) - np.asarray(lift(0.12)) > 100.0)
    with pytest.raises(ValueError, match=r"road\.terrain\.peak"):
        mb.with_parameters(system, {"road.terrain.height": 0.2})


@pytest.mark.slow
def test_derivatives_through_an_impact_converge():
    """A disc bounces off a floor whose level is a parameter: what it gains in height is twice that of the floor."""
    floor = planar.Contact(
        "floor", ("disc",), radius=0.2, terrain=terrain.Flat(level=0.0), normal=contact.Linear(4e4), smoothing=1e-4
    )
    disc = planar.Body("disc", mass=2.0, inertia=0.04, position=(0.0, 0.3), velocity=(0.0, -3.0))
    system = mb.Scene([disc], forces=[floor]).compile()
    state = mb.assemble(system)

    def height(level, rtol):
        moved = mb.with_parameters(system, {"floor.terrain.level": level})
        return mb.simulate(moved, state, t1=0.15, rtol=rtol)["disc"].position[-1, 1]

    reverse = jit_quickly(jax.grad(height))
    forward = jit_quickly(jax.jacfwd(height))
    for rtol in (1e-8, 1e-10):
        slope = reverse(jnp.zeros(()), rtol)
        assert abs(slope - 2.0) < 1e4 * rtol
        np.testing.assert_allclose(forward(jnp.zeros(()), rtol), slope, rtol=1e-9)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"terrain": 0.0}, "terrain must be a law from jaxmb.terrain"),
        ({"normal": 8e5}, "normal must be a law from jaxmb.contact"),
        ({"friction": 0.7}, "friction must be a law from jaxmb.contact"),
        ({"radius": (0.1, 0.2)}, r"radius must have shape \(\) or \(3,\)"),
        ({"centres": (0.1, 0.2, 0.3)}, r"centres must have shape \(2,\) or \(3, 2\)"),
        ({"radius": -0.1}, "radius must be non-negative"),
        ({"smoothing": 0.0}, "smoothing must be positive"),
        ({"normal": contact.Linear(-1.0)}, "normal.stiffness must be positive"),
        ({"friction": dataclasses.replace(JANOSI, length=0.0)}, "friction.length must be positive"),
    ],
)
def test_contact_that_is_refused(changes, message):
    with pytest.raises(ValueError, match=f"'road': {message}"):
        three_wheels(**changes).resolve(PLANE, np.zeros((3, 3)))
