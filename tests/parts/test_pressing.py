"""Compliant one-sided forces with damping: they press and never pull, and friction is of the force that presses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import contact, terrain
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE

STIFFNESS, DAMPING, DEPTH, WIDTH, FULL, FRICTION = 2e5, 3e4, 0.004, 2e-3, 0.01, 0.6
# Speeds [m/s] of separation, from a fast approach to a fast rebound.
SPEEDS = jnp.linspace(-2.0, 3.0, 101)
LAWS = {"normal": contact.Linear(STIFFNESS), "damping": DAMPING, "damping_depth": FULL, "smoothing": WIDTH}
SLIDES = {"friction": contact.Coulomb(FRICTION, transition_speed=1e-3)}
GRIP = {"coefficient": FRICTION, "slip_stiffness": 15.0, "relaxation_length": 0.2}


def pressing():
    """The force along the normal, of a smoothed spring and a damper, at the speeds; in NumPy."""
    root = np.hypot(DEPTH, WIDTH)
    depth = 0.5 * (DEPTH + root)
    s = min(depth / FULL, 1.0)
    spring = STIFFNESS * depth * 0.5 * (1 + DEPTH / root)
    return np.maximum(spring - DAMPING * s**3 * (10 - 15 * s + 6 * s * s) * np.asarray(SPEEDS), 0.0)


def disc_in(space, up=1):
    """Poses and velocities of a disc or ball of radius 0.1 that is as deep in a surface at rest, and slides along."""
    pose = np.array(space.ground)
    pose[up] = 0.1 - DEPTH
    velocities = jnp.zeros((len(SPEEDS), 2, space.velocity_size)).at[:, 0, up].set(SPEEDS).at[:, 0, 0].set(1.0)
    return jnp.stack([jnp.asarray(pose), jnp.asarray(space.ground)]), velocities


def forces(part, space, up=1):
    """Along the ground and along its normal, on the first body, at the speeds; in the plane the moment, too."""
    poses, velocities = (x[..., : len(part.bodies), :] for x in disc_in(space, up))
    part = part.resolve(space, poses)
    wrenches = jax.jit(jax.vmap(lambda v: part.wrenches(space, poses, v, 0.0)[0]))(velocities)
    return wrenches[:, 0], wrenches[:, up], wrenches[:, 2]


@pytest.mark.slow("PlateContact", "ball")
@pytest.mark.parametrize("name", ["Contact", "PlateContact", "DiscContact", "ball"])
def test_a_contact_presses_and_its_friction_is_of_this_force(name):
    bodies, sizes = ("disc", "plate"), LAWS | SLIDES | {"radius": 0.1}
    part, space, up = {
        "Contact": lambda: (planar.Contact("touch", "disc", terrain=terrain.Flat(), **sizes), PLANE, 1),
        "PlateContact": lambda: (
            planar.PlateContact("touch", bodies, start=(-1.0, 0.0), end=(1.0, 0.0), **sizes),
            PLANE,
            1,
        ),
        "DiscContact": lambda: (planar.DiscContact("touch", bodies, radii=1e7, centres=(0.0, -1e7), **sizes), PLANE, 1),
        "ball": lambda: (spatial.Contact("touch", "disc", terrain=terrain.Flat(), **sizes), SPACE, 2),
    }[name]()
    along, normal, moment = forces(part, space, up)
    expected = pressing()
    assert expected.min() == 0.0 and np.sum(expected == 0.0) > 10
    np.testing.assert_allclose(normal, expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(along, -FRICTION * expected, rtol=1e-6, atol=1e-9)
    if name == "Contact":
        # Friction acts at the rim.
        np.testing.assert_allclose(moment, 0.1 * along, rtol=1e-9, atol=1e-9)


@pytest.mark.slow("space")
@pytest.mark.parametrize("space, kind", [(PLANE, planar.Tyre), (SPACE, spatial.Tyre)], ids=["plane", "space"])
def test_a_tyre_is_never_pulled_and_grips_by_the_force_that_presses(space, kind):
    up = space.dimension - 1
    # The tread is deflected far beyond its grip.
    tyre = kind("tyre", "disc", radius=0.1, terrain=terrain.Flat(), **LAWS, **GRIP, deflection=[-1.0, 0.0][:up])
    along, normal, _ = forces(tyre, space, up)
    np.testing.assert_allclose(normal, pressing(), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(along, -FRICTION * pressing(), rtol=1e-9, atol=1e-9)


def test_the_ground_does_not_hold_a_wheel_that_rebounds():
    """The derivative by the damping, which is zero beyond, is that of the force on both sides of the limit."""
    pose, velocities = (x[..., :1, :] for x in disc_in(PLANE))

    def lift(damping, velocity):
        laws = LAWS | {"damping": damping}
        part = planar.Contact("touch", "disc", terrain=terrain.Flat(), radius=0.1, **laws).resolve(PLANE, pose)
        return part.wrenches(PLANE, pose, velocity, 0.0)[0, 1]

    slopes = jax.jit(jax.vmap(jax.grad(lift), (None, 0)))(DAMPING, velocities)
    expected = np.where(pressing() > 0, (pressing() - pressing()[40]) / DAMPING, 0.0)
    # The speed of entry 40 is zero.
    np.testing.assert_allclose(slopes, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_stops_never_pull():
    bar = planar.Body("bar", mass=1.0, inertia=0.1)
    slide = planar.Prismatic("slide", "ground", "bar", point=(0.0, 0.0), axis=(1.0, 0.0))
    ends = {"lower": -1.0, "upper": 0.5, "stiffness": 1e4, "damping": 500.0}
    stops = [
        mb.JointStop("linear", "slide.displacement", **ends),
        mb.JointStop("progressive", "slide.displacement", **ends, exponent=1.5),
    ]
    for stop in stops:
        system = mb.Scene([bar], joints=[slide], forces=[stop]).compile()
        at = lambda v, system=system: system.force(0.0, jnp.array([0.51, 0.0, 0.0]), jnp.array([v, 0.0, 0.0]))[0]
        force = np.array(jax.jit(jax.vmap(at))(10 * SPEEDS))
        # Beyond the upper end it pushes back: the faster the bar enters the more, and not at all when it leaves fast.
        assert np.all(force <= 1e-6) and abs(force[0]) < 1e-6 and force[-1] < -1000.0, stop.name
        assert np.max(np.abs(np.diff(force, 2))) < 0.2 * np.max(np.abs(force))
