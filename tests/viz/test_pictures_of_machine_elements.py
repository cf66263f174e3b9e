"""Gears, cams, racks, screws and ropes are drawn as engineers draw them, from their own numbers."""

import itertools
import types

import jax.numpy as jnp
import numpy as np
import pytest
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar, shapes, spatial, viz
from jaxmb.linalg.rotations import rotation_matrix
from jaxmb.trajectory import picture_of, still
from jaxmb.viz.motion_nodes import motion
from jaxmb.viz.scenery import View
from jaxmb.viz.silhouettes import area
from jaxmb.viz.solids import solids

MOST_PROGRAMS = 130
SUN, PLANET, PINION = 0.02, 0.03, 0.025
RING = SUN + 2 * PLANET


def body(name, *position, **given):
    return planar.Body(name, mass=1.0, inertia=1e-3, position=position, **given)


@pytest.fixture(scope="module")
def gears():
    """A planetary gear whose carrier lifts a rack by a pinion; the mass centre of the carrier is off its axis."""
    scene = mb.Scene(
        [
            body("sun", 0.0, 0.0),
            body("planet", SUN + PLANET, 0.0),
            body("carrier", 0.01, 0.0),
            body("rack", PINION, 0.0),
        ],
        joints=[
            planar.Revolute("motor", "ground", "sun", point=(0.0, 0.0)),
            planar.Revolute("output", "ground", "carrier", point=(0.0, 0.0)),
            planar.Revolute("pin", "carrier", "planet", point=(SUN + PLANET, 0.0)),
            planar.Prismatic("rail", "ground", "rack", point=(PINION, 0.0), axis=(0.0, 1.0)),
            planar.Gear("sun mesh", "sun", "planet", ratio=-SUN / PLANET, carrier="carrier"),
            planar.Gear("ring mesh", "planet", "ground", ratio=PLANET / RING, carrier="carrier"),
            planar.RackAndPinion("teeth", "carrier", "rack", radius=PINION, point_a=(-0.01, 0.0), axis_b=(0.0, 1.0)),
        ],
    )
    system = scene.compile()
    q = np.stack([system.guess.q, system.guess.q])
    q[1, 10] = 0.3
    return picture_of(motion_of(system, np.array([0.0, 1.0]), q, np.zeros_like(q)))


def outlines(picture, name):
    return [area(shape) for of, shape in picture.shapes if of == name]


def test_gears_are_drawn_by_their_pitch_circles(gears):
    """About their axes, and the ring with internal teeth on the ground about the axis of the carrier."""
    for name, radius in (("sun", SUN), ("planet", PLANET), ("carrier", PINION)):
        sizes = [np.ptp(corners[:, :2], axis=0).max() for corners in outlines(gears, name)]
        assert max(sizes) == pytest.approx(2 * radius, rel=1e-3), name
    ring = max(outlines(gears, "ground"), key=len)
    reach = np.linalg.norm(ring[:, :2], axis=1)
    assert reach.min() == pytest.approx(RING, rel=1e-3) and RING < reach.max() < 1.1 * RING


def test_rack_reaches_along_its_travel_and_touches_the_pinion(gears):
    rack = next(corners for corners in outlines(gears, "rack") if np.ptp(corners[:, 1]) > 0.2)
    # In the rack, the pinion moves from 0 to -0.3, and the rack reaches two radii further.
    np.testing.assert_allclose([rack[:, 1].min(), rack[:, 1].max()], [-0.3 - 2 * PINION, 2 * PINION], atol=1e-6)
    np.testing.assert_allclose(rack[:, 0].min(), 0.0, atol=1e-9)


def test_equal_gears_of_an_internal_mesh_have_no_wheels():
    joints = [planar.Gear("mesh", "a", "b", ratio=1.0)]
    system = mb.Scene([body("a", 0.0, 0.0), body("b", 1.0, 0.0)], joints=joints).compile()
    assert picture_of(still(system, system.guess)).shapes == []


def curve_of(function, *position, turns=True):
    at = "cam" if turns else "ground"
    joints = [planar.PointOnCurve("contact", at, "pin", function, parameters={"size": 0.03})]
    bodies = [body("pin", *position)] + ([body("cam", 0.0, 0.0)] if turns else [])
    system = mb.Scene(bodies, joints=joints).compile()
    picture = picture_of(still(system, system.guess))
    return outlines(picture, at), picture.width


