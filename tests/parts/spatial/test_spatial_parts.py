"""Identities that every part of a spatial scene satisfies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import part_checks
import pytest
from part_checks import (
    Case,
    Setup,
    check_every_part_has_cases,
    check_joint_holds,
    check_joint_rank,
    check_joint_reaction,
    check_joint_resolves,
    check_joint_stacks,
    check_parameter_derivatives,
    rank,
)

from jaxmb import spatial
from jaxmb.linalg import rotations as rot
from jaxmb.parts import AbstractCompound, AbstractVelocityConstraint, contact, terrain
from jaxmb.parts.spatial.kinematics import SPACE

POINT_A, POINT_B = (0.1, -0.2, 0.3), (0.4, 0.1, -0.2)
PITCH = -0.3
STILL = jnp.zeros(3)
NO_TURN = jnp.array([1.0, 0.0, 0.0, 0.0])


def random_pose(rng):
    return jnp.concatenate([jnp.asarray(rng.normal(size=3)), rot.normalize(jnp.asarray(rng.normal(size=4)))])


def random_poses(rng):
    return jnp.stack([random_pose(rng), random_pose(rng)])


def random_unit(rng):
    v = rng.normal(size=3)
    return jnp.asarray(v / np.linalg.norm(v))


def across(axis, other=(0.3, -0.5, 0.8)):
    """Two unit vectors that make a right-handed triad with `axis`."""
    u = rot.cross(axis, jnp.asarray(other))
    u = u / jnp.linalg.norm(u)
    return u, rot.cross(axis, u)


def turn(axis, angle):
    return jnp.concatenate([jnp.cos(angle / 2)[None], jnp.sin(angle / 2) * axis])


def turn_3(x):
    """Turn by a rotation vector."""
    angle = jnp.sqrt(jnp.dot(x, x))
    return turn(x / angle, angle)


def move(pose, p, centre, shift):
    """The body turned by `p` about a world point, then shifted."""
    return jnp.concatenate([centre + rot.rotate(p, pose[:3] - centre) + shift, rot.multiply(p, pose[3:])])


def pose_rates(poses, velocities):
    return part_checks.pose_rates(SPACE, poses, velocities)


def velocity_jacobian(f, poses):
    return part_checks.velocity_jacobian(SPACE, f, poses)


# Joints


def world(cls, **kwargs):
    return lambda q, point, axis, second: cls("J", "a", "b", point=point, axis=axis, **kwargs)


def ball(cls):
    return lambda q, point, axis, second: cls("J", "a", "b", point=point)


def cardan(q, point, axis, second):
    return spatial.Universal("J", "a", "b", point=point, axis_a_W=axis, axis_b_W=second)


def gimbal(q, point, axis, second):
    third = {"axis_3_W": rot.cross(axis, second)}
    return spatial.Gimbal("J", "a", "b", point=point, axis_1_W=axis, axis_2_W=second, **third)


# Directions that are neither parallel nor perpendicular, and points of hinges that do not meet.
AXES = np.array([[0.6, 0.0, 0.8], [0.36, 0.8, -0.48], [-0.48, 0.36, 0.8], [0.8, 0.6, 0.0], [0.0, 1.0, 0.0]])
POINTS = np.array([[0.1, 0.2, -0.1], [-0.2, 0.1, 0.3], [0.3, -0.1, 0.1]])


def composite(*sequence, apart=False):
    """A joint, and the motion of B that its hinges and slides make, one after the other from the last to the first."""
    hinges, axes = sequence.count("hinge"), AXES[: len(sequence)]
    points = POINTS[:hinges] if apart else None

    def build(q, point, axis, second):
        return spatial.Composite("J", "a", "b", sequence=sequence, axes_W=axes, points_W=points, point=point)

    def motion(q, point, axis, second, x):
        pose, k = q[1], hinges
        for word, own, value in reversed([*zip(sequence, jnp.asarray(axes), x, strict=False)]):
            k -= word == "hinge"
            centre = jnp.asarray(POINTS[k]) if apart else point
            pose = move(pose, turn(own, value), centre, STILL) if word == "hinge" else pose.at[:3].add(value * own)
        return pose

    return Case(6 - len(sequence), build, of_b(motion))


def link(q, point, axis, second):
    return spatial.Distance("J", "a", "b", point_a=POINT_A, point_b=POINT_B)


def of_b(motion):
    """The poses of both bodies from a motion of B."""
    return lambda q, point, axis, second, x: q.at[1].set(motion(q, point, axis, second, x))


def on_link(poses, point, axis, second, x):
    """B turned about its own end of the rod, then the rod about its other end in two directions."""
    A, B = SPACE.point(poses[0], jnp.array(POINT_A)), SPACE.point(poses[1], jnp.array(POINT_B))
    u, v = across((B - A) / jnp.linalg.norm(B - A))
    pose = move(poses[1], turn_3(x[2:]), B, STILL)
    return move(pose, rot.multiply(turn(u, x[0]), turn(v, x[1])), A, STILL)


def on_thread(poses, point, axis, second, x):
    """Through several turns."""
    angle = 20.0 * x[0]
    return move(poses[1], turn(axis, angle), point, PITCH * angle / (2 * jnp.pi) * axis)


def in_plane(axis, x):
    u, v = across(axis)
    return x[0] * u + x[1] * v


CASES = {
    "Spherical": Case(3, ball(spatial.Spherical), of_b(lambda q, point, a, b, x: move(q[1], turn_3(x), point, STILL))),
    "Revolute": Case(
        5, world(spatial.Revolute), of_b(lambda q, point, a, b, x: move(q[1], turn(a, x[0]), point, STILL))
    ),
    "Universal": Case(
        4,
        cardan,
        of_b(lambda q, point, a, b, x: move(q[1], rot.multiply(turn(a, x[0]), turn(b, x[1])), point, STILL)),
    ),
    "Gimbal": Case(3, gimbal, of_b(lambda q, point, a, b, x: move(q[1], turn_3(x), point, STILL))),
    "Cylindrical": Case(
        4, world(spatial.Cylindrical), of_b(lambda q, point, a, b, x: move(q[1], turn(a, x[0]), point, x[1] * a))
    ),
    "Screw": Case(5, world(spatial.Screw, pitch=PITCH), of_b(on_thread)),
    "Prismatic": Case(
        5, world(spatial.Prismatic), of_b(lambda q, point, a, b, x: move(q[1], NO_TURN, point, x[0] * a))
    ),
    "Planar": Case(
        3, world(spatial.Planar), of_b(lambda q, point, a, b, x: move(q[1], turn(a, x[2]), point, in_plane(a, x)))
    ),
    "Fixed": Case(6, ball(spatial.Fixed), of_b(lambda q, point, a, b, x: q[1])),
    "Composite": composite("hinge", "hinge", apart=True),
    "Composite of all kinds": composite("hinge", "slide", "hinge", "slide", "hinge", apart=True),
    "Distance": Case(1, link, of_b(on_link)),
    "PointOnPlane": Case(
        1, world(spatial.PointOnPlane), of_b(lambda q, point, a, b, x: move(q[1], turn_3(x[2:]), point, in_plane(a, x)))
    ),
    "PointOnLine": Case(
        2, world(spatial.PointOnLine), of_b(lambda q, point, a, b, x: move(q[1], turn_3(x[1:]), point, x[0] * a))
    ),
}


def set_up(case):
    rng = np.random.default_rng(7)
    poses = random_poses(rng)
    point, axis = jnp.asarray(rng.normal(size=3)), random_unit(rng)
    frame = (point, axis, across(axis, rng.normal(size=3))[0])
    part = case.build(poses, *frame).resolve(SPACE, poses)
    motion = lambda x: case.motion(poses, *frame, x)
    x = jnp.asarray(rng.uniform(0.3, 1.0, size=6 - case.rows))
    # Both bodies carried along, and the other sign of B's Euler parameters: the same attitude.
    p, shift = turn_3(jnp.asarray(rng.normal(size=3))), jnp.asarray(rng.normal(size=3))
    moved = jnp.stack([move(pose, p, STILL, shift) for pose in motion(x)]).at[1, 3:].multiply(-1.0)
    return Setup(SPACE, case, rng, poses, part, motion, x, 6 - case.rows, moved, random_poses(rng))


@pytest.fixture(params=CASES, scope="module")
def setup(request):
    return set_up(CASES[request.param])


@pytest.mark.slow("Spherical")
def test_joint_holds_along_admissible_motions(setup):
    check_joint_holds(setup)


@pytest.mark.slow("Revolute", "Composite of all kinds")
def test_joint_rank_and_freedoms(setup):
    check_joint_rank(setup)


def test_joint_reaction_has_no_net_wrench(setup):
    check_joint_reaction(setup, net_wrench)


def test_joint_resolves_to_body_fixed_form(setup):
    check_joint_resolves(setup)
    part, poses = setup.part, setup.poses
    if hasattr(part, "point_a") and type(part) is not spatial.Distance:
        A, B = SPACE.point(poses[0], part.point_a), SPACE.point(poses[1], part.point_b)
        np.testing.assert_allclose(A, B, rtol=0, atol=1e-13)


def test_joint_parameter_derivatives(setup):
    check_parameter_derivatives(lambda part: setup.residual(part, setup.elsewhere), setup.part, setup.rng)


@pytest.mark.parametrize(
    "sequence, options",
    [
        (("slide", "hinge", "slide", "hinge"), {}),
        (("slide", "slide", "ball"), {}),
        # Zero is no value of the second angle here: the first and the third axis are parallel.
        (("hinge", "hinge", "hinge"), {"middle": 1.0, "axes": AXES[[0, 2, 0]], "orientation": NO_TURN}),
    ],
)
def test_coordinates_of_joints_in_succession(sequence, options):
    ground = jnp.array(SPACE.ground)
    axes = options.pop("axes", AXES[: len(sequence)])
    own = {"point_a": POINT_A, "point_b": POINT_B, "orientation": turn(jnp.asarray(AXES[0]), jnp.array(0.5))}
    part = spatial.Composite("J", "a", "b", sequence=sequence, axes=axes, **(own | options))
    part = part.resolve(SPACE, jnp.stack([ground, ground]))
    values = [np.array([0.3, -0.5, 0.2]) if word == "ball" else 0.7 + 0.1 * k for k, word in enumerate(sequence)]
    pose = jnp.concatenate([part.point_a - rot.rotate(part.orientation, part.point_b), part.orientation])
    for word, axis, value in reversed([*zip(sequence, jnp.asarray(axes), values, strict=True)]):
        if word == "slide":
            pose = pose.at[:3].add(value * axis)
        else:
            pose = move(pose, turn_3(value if word == "ball" else value * axis), part.point_a, STILL)
    poses = jnp.stack([ground, pose])
    np.testing.assert_allclose(part.residual(SPACE, poses, 0.0), 0.0, atol=1e-15)
    for found, expected in zip(part.coordinates(SPACE, poses).values(), values, strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_joint_stacks(setup):
    check_joint_stacks(setup)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8)])
def test_hinge_rows_are_regular_for_every_axis(axis):
    poses = random_poses(np.random.default_rng(3))
    part = spatial.Revolute("hinge", "a", "b", point=(0.0, 0.0, 0.0), axis=axis).resolve(SPACE, poses)
    jacobian = velocity_jacobian(lambda q: part.residual(SPACE, q, 0.0), poses)
    assert np.linalg.svd(np.asarray(jacobian)[3:], compute_uv=False).min() > 1.0


def test_weld_and_slide_keep_a_given_orientation():
    orientation = turn(jnp.array([0.0, 0.0, 1.0]), jnp.array(0.5))
    ground = jnp.array(SPACE.ground)
    for part in (
        spatial.Fixed("weld", "ground", "b", point_a=STILL, point_b=STILL, orientation=orientation),
        spatial.Prismatic(
            "slide", "ground", "b", point_a=STILL, point_b=STILL, axis_a=(1.0, 0.0, 0.0), orientation=orientation
        ),
    ):
        part = part.resolve(SPACE, jnp.stack([ground, ground]))
        at = lambda p, part=part: part.residual(SPACE, jnp.stack([ground, ground.at[3:].set(p)]), 0.0)
        np.testing.assert_allclose(at(orientation), 0.0, atol=1e-15)
        # A turn away by a small angle shows as that angle.
        away = rot.multiply(orientation, turn(jnp.array([0.0, 1.0, 0.0]), jnp.array(1e-4)))
        np.testing.assert_allclose(at(away)[-3:], [0.0, 1e-4, 0.0], rtol=0, atol=1e-12)


def test_screw_error_is_axial_distance():
    poses = jnp.stack([jnp.array(SPACE.ground)] * 2)
    part = spatial.Screw("screw", "ground", "b", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), pitch=0.01)
    part = part.resolve(SPACE, poses)
    np.testing.assert_allclose(part.residual(SPACE, poses.at[1, 2].set(1e-6), 0.0)[4], -1e-6, rtol=1e-6)
    z = jnp.array([0.0, 0.0, 1.0])
    halfway = spatial.Screw(
        "screw",
        "ground",
        "b",
        point_a=STILL,
        point_b=STILL,
        axis_a=z,
        axis_b=z,
        pitch=0.01,
        x_a=(1, 0, 0),
        x_b=(0, -1, 0),
    ).resolve(SPACE, poses)
    # At the given pose the turn is a quarter backwards, so B would stand a quarter of the pitch further at turn zero.
    np.testing.assert_allclose(halfway.offset, 0.01 / 4, rtol=1e-12)
    np.testing.assert_allclose(halfway.residual(SPACE, poses, 0.0), 0.0, atol=1e-15)


def test_distance_multiplier_is_the_rod_force():
    poses = random_poses(np.random.default_rng(5))
    part = spatial.Distance("rod", "a", "b", point_a=POINT_A, point_b=POINT_B).resolve(SPACE, poses)
    jacobian = velocity_jacobian(lambda q: part.residual(SPACE, q, 0.0), poses)
    np.testing.assert_allclose(jnp.linalg.norm(jacobian[0, 6:9]), 1.0, rtol=1e-12)


# Drivers


LENGTHS = ("x", "y", "z", "distance")
QUANTITIES = ("angle", *LENGTHS)


def driver(quantity, motion, **kwargs):
    return spatial.Driver("drive", "a", "b", quantity=quantity, motion=motion, parameters={"speed": 3.0}, **kwargs)


@pytest.mark.slow
def test_angle_driver_passes_many_turns():
    rng = np.random.default_rng(1)
    poses, axis, point = random_poses(rng), random_unit(rng), jnp.asarray(rng.normal(size=3))
    part = driver("angle", lambda t, p: p["speed"] * t, axis=axis).resolve(SPACE, poses)
    hinge = spatial.Revolute("hinge", "a", "b", point=point, axis=axis).resolve(SPACE, poses)
    assert part.rheonomic
    assert float(part.measured(SPACE, poses)[0]) == pytest.approx(0.0, abs=1e-15)
    for t in (0.0, 0.4, 1.0, 5.0, 50.0):
        turned = poses.at[1].set(move(poses[1], turn(axis, jnp.array(3.0 * t)), point, STILL))
        np.testing.assert_allclose(hinge.residual(SPACE, turned, t), 0.0, atol=1e-12)
        np.testing.assert_allclose(part.residual(SPACE, turned, jnp.array(t)), [0.0], rtol=0, atol=1e-12)
        wrapped = np.angle(np.exp(3.0j * t))
        np.testing.assert_allclose(part.measured(SPACE, turned), [wrapped], rtol=0, atol=1e-12)
        # The row is the error of the angle, so its multiplier is the driving moment.
        jacobian = velocity_jacobian(lambda q, t=t: part.residual(SPACE, q, jnp.array(t)), turned)
        np.testing.assert_allclose(jacobian[0, 9:], rot.unrotate(turned[1, 3:], axis), rtol=0, atol=1e-12)


@pytest.mark.parametrize("quantity", LENGTHS)
def test_length_driver(quantity):
    poses = random_poses(np.random.default_rng(2))
    part = driver(quantity, lambda t, p: p["speed"] * t, point_a=POINT_A, point_b=POINT_B).resolve(SPACE, poses)
    d = SPACE.point(poses[1], jnp.array(POINT_B)) - SPACE.point(poses[0], jnp.array(POINT_A))
    expected = (
        np.linalg.norm(d) if quantity == "distance" else rot.rotation_matrix(poses[0, 3:])[:, "xyz".index(quantity)] @ d
    )
    np.testing.assert_allclose(part.measured(SPACE, poses), [expected], rtol=1e-13)
    np.testing.assert_allclose(part.residual(SPACE, poses, jnp.array(expected / 3.0)), [0.0], rtol=0, atol=1e-14)


# Rolling


ROLLING = {
    "KnifeEdge": spatial.KnifeEdge("blade", "a", point=(0.2, 0.0, 0.0)),
    "RollingDisc": spatial.RollingDisc("wheel", "a", radius=0.5, centre=(0.1, -0.2, 0.05)),
    "RollingSphere": spatial.RollingSphere("ball", "a", radius=0.2, spin=2.5),
}


@pytest.mark.parametrize("name", ROLLING)
def test_rolling_parameter_derivatives(name):
    rng = np.random.default_rng(3)
    poses, velocities = random_pose(rng)[None], jnp.asarray(rng.normal(size=(1, 6)))

    def rows(part):
        if isinstance(part, AbstractCompound):
            return jnp.concatenate([rows(component) for component in part.components()])
        if isinstance(part, AbstractVelocityConstraint):
            return part.residual(SPACE, poses, velocities, 0.0)
        return part.residual(SPACE, poses, 0.0)

    check_parameter_derivatives(eqx.filter_jit(rows), ROLLING[name].resolve(SPACE, poses), rng)


def plane_frame(rng):
    normal = random_unit(rng)
    return {"point": jnp.asarray(rng.normal(size=3)), "normal": normal}


def rolling_case(build, rng):
    """The parts of a rolling body at a random attitude, in contact, and the stacked velocity rows as a function."""
    link = build(plane_frame(rng)).resolve(SPACE, random_pose(rng)[None])
    contact, rolling = link.components()
    assert contact.name == rolling.name == link.name
    assert contact.bodies == rolling.bodies == link.bodies
    pose = random_pose(rng)
    pose = pose.at[:3].add(-contact.residual(SPACE, pose[None], 0.0)[0] * link.normal)
    np.testing.assert_allclose(contact.residual(SPACE, pose[None], 0.0), 0.0, atol=1e-14)

    def rows(u):
        poses, velocities = pose[None], u[None]
        height = jax.jvp(lambda q: contact.residual(SPACE, q, 0.0), (poses,), (SPACE.rates(pose, u)[None],))[1]
        return jnp.concatenate([height, rolling.residual(SPACE, poses, velocities, 0.0)])

    return link, rolling, pose, rows


def test_rolling_disc():
    rng = np.random.default_rng(4)
    axis = random_unit(rng)
    build = lambda plane: spatial.RollingDisc("wheel", "a", radius=0.5, axis=axis, centre=(0.1, -0.2, 0.05), **plane)
    disc, rolling, pose, rows = rolling_case(build, rng)
    assert rolling.linear and rolling.homogeneous
    jacobian = jax.jit(jax.jacfwd(rows))(jnp.zeros(6))
    assert rank(jacobian) == 3
    # The lowest point of the rim, found on the rim itself.
    n, C = SPACE.direction(pose, axis), SPACE.point(pose, disc.centre)
    u, v = across(n)
    phi = np.arctan2(-v @ disc.normal, -u @ disc.normal)
    rho = 0.5 * (np.cos(phi) * u + np.sin(phi) * v)
    np.testing.assert_allclose(disc.normal @ (C + rho - disc.point), 0.0, atol=1e-14)
    _, _, basis = np.linalg.svd(np.asarray(jacobian))
    for free in basis[3:]:
        velocity = SPACE.point_velocity(pose, jnp.asarray(free), disc.centre + SPACE.body_direction(pose, rho))
        np.testing.assert_allclose(velocity, 0.0, atol=1e-14)
    check_parameter_derivatives(
        lambda part: jnp.concatenate(
            [
                part.components()[0].residual(SPACE, pose[None], 0.0),
                part.components()[1].residual(SPACE, pose[None], jnp.ones((1, 6)), 0.0),
            ]
        ),
        disc,
        rng,
    )


def test_flat_disc_is_finite():
    ground = jnp.array(SPACE.ground)[None]
    contact, rolling = spatial.RollingDisc("wheel", "a", radius=0.5).resolve(SPACE, ground).components()
    rows = lambda q: jnp.concatenate(
        [contact.residual(SPACE, q, 0.0), rolling.residual(SPACE, q, jnp.ones((1, 6)), 0.0)]
    )
    assert jnp.all(jnp.isfinite(jax.jit(jax.jacfwd(rows))(ground)))


@pytest.mark.parametrize("spin", [None, 2.5])
def test_rolling_sphere(spin):
    rng = np.random.default_rng(6)
    build = lambda plane: spatial.RollingSphere("ball", "a", radius=0.2, spin=spin, **plane)
    sphere, rolling, pose, rows = rolling_case(build, rng)
    assert rolling.linear and rolling.homogeneous == (spin is None)
    at_rest, jacobian = rows(jnp.zeros(6)), jax.jit(jax.jacfwd(rows))(jnp.zeros(6))
    assert rank(jacobian) == 3
    assert (spin is None) == bool(jnp.all(at_rest == 0))
    _, _, basis = np.linalg.svd(np.asarray(jacobian))
    velocity = np.linalg.lstsq(np.asarray(jacobian), -np.asarray(at_rest), rcond=None)[0] + basis[3:].sum(0)
    rho = SPACE.body_direction(pose, -0.2 * sphere.normal)
    carried = (spin or 0.0) * np.cross(sphere.normal, pose[:3] - sphere.point)
    np.testing.assert_allclose(SPACE.point_velocity(pose, jnp.asarray(velocity), rho), carried, rtol=0, atol=1e-13)


def test_knife_edge():
    pose = jnp.array([0.3, 0.4, 0.5, *turn(jnp.array([0.0, 0.0, 1.0]), jnp.array(0.7))])[None]
    blade = ROLLING["KnifeEdge"].resolve(SPACE, pose)
    rows = lambda u: blade.residual(SPACE, pose, jnp.asarray(u)[None], 0.0)
    heading = np.array([np.cos(0.7), np.sin(0.7), 0.0])
    np.testing.assert_allclose(rows([*heading, 0.0, 0.0, 0.0]), [0.0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(rows([-heading[1], heading[0], 0.0, 0.0, 0.0, 0.0]), [1.0])
    np.testing.assert_allclose(rows([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), [0.0])
    np.testing.assert_allclose(rows([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), [0.2])
    assert blade.linear and blade.homogeneous


# Forces


def springs(damping):
    points = {"point_a": POINT_A, "point_b": POINT_B}
    return {
        "SpringDamper": spatial.SpringDamper(
            "F", "a", "b", stiffness=30.0, damping=2.0 * damping, free_length=0.4, **points
        ),
        "Bushing": spatial.Bushing(
            "F",
            "a",
            "b",
            stiffness=(1, 2, 3, 4, 5, 6),
            damping=damping * np.array([0.6, 0.5, 0.4, 0.3, 0.2, 0.1]),
            **points,
        ),
    }


def pairs():
    return springs(1.0) | {
        "RotationalDamper": spatial.RotationalDamper("F", "a", "b", damping=2.0),
        "Torque": spatial.Torque("F", "b", torque=(1.0, 2.0, 3.0), reaction="a"),
        "body Torque": spatial.Torque("F", "b", torque=(1.0, 2.0, 3.0), reaction="a", frame="body"),
    }


def forces():
    """Every force; those between two bodies are `pairs`."""
    return pairs() | {
        "Damper": spatial.Damper("F", "a", "b", damping=2.0, point_a=POINT_A, point_b=POINT_B),
        "PointForce": spatial.PointForce("F", "b", force=(1.0, 2.0, 3.0), point=POINT_A),
        "body PointForce": spatial.PointForce("F", "b", force=(1.0, 2.0, 3.0), point=POINT_A, frame="body"),
        "Contact": spatial.Contact(
            "F",
            ("a", "b"),
            terrain=terrain.Slope(0.2),
            normal=contact.Linear(30.0),
            friction=contact.Coulomb(0.4, transition_speed=0.5),
            radius=2.0,
            damping=0.5,
        ),
        "Tyre": spatial.Tyre(
            "F",
            "b",
            terrain=terrain.Slope(0.2),
            normal=contact.Linear(30.0),
            radius=2.0,
            coefficient=0.4,
            slip_stiffness=5.0,
            relaxation_length=0.3,
            damping=0.5,
            deflection=0.1,
        ),
    }


def net_wrench(poses, wrenches):
    """Resultant force and moment about the world origin."""
    moments = [np.cross(q[:3], w[:3]) + rot.rotate(q[3:], w[3:]) for q, w in zip(poses, wrenches, strict=True)]
    return np.concatenate([np.sum(wrenches[:, :3], axis=0), np.sum(moments, axis=0)])


def force_state(seed=9):
    rng = np.random.default_rng(seed)
    return random_poses(rng), random_poses(rng), jnp.asarray(rng.normal(size=(2, 6)))


@pytest.mark.slow("Bushing-0.0")
@pytest.mark.parametrize("damping", [0.0, 1.0])
@pytest.mark.parametrize("name", springs(0.0))
def test_spring_power_is_loss_of_energy(name, damping):
    given, poses, velocities = force_state()
    part = springs(damping)[name].resolve(SPACE, given)
    assert part.conservative
    power = jnp.sum(part.wrenches(SPACE, poses, velocities, 0.0) * velocities)
    energy, energy_rate = jax.jvp(lambda q: part.energy(SPACE, q, 0.0), (poses,), (pose_rates(poses, velocities),))
    assert energy > 0
    if damping:
        assert power + energy_rate < -1e-3
    else:
        np.testing.assert_allclose(power, -energy_rate, rtol=1e-12)


@pytest.mark.parametrize("name", pairs())
def test_action_equals_reaction(name):
    given, poses, velocities = force_state()
    wrenches = pairs()[name].resolve(SPACE, given).wrenches(SPACE, poses, velocities, 0.0)
    assert wrenches.shape == (2, 6)
    assert jnp.max(jnp.abs(wrenches)) > 0.1
    np.testing.assert_allclose(net_wrench(poses, wrenches), 0.0, atol=1e-12)


@pytest.mark.slow("Bushing", "Contact", "Tyre")
@pytest.mark.parametrize("name", forces())
def test_force_parameter_derivatives(name):
    part = forces()[name]
    given, poses, velocities = (x[: len(part.bodies)] for x in force_state())
    part = part.resolve(SPACE, given)
    wrenches = eqx.filter_jit(lambda part: jnp.ravel(part.wrenches(SPACE, poses, velocities, 0.0)))
    check_parameter_derivatives(wrenches, part, np.random.default_rng(0))


def test_forces_are_blind_to_the_sign_of_euler_parameters():
    given, poses, velocities = force_state()
    for part in pairs().values():
        part = part.resolve(SPACE, given)
        flipped = poses.at[1, 3:].multiply(-1.0)
        np.testing.assert_allclose(
            part.wrenches(SPACE, flipped, velocities, 0.0),
            part.wrenches(SPACE, poses, velocities, 0.0),
            rtol=0,
            atol=1e-13,
        )


def test_damper_and_point_force():
    given, poses, velocities = force_state()
    damper = spatial.Damper("F", "a", "b", damping=2.0, point_a=POINT_A, point_b=POINT_B).resolve(SPACE, given)
    wrenches = damper.wrenches(SPACE, poses, velocities, 0.0)
    np.testing.assert_allclose(net_wrench(poses, wrenches)[:3], 0.0, atol=1e-13)
    slip = SPACE.point_velocity(poses[1], velocities[1], damper.point_b) - SPACE.point_velocity(
        poses[0], velocities[0], damper.point_a
    )
    np.testing.assert_allclose(jnp.sum(wrenches * velocities), -2.0 * slip @ slip, rtol=1e-12)
    for frame in ("world", "body"):
        force = spatial.PointForce("F", "a", force=(1.0, 2.0, 3.0), point=POINT_A, frame=frame)
        wrench = force.resolve(SPACE, given[:1]).wrenches(SPACE, poses[:1], velocities[:1], 0.0)[0]
        force_W = np.array([1.0, 2.0, 3.0]) if frame == "world" else SPACE.direction(poses[0], force.force)
        np.testing.assert_allclose(wrench[:3], force_W, rtol=1e-13)
        velocity = SPACE.point_velocity(poses[0], velocities[0], force.point if force.point is not None else STILL)
        np.testing.assert_allclose(wrench @ velocities[0], force_W @ velocity, rtol=1e-12)


@pytest.mark.slow("0.0")
@pytest.mark.parametrize("free_length", [0.0, 0.5])
def test_spring_of_zero_length(free_length):
    poses = jnp.stack([jnp.array(SPACE.ground)] * 2)
    velocities = jnp.ones((2, 6))
    part = spatial.SpringDamper("F", "a", "b", stiffness=30.0, damping=2.0, free_length=free_length)
    part = part.resolve(SPACE, poses)
    law = lambda q: part.wrenches(SPACE, q, velocities, 0.0)
    np.testing.assert_allclose(law(poses), 0.0, atol=1e-15)
    np.testing.assert_allclose(jax.grad(lambda q: part.energy(SPACE, q, 0.0))(poses), 0.0, atol=1e-15)
    jacobian = jax.jit(jax.jacfwd(law))(poses)
    np.testing.assert_allclose(jacobian[1, :3, 1, :3], -30.0 * np.eye(3), rtol=0, atol=1e-13)
    by_velocity = jax.jacfwd(lambda v: part.wrenches(SPACE, poses, v, 0.0))(velocities)
    np.testing.assert_allclose(by_velocity[1, :3, 1, :3], -2.0 * np.eye(3), rtol=0, atol=1e-13)


def test_bushing_law():
    given, _, _ = force_state()
    rng = np.random.default_rng(12)
    axis, point = random_unit(rng), jnp.asarray(rng.normal(size=3))
    part = spatial.Bushing("F", "a", "b", stiffness=(1, 2, 3, 5, 5, 5), point=point).resolve(SPACE, given)
    still = jnp.zeros((2, 6))
    np.testing.assert_allclose(part.wrenches(SPACE, given, still, 0.0), 0.0, atol=1e-14)
    turned = given.at[1].set(move(given[1], turn(axis, jnp.array(2.0)), point, STILL))
    moment = rot.rotate(turned[1, 3:], part.wrenches(SPACE, turned, still, 0.0)[1, 3:])
    offset = SPACE.point(turned[1], part.point_b) - turned[1, :3]
    force = part.wrenches(SPACE, turned, still, 0.0)[1, :3]
    np.testing.assert_allclose(moment - jnp.cross(offset, force), -5.0 * np.sin(2.0) * axis, rtol=0, atol=1e-12)
    shifted = given.at[1, :3].add(SPACE.direction(given[0], jnp.array([0.1, 0.2, 0.3])))
    force = SPACE.body_direction(given[0], part.wrenches(SPACE, shifted, still, 0.0)[1, :3])
    np.testing.assert_allclose(force, [-0.1, -0.4, -0.9], rtol=0, atol=1e-13)


# Bodies


BODIES = {
    "Body": (
        spatial.Body(
            "a",
            mass=2,
            inertia=(1, 2, 2.5),
            position=(1, 2, 3),
            orientation=(0, 1, 0, 0),
            velocity=(4, 5, 6),
            angular_velocity=(7, 8, 9),
        ),
        ([1, 2, 3, 0, 1, 0, 0], [4, 5, 6, 7, 8, 9]),
    ),
    "PointMass": (spatial.PointMass("m", mass=1.0, position=(1, 2, 3), velocity=(4, 5, 6)), ([1, 2, 3], [4, 5, 6])),
}


@pytest.mark.parametrize("name", BODIES)
def test_body_state(name):
    body, (pose, velocities) = BODIES[name]
    body.check()
    np.testing.assert_array_equal(body.pose(), pose)
    np.testing.assert_array_equal(body.velocities(), velocities)
    assert (body.dimension, body.rotates) == (3, len(pose) == 7)


def test_principal_moments_are_a_diagonal_inertia():
    np.testing.assert_array_equal(BODIES["Body"][0].inertia, np.diag([1, 2, 2.5]))


def of_points(points, mass):
    """Inertia of equal masses at points."""
    second = points.T @ points * mass / len(points)
    return np.trace(second) * np.eye(3) - second


def test_inertias_against_sums_over_points():
    grid = (np.arange(60) + 0.5) / 30 - 1
    x, y, z = (c.ravel() for c in np.meshgrid(grid, grid, grid))
    cube = np.stack([x, y, z], axis=1)
    round_z, solid = x**2 + y**2 < 1, x**2 + y**2 + z**2 < 1
    m, r, l = 3.0, 0.4, 1.2
    shapes = [
        (spatial.box(m, 0.2, 0.4, 0.8), cube * np.array([0.1, 0.2, 0.4])),
        (spatial.sphere(m, r), cube[solid] * r),
        (spatial.cylinder(m, r, l), cube[round_z] * np.array([r, r, l / 2])),
        (spatial.rod(m, l, radius=r), cube[round_z][:, [2, 0, 1]] * np.array([l / 2, r, r])),
        (spatial.rod(m, l, "y"), cube * np.array([0.0, l / 2, 0.0])),
        (spatial.disc(m, r, "x"), cube[round_z][:, [2, 0, 1]] * np.array([0.0, r, r])),
    ]
    for inertia, points in shapes:
        np.testing.assert_allclose(inertia, of_points(points, m), rtol=5e-3, atol=1e-12)
    for inertia, _ in shapes[:4]:
        spatial.Body("a", mass=m, inertia=inertia).check()
    assert float(jax.grad(lambda r: spatial.cylinder(m, r, l)[2, 2])(r)) == pytest.approx(m * r)


# Errors


def body(**kwargs):
    return spatial.Body("hull", **({"mass": 1.0, "inertia": (1.0, 1.0, 1.0)} | kwargs))


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (body(mass=0.0), "mass must be positive"),
        (body(mass=(1.0, 2.0)), "mass must have shape"),
        (body(inertia=1.0), r"inertia must have shape \(3, 3\) or \(3,\)"),
        (body(inertia=(1.0, 1.0, np.nan)), "inertia must be finite"),
        (body(inertia=[[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), "inertia must be symmetric"),
        (body(inertia=(1.0, 1.0, -1.0)), "inertia must be positive definite"),
        (body(inertia=spatial.rod(1.0, 1.0)), "give a rod its radius"),
        (body(inertia=(1.0, 1.0, 2.1)), "triangle inequality.*about the mass centre"),
        (body(orientation=(1.0, 1.0, 0.0, 0.0)), "normalise"),
        (body(orientation=(1.0, 0.0, 0.0)), r"orientation must have shape \(4,\)"),
        (body(position=(0.0, 0.0)), r"position must have shape \(3,\)"),
        (body(angular_velocity=(0.0, 0.0, np.inf)), "angular_velocity must be finite"),
        (spatial.PointMass("hull", mass=-1.0), "mass must be positive"),
    ],
)
def test_body_errors(part, message):
    with pytest.raises(ValueError, match=f"'hull': .*{message}"):
        part.check()


O, Z = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
TWO = ("J", "a", "b")


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (spatial.Spherical(*TWO), "give point_a and point_b"),
        (spatial.Spherical(*TWO, point_a=O), "give point_a and point_b"),
        (spatial.Spherical(*TWO, point=O, point_a=O, point_b=O), "not both"),
        (spatial.Spherical(*TWO, point=(0.0, 0.0)), r"point must have shape \(3,\)"),
        (spatial.Revolute(*TWO, point=O), "give axis_a and axis_b"),
        (spatial.Revolute(*TWO, point=O, axis=(0.0, 0.0, 2.0)), "axis must be a unit vector.*length 2"),
        (spatial.Revolute(*TWO, point=O, axis_a=Z, axis_b=O), "axis_b must be a unit vector.*length 0"),
        (spatial.Revolute(*TWO, point=O, axis=Z, axis_a=Z, axis_b=Z), "not both"),
        (spatial.Universal(*TWO, point=O, axis_a=Z), "give axis_b .fixed in 'b'. or axis_b_W"),
        (spatial.Universal(*TWO, point=O, axis_a_W=Z, axis_b_W=Z), "must be perpendicular"),
        (spatial.Composite(*TWO, point=O, sequence=["hinge"]), "give axes .fixed in 'a'. or axes_W"),
        (spatial.Composite(*TWO, point=O, sequence=["pin"], axes=[Z]), "sequence must hold words of"),
        (spatial.Composite(*TWO, point=O, sequence=["hinge"], axes=[Z, Z]), "axes must have 1 rows"),
        (spatial.Composite(*TWO, point=O, sequence=["hinge"], axes=Z), r"axes must have shape \(any, 3\)"),
        (spatial.Composite(*TWO, point=O, sequence=["slide"], axes=[(0.0, 0.0, 2.0)]), "axes must be a unit vector"),
        (
            spatial.Composite(*TWO, point=O, sequence=["hinge", "slide", "hinge"], axes=[Z, (1.0, 0.0, 0.0), Z]),
            "hinge 1, hinge 3 are parallel hinges",
        ),
        (
            spatial.Composite(*TWO, point=O, sequence=["slide"] * 2, axes=[Z, Z]),
            "slide 2 slide in linearly dependent directions",
        ),
        (spatial.Composite(*TWO, point=O, sequence=["ball", "hinge"], axes=[Z, Z]), "have more than three rotations"),
        (spatial.Composite(*TWO, point=O, sequence=["hinge"], axes=[Z], points=[Z, Z]), "points must have 1 rows"),
        (spatial.Composite(*TWO, point=O, sequence=["hinge"], axes=[Z], middle=1.0), "leave it out"),
        (spatial.Composite(*TWO, point=O, sequence=["hinge"] * 3, axes=[Z, (1.0, 0.0, 0.0), Z]), "give another middle"),
        (spatial.Prismatic(*TWO, point=O), "give axis_a .fixed in 'a'. or axis"),
        (spatial.Prismatic(*TWO, point=O, axis=Z, axis_a=Z), "only one of them"),
        (spatial.Prismatic(*TWO, point=O, axis=Z, orientation=(2.0, 0.0, 0.0, 0.0)), "normalise"),
        (spatial.Fixed(*TWO, point=O, orientation=(2.0, 0.0, 0.0, 0.0)), "normalise"),
        (spatial.PointOnLine(*TWO, point=O, axis_a=(0.0, 0.0, 1.1)), "axis_a must be a unit vector"),
        (spatial.Screw(*TWO, point=O, axis=Z, pitch=0.0), "pitch must not be zero"),
        (spatial.Screw(*TWO, point=O, axis=Z, pitch=0.1, x_a=(1.0, 0.0, 0.0)), "give both x_a and x_b"),
        (spatial.Screw(*TWO, point=O, axis=Z, pitch=0.1, x_a=Z, x_b=Z), "x_a must be perpendicular"),
        (spatial.Distance(*TWO), "length must be positive"),
        (driver("angle", lambda t, p: t), "give axis_a"),
        (spatial.KnifeEdge("J", "a", axis=(2.0, 0.0, 0.0)), "axis must be a unit vector"),
        (spatial.RollingDisc("J", "a", radius=0.0), "radius must be positive"),
        (spatial.RollingDisc("J", "a", radius=1.0, axis=O), "axis must be a unit vector"),
        (spatial.RollingSphere("J", "a", radius=1.0, normal=O), "normal must be a unit vector"),
        (spatial.RollingSphere("J", "a", radius=1.0, spin=np.nan), "spin must be finite"),
        (spatial.SpringDamper(*TWO, stiffness=-1.0), "stiffness must be non-negative"),
        (spatial.Bushing(*TWO, stiffness=(1.0, 1.0, 1.0), point=O), r"stiffness must have shape \(6,\)"),
        (spatial.Torque("J", "b", torque=(1.0, 2.0)), r"torque must have shape \(3,\)"),
    ],
)
def test_part_errors(part, message):
    poses = jnp.stack([jnp.array(SPACE.ground)] * 2)
    with pytest.raises(ValueError, match=f"'{part.name}': .*{message}"):
        part.resolve(SPACE, poses)


def test_errors_of_choices():
    with pytest.raises(ValueError, match="'drive': quantity must be one of"):
        driver("turn", lambda t, p: t)
    with pytest.raises(ValueError, match="'drive': axis has no meaning for quantity='x'"):
        driver("x", lambda t, p: t, axis=Z)
    with pytest.raises(ValueError, match="'drive': point_b has no meaning for quantity='angle'"):
        driver("angle", lambda t, p: t, axis=Z, point_b=O)
    with pytest.raises(ValueError, match="'J': frame must be"):
        spatial.Torque("J", "b", torque=Z, frame="space")
    with pytest.raises(ValueError, match="axis must be one of"):
        spatial.rod(1.0, 1.0, "w")


@pytest.mark.slow
def test_every_part_meets_its_identities():
    check_every_part_has_cases(spatial, QUANTITIES, CASES, ROLLING, forces().values(), BODIES)
