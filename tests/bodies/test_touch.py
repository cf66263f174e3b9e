"""A ball that touches a surface: rates and second derivatives of its gap and slip are those along a motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import terrain
from jaxmb.system.instant import Instant

MOST_PROGRAMS = 90

# The step of differences, of values that change by about their size in one second.
H = 1e-4
RADII = {"flat": 0.1, "bump": 0.15, "ball": 0.2, "plane": 0.12, "box": 0.17, "waves": 0.3}
# Waves along x that grow.
AMPLITUDE, WAVELENGTH, GROWTH = 0.3, 5.0, 0.4


def scene(dimension):
    """A body with surfaces and one with balls, away from each other; friction in each contact."""
    of = (lambda *v: v) if dimension == 3 else (lambda x, y, z: (x, z))
    bump = terrain.Bump(start=-1.0, length=4.0, peak=0.7)
    waves = terrain.Sinusoid(amplitude=AMPLITUDE, wavelength=WAVELENGTH)
    radius = lambda name: {"radius": RADII[name]}
    on_a, on_b = of(0.1, 0.2, -0.1), of(-0.2, 0.1, 0.15)
    size = {"size": of(1.2, 0.5, 0.4), "point_a": of(0.1, 0.0, 0.1), "point_b": on_b}
    normal = (0.48, 0.36, 0.8) if dimension == 3 else (0.6, 0.8)
    contacts = [
        mb.RigidContact("flat", "b", terrain=terrain.Flat(), centre=on_b, **radius("flat")),
        mb.RigidContact("bump", "b", terrain=bump, centre=on_b, **radius("bump")),
        mb.RigidBallContact("ball", "a", "b", radius_a=0.1, radius_b=RADII["ball"], point_a=on_a, point_b=on_b),
        mb.RigidPlaneContact("plane", "a", "b", normal=normal, point_a=on_a, point_b=on_b, **radius("plane")),
        mb.RigidBoxContact("box", "a", "b", **size, **radius("box")),
        mb.RigidContact("waves", "b", terrain=waves, centre=on_b, **radius("waves")),
    ]
    rubs = [mb.DryFriction(f"rub on {name}", name, coefficient=0.3) for name in RADII]
    if dimension == 2:
        bodies = [
            planar.Body("a", mass=1.0, inertia=0.1, position=(0.2, 0.4), angle=0.3),
            planar.Body("b", mass=1.0, inertia=0.1, position=(0.5, 1.7), angle=-0.4),
        ]
    else:
        turns = [mb.rotations.from_axis_angle(np.array([0.6, 0.0, 0.8]), angle) for angle in (0.3, -0.7)]
        places = zip("ab", ((0.2, 0.1, 0.4), (0.5, 0.9, 1.7)), turns, strict=True)
        bodies = [
            spatial.Body(name, mass=1.0, inertia=(0.1, 0.1, 0.1), position=r, orientation=p) for name, r, p in places
        ]
    system = mb.Scene(bodies, joints=contacts, forces=rubs).compile()
    # A contact with ground that changes in time has its rows by automatic differentiation.
    grows = lambda t: AMPLITUDE * jnp.exp(GROWTH * t)
    return mb.with_inputs(system, {"waves.terrain.amplitude": grows}), np.array(on_b)


def turned(p, v):
    """A vector turned by Euler parameters."""
    return v + 2 * np.cross(p[1:], np.cross(p[1:], v) + p[0] * v)


def moved(q, u, t):
    """The poses after a motion with constant velocities, in space with angular velocities in the axes of the body."""
    if len(u) == 6:
        return q + t * u
    q = q.copy()
    for r, p, v, w in ((slice(k, k + 3), slice(k + 3, k + 7), j, j + 3) for k, j in ((0, 0), (7, 6))):
        half, e = 0.5 * t * u[w : w + 3], q[p]
        c, s = np.cos(np.linalg.norm(half)), half * np.sinc(np.linalg.norm(half) / np.pi)
        q[p] = np.concatenate([[c * e[0] - s @ e[1:]], e[0] * s + c * e[1:] + np.cross(e[1:], s)])
        q[r] = q[r] + t * u[v : v + 3]
    return q


def speed_at(q, u, point):
    """The velocities of the points of both bodies that are at a place of the world."""
    d = len(point)
    size, pose = (3, 3) if d == 2 else (6, 7)
    out = []
    for k in range(2):
        x, v = q[k * pose : (k + 1) * pose], u[k * size : (k + 1) * size]
        arm = point - x[:d]
        swept = v[2] * np.array([-arm[1], arm[0]]) if d == 2 else np.cross(turned(x[3:], v[3:]), arm)
        out.append(v[:d] + swept)
    return out


@pytest.mark.slow("2")
@pytest.mark.parametrize("dimension", [2, 3])
def test_touch_along_motions(dimension):
    system, centre = scene(dimension)
    n, d, random, start = len(RADII), dimension, np.random.default_rng(0), np.asarray(system.guess.q)
    # The numbers of coordinates and velocities of a body, and of two.
    pose, size = (3, 3) if d == 2 else (7, 6)
    poses, of_bodies = 2 * pose, 2 * size

    @jax.jit
    @jax.vmap
    def seen(t, q, u):
        at = Instant(system, t, q, u)
        place, motion = at.contact_place, at.contact_motion
        return place.gaps, place.gradients, place.sizes, motion.rates, motion.biases

    # The last is at rest.
    velocities = np.append(random.normal(size=(3, of_bodies)), np.zeros((1, of_bodies)), axis=0)
    ts = np.array([0.0, -H, H])
    at = [(t, np.append(moved(start[:poses], u, t), start[poses:]), u) for u in velocities for t in ts]
    pad = np.zeros(system.nu - of_bodies)
    found = seen(np.tile(ts, 4), np.stack([q for _, q, _ in at]), np.stack([np.append(u, pad) for *_, u in at]))
    found = [np.asarray(x).reshape(4, 3, *x.shape[1:]) for x in found]
    assert np.all(found[0] > 0.05)
    for k, u in enumerate(velocities):
        gaps, gradients, sizes, rates, biases = (x[k] for x in found)
        central = lambda x: (x[2] - x[1]) / (2 * H)
        # The rates of gaps and of slips are first derivatives, their biases second ones.
        np.testing.assert_allclose(rates[0, :n], central(gaps), rtol=0, atol=1e-6)
        np.testing.assert_allclose(biases[0], central(rates), rtol=0, atol=1e-6)

        # They are linear in velocities, beside those of the ground.
        moves = gradients[0] @ np.append(u, pad)
        np.testing.assert_allclose(rates[0], moves + found[3][3][0], rtol=0, atol=1e-12)

        # Slip is the velocity of one body past the other at the point of the ball that is nearest to the surface.
        x = start[pose:poses]
        matrix = np.array([[np.cos(x[2]), -np.sin(x[2])], [np.sin(x[2]), np.cos(x[2])]])
        c = x[:d] + (matrix @ centre if d == 2 else turned(x[3:], centre))
        names = system.contacts.names
        for name, radius in RADII.items():
            laws = [k for k, own in enumerate(names) if own == f"rub on {name}"]
            slip = rates[0, laws]
            force = gradients[0, names.index(name), size : size + d]
            normal = force / np.linalg.norm(force)
            first, last = speed_at(start, u, c - radius * normal)
            past = last - (first if name in ("ball", "plane", "box") else 0.0)
            if name == "waves":
                place = (c - radius * normal)[0]
                past[-1] -= GROWTH * AMPLITUDE * np.sin(2 * np.pi * place / WAVELENGTH)
            if d == 2:
                np.testing.assert_allclose(slip, past @ [normal[1], -normal[0]], atol=1e-12, err_msg=name)
            else:
                across = past - normal * (past @ normal)
                np.testing.assert_allclose(np.linalg.norm(slip), np.linalg.norm(across), atol=1e-12, err_msg=name)
            # The force of a unit multiplier is larger where the gap is not measured along the normal.
            expected = np.linalg.norm(force)
            np.testing.assert_allclose(sizes[0, np.array(laws) - n], expected, rtol=1e-12, err_msg=name)
            assert (expected == pytest.approx(1.0, abs=1e-9)) == (name not in ("bump", "waves")), name