def test_cam_is_drawn_by_its_profile():
    """A plate of which each corner is on the curve, all around."""
    radius = lambda angle: 0.03 + 0.006 * (1 - jnp.cos(angle)) + 0.004 * jnp.sin(3 * angle)
    profile = lambda point, p: jnp.sqrt(point @ point) - radius(jnp.arctan2(point[1], point[0]))
    (corners,), width = curve_of(profile, 0.03, 0.0)
    angle = np.arctan2(corners[:, 1], corners[:, 0])
    np.testing.assert_allclose(np.linalg.norm(corners[:, :2], axis=1), radius(angle), rtol=1e-6)
    steps = np.linalg.norm(np.diff(corners, axis=0, append=corners[:1]), axis=1)
    assert steps.max() < 2 * width and np.ptp(np.unwrap(angle)) > 2 * np.pi - 0.2


def test_open_curve_is_drawn_where_the_point_is():
    bars, _ = curve_of(lambda point, p: point[1] - 10.0 * point[0] ** 2, 0.02, 0.004, turns=False)
    middles = np.array([0.5 * (bar.min(axis=0) + bar.max(axis=0)) for bar in bars[:-1]])
    np.testing.assert_allclose(middles[:, 1], 10.0 * middles[:, 0] ** 2, atol=1e-4)
    assert len(bars) > 10 and middles[:, 0].min() < 0.02 < middles[:, 0].max()


def test_screw_is_a_rod_through_its_nut():
    nut = spatial.Body("nut", mass=1.0, inertia=np.eye(3), position=(0.0, 0.0, 0.5))
    screw = spatial.Body("screw", mass=1.0, inertia=np.eye(3))
    thread = spatial.Screw("thread", "screw", "nut", point=(0.0, 0.0, 0.2), axis=(0.0, 0.0, 1.0), pitch=0.01)
    system = mb.Scene([nut, screw], joints=[thread]).compile()
    picture = picture_of(still(system, system.guess))
    (of_block, block), (of_rod, rod) = picture.shapes
    assert (of_block, of_rod) == ("screw", "nut")
    ends = rod.position[2] + 0.5 * rod.scale[2] * np.array([-1.0, 1.0]) + 0.5
    np.testing.assert_allclose(rotation_matrix(rod.orientation)[:2, 2], 0.0, atol=1e-12)
    assert ends[0] < block.position[2] < 0.5 < ends[1]


def bob(joint, x, **frames):
    system = mb.Scene([planar.PointMass("bob", mass=1.0, position=(1.0, 0.0))], joints=[joint], **frames).compile()
    q = np.array(x, float)
    return motion_of(system, np.arange(float(len(q))), q, np.zeros_like(q))


def test_slack_rope_hangs_with_its_length():
    """Also where an end is straight below the other; a taut rope is straight."""
    swing = bob(mb.Slack("rope", "ground", "bob", length=2.0), [(1.0, 0.0), (0.0, -0.5), (0.0, -2.0)])
    line = picture_of(swing).paths["rope"]
    points = line.points
    assert line.kind == "cord"
    np.testing.assert_allclose(points[:, -1, :2], swing.ys.q, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1), 2.0, rtol=1e-6)
    assert points[0, :, 1].min() < -0.7 and points[1, :, 1].min() < -1.0
    np.testing.assert_allclose(points[2, :, 0], 0.0, atol=1e-6)


def test_tendon_is_a_cord_through_its_points():
    path = [("ground", (0.0, 0.0)), ("ground", (0.0, 1.0)), ("bob", (0.0, 0.0))]
    swing = bob(mb.Tendon("cord", path), [(1.0, 0.0), (2.0, 0.0)])
    line = picture_of(swing).paths["cord"]
    np.testing.assert_allclose(line.points[1, :, :2], [(0.0, 0.0), (0.0, 1.0), (2.0, 0.0)], atol=1e-12)
    segments = (
        motion("", swing, {}, None)
        .nodes(np.zeros(3), 1e-6, points=(), arrows={}, scale=0.0, thickness=0.0)[-1]
        .varying["points"]
    )
    assert line.kind == "cord" and segments.shape == (2, 2, 2, 3)
    drawn = [np.column_stack(line.get_data()) for line in viz.plot_mechanism(swing, frames=1).axes[0].lines]
    assert any(np.allclose(points, line.points[0, :, :2]) for points in drawn if points.shape == (3, 2))


