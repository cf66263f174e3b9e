"""Tracks around wheels, and the stops of road arms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import tracked_vehicle as oracle
from scipy.spatial import ConvexHull

import jaxmb as mb
from jaxmb import planar
from jaxmb.bodies.groups import stack
from jaxmb.bodies.layout import Layout
from jaxmb.parts.planar.kinematics import PLANE

RADII = np.array([0.3, 0.25, 0.2, 0.35])
PATH = [("hull", (2.0, 0.1)), ("hull", (-2.0, 0.0)), ("rear", (0.0, 0.0)), ("front", (0.1, 0.0))]


def track(path=PATH, **options):
    return planar.Track("track", path, **({"pretension": 1.5e4, "stiffness": 4e5, "free_length": 9.0} | options))


def poses():
    """Of hull, rear and front wheel."""
    return np.array([[0.3, 1.0, 0.1], [-1.0, 0.2, 2.0], [1.4, 0.1, -3.0]])


def perimeter(centres, radii):
    """Of the convex hull of circles, by points on them."""
    turn = 2 * np.pi * np.arange(20000) / 20000
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return ConvexHull((centres[:, None] + radii[:, None, None] * ring).reshape(-1, 2)).area


@pytest.mark.slow
def test_length_of_polygon_and_belt():
    part = track()
    assert part.bodies == ("hull", "rear", "front") and part.owners == (0, 0, 1, 2)
    points = jax.vmap(PLANE.point)(poses()[np.array(part.owners)], part.points)
    np.testing.assert_allclose(
        part.length(PLANE, poses()), np.sum(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)), rtol=1e-14
    )
    belt = jax.jit(lambda radii: track(radii=radii).length(PLANE, poses()))
    for radii in (RADII, RADII[::-1].copy(), np.full(4, 0.3)):
        np.testing.assert_allclose(belt(radii), perimeter(np.asarray(points), radii), rtol=1e-8)
    np.testing.assert_allclose(belt(np.zeros(4)), part.length(PLANE, poses()), rtol=1e-14)


@pytest.mark.slow
def test_belt_around_two_equal_pulleys():
    """Its ends turn back by just half a turn; the middle pulley is not in the way."""
    path = [("a", (1.0, 0.0)), ("a", (-1.0, 0.0)), ("a", (0.0, 0.0))]
    belt = track(path, radii=[0.2, 0.2, 0.2]).resolve(PLANE, jnp.zeros((1, 3)))
    np.testing.assert_allclose(belt.length(PLANE, jnp.zeros((1, 3))), 4.0 + 2 * np.pi * 0.2, rtol=1e-14)


@pytest.mark.parametrize("radii", [None, RADII], ids=["polygon", "belt"])
def test_forces_are_those_of_the_potential_and_of_the_spans(radii):
    rng = np.random.default_rng(0)
    part = track(radii=radii).resolve(PLANE, poses())
    velocities = rng.normal(size=(3, 3))

    @jax.jit
    def evaluate(part, q):
        energy, rate = jax.jvp(lambda q: part.energy(PLANE, q, 0.0), (q,), (velocities,))
        return part.wrenches(PLANE, q, velocities, 0.0), part.tension(PLANE, q), energy, rate

    wrenches, tension, energy, rate = evaluate(part, poses())
    stretch = part.length(PLANE, poses()) - 9.0
    np.testing.assert_allclose(tension, 1.5e4 + 4e5 * stretch, rtol=1e-13)
    np.testing.assert_allclose(energy, 1.5e4 * stretch + 2e5 * stretch**2, rtol=1e-13)
    wrenches = np.asarray(wrenches)
    np.testing.assert_allclose(np.sum(wrenches * velocities), -rate, rtol=1e-12)
    # Nothing from outside, and no torque on wheels about their middle.
    q = poses()
    moment = q[:, 0] * wrenches[:, 1] - q[:, 1] * wrenches[:, 0] + wrenches[:, 2]
    np.testing.assert_allclose(np.sum(wrenches[:, :2], axis=0), 0.0, atol=1e-8)
    np.testing.assert_allclose(np.sum(moment), 0.0, atol=1e-8)
    np.testing.assert_allclose(wrenches[1, 2], 0.0, atol=1e-8)
    if radii is None:
        points = np.stack([PLANE.point(q[k], np.asarray(s)) for k, s in zip(part.owners, part.points, strict=True)])
        spans = np.roll(points, -1, axis=0) - points
        along = spans / np.linalg.norm(spans, axis=1)[:, None]
        np.testing.assert_allclose(wrenches[1, :2], tension * (along[2] - along[1]), rtol=1e-11)


def test_free_length_defaults_to_that_of_the_given_poses():
    part = track(free_length=None).resolve(PLANE, poses())
    np.testing.assert_allclose(part.tension(PLANE, poses()), 1.5e4, rtol=1e-13)


def test_tracks_of_two_vehicles_are_one_kernel():
    other = [(f"other_{body}", point) for body, point in PATH]
    pairs = [(track().resolve(PLANE, poses()), (0, 1, 2)), (track(other).resolve(PLANE, poses()), (3, 4, 5))]
    assert len(stack(pairs, Layout(PLANE, (True,) * 6))) == 1


@pytest.mark.slow
def test_points_that_coincide():
    """A span without length pulls nowhere."""
    path = [("a", (1.0, 0.0)), ("b", (0.0, 0.0)), ("c", (0.0, 0.0))]
    part = track(path).resolve(PLANE, jnp.zeros((3, 3)))
    wrenches = lambda q: part.wrenches(PLANE, q, jnp.zeros((3, 3)), 0.0)
    assert np.all(np.isfinite(jax.jacfwd(wrenches)(jnp.zeros((3, 3)))))


@pytest.mark.parametrize(
    "options, message",
    [
        ({"path": PATH[:2]}, "at least 3 pairs"),
        ({"path": [(body, (*point, 0.0)) for body, point in PATH]}, r"points of shape \(2,\)"),
        ({"radii": (0.1, 0.2)}, r"radii must have shape \(4,\)"),
        ({"radii": (0.1, 0.2, 0.1, 3.0)}, "a circle lies in its neighbour"),
        ({"path": PATH[::-1], "radii": RADII}, "counter-clockwise; reverse its order"),
        ({"path": [("hull", at) for at in ((0, 0), (0, 1), (2, 1), (2, 0))], "radii": np.full(4, 0.2)}, "reverse its"),
        ({"stiffness": -1.0}, "stiffness must be non-negative"),
    ],
)
def test_bad_tracks(options, message):
    with pytest.raises(ValueError, match=f"'track': .*{message}"):
        track(**options).resolve(PLANE, poses())


@pytest.mark.slow
def test_progressive_stop():
    """The model's moment on both sides, the more so the farther in, and next to none between."""
    stop = mb.JointStop("stop", "pivot.angle", stiffness=2e6, lower=-0.5, upper=0.7, exponent=3.0)
    pivot = planar.Revolute("pivot", "hull", "arm", point=(0.0, 0.0)).resolve(PLANE, jnp.zeros((2, 3)))
    stop = stop.of_sources([pivot], [(0, 1)])
    for angle in (-0.7, -0.5, 0.0, 0.7, 0.9):
        q = jnp.zeros((2, 3)).at[:, 2].set(jnp.array([0.3, 0.3 + angle]))
        (low, low_slope), (high, high_slope) = oracle.plus(-0.5 - angle), oracle.plus(angle - 0.7)
        moment = 2e6 * (low**3 * low_slope - high**3 * high_slope)
        wrenches = stop.wrenches(PLANE, q, jnp.zeros((2, 3)), 0.0)
        np.testing.assert_allclose(wrenches[:, 2], [-moment, moment], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(stop.energy(PLANE, q, 0.0), 5e5 * (low**4 + high**4), rtol=1e-8, atol=1e-12)
    with pytest.raises(ValueError, match="'stop': lower must be less than upper"):
        mb.JointStop("stop", "pivot.angle", stiffness=1.0, lower=0.1, upper=-0.1).check()
    with pytest.raises(AttributeError, match=r"planar\.BumpStop is now jaxmb\.JointStop\(\.\.\., exponent=3\.0\)"):
        planar.BumpStop  # noqa: B018