@pytest.mark.slow
def test_ropes_end_in_blocks_of_the_ground():
    """But not on a drum of the ground."""
    block, drum = mb.Pulley("bob", 0.1, "left"), mb.Pulley("ground", 0.1, "left", centre=(0.5, 1.0))
    parts = [
        mb.Tendon("tendon", [("ground", (-0.5, 0.5)), ("bob", (0.0, 0.0))]),
        mb.Rope("rope", [("ground", (0.0, 0.5)), block, drum]),
    ]
    system = mb.Scene([planar.PointMass("bob", mass=1.0, position=(1.0, 0.0))], joints=parts).compile()
    picture = picture_of(motion_of(system, np.zeros(1), np.array([[1.0, 0.0]]), np.zeros((1, 2))))
    blocks = [shape for body, shape in picture.shapes if isinstance(shape, shapes.Box) and body == "ground"]
    above = [shape.position for shape in blocks if shape.position[1] < 0.9]  # The others belong to the drum.
    np.testing.assert_allclose(sorted(above, key=tuple), [[x, 0.5 + 1.2 * picture.width, 0.0] for x in (-0.5, 0.0)])


def test_body_with_one_joint_reaches_to_its_frames():
    arm = planar.Body("arm", mass=1.0, inertia=0.1, position=(0.4, 0.0))
    pin = planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0))
    tip = planar.Frame("tip", "arm", position=(0.6, 0.0))
    reach = []
    for frames in ([], [tip]):
        system = mb.Scene([arm], joints=[pin], frames=frames).compile()
        shapes = [shape for name, shape in solids(picture_of(still(system, system.guess)), {}, None) if name == "arm"]
        reach.append([shape.position[0] + 0.5 * shape.scale[2] for shape in shapes if shape.scale[2] > 0.3])
    assert [len(bars) for bars in reach] == [1, 2] and max(reach[1]) == pytest.approx(0.6)


def test_small_areas_stand_before_large_ones():
    """A link is seen on the wheel that it carries."""
    wheel = planar.Body("wheel", mass=1.0, inertia=0.1, position=(1.0, 0.0))
    arm = planar.Body("arm", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    road = mb.RigidBallContact("touch", "arm", "wheel", radius_a=0.0, radius_b=0.3)
    pins = [
        planar.Revolute("a", "ground", "arm", point=(0.0, 0.0)),
        planar.Revolute("b", "arm", "wheel", point=(1.0, 0.0)),
    ]
    patches = viz.plot_scene(mb.Scene([wheel, arm], joints=[*pins, road])).axes[0].patches
    sizes = [np.ptp(patch.get_xy(), axis=0).max() for patch in patches]
    disc = max(range(len(sizes)), key=lambda k: np.ptp(patches[k].get_xy()[:, 1]))
    bars = [k for k, size in enumerate(sizes) if 0.4 < size < 0.6 and k != disc]
    assert bars and all(k > disc for k in bars)


@pytest.mark.parametrize("size", [(4.0, 0.1, 0.1), (0.1, 0.1, 4.0), (1.0, 2.0, 0.5)])
def test_camera_is_as_near_as_the_motion_allows(size):
    """All corners of the region are seen, and a corner is near the edge."""
    bounds = np.array([np.zeros(3), size])
    shown = types.SimpleNamespace(planar=False, up=np.array([0.0, 0.0, 1.0]))
    camera = View.of([types.SimpleNamespace(picture=shown, bounds=bounds)], False).camera
    ahead = (camera.target - camera.position) / np.linalg.norm(camera.target - camera.position)
    right = np.cross(ahead, camera.up) / np.linalg.norm(np.cross(ahead, camera.up))
    rays = np.array(list(itertools.product(*bounds.T))) - camera.position
    half = np.tan(camera.field_of_view / 2) * (rays @ ahead)
    places = np.abs([rays @ right / (1.6 * half), rays @ np.cross(right, ahead) / half])
    assert 0.8 < places.max() < 0.9
