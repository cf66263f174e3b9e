"""Laws of single parts of a spatial scene, bodies, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from part_cases import AXES, across, move, product, random_poses, random_unit, rotated, slid, turn, turn_3

from jaxmb import spatial
from jaxmb.parts.spatial.kinematics import SPACE

POINT_A, POINT_B = np.array((0.1, -0.2, 0.3)), np.array((0.4, 0.1, -0.2))
STILL, GROUND = np.zeros(3), np.array(SPACE.ground)
TWO_GROUNDS = np.stack([GROUND, GROUND])
UP = np.array([0.0, 0.0, 1.0])


def residual(part, poses):
    """Of a part that is resolved, in NumPy."""
    return np.asarray(part.residual(SPACE, poses, 0.0))


# Joints


@pytest.mark.parametrize(
    "sequence, options",
    [
        (("slide", "hinge", "slide", "hinge"), {}),
        (("slide", "slide", "ball"), {}),
        # Zero is no value of the second angle here: the first and the third axis are parallel.
        (("hinge", "hinge", "hinge"), {"middle": 1.0, "axes": AXES[[0, 2, 0]], "orientation": GROUND[3:]}),
        (("hinge", "hinge", "hinge"), {"middle": -1.0, "axes": AXES[[0, 2, 0]], "orientation": GROUND[3:]}),
    ],
    ids=["slides and hinges", "a ball", "hinges", "hinges on the other side"],
)
def test_composite_coordinates(sequence, options):
    """Those of the joints in succession, of which the last one is fixed in B."""
    axes = options.get("axes", AXES[: len(sequence)])
    own = {"point_a": POINT_A, "point_b": POINT_B, "orientation": turn(AXES[0], 0.5), "axes": axes} | options
    part = spatial.Composite("J", "a", "b", sequence=sequence, **own).resolve(SPACE, TWO_GROUNDS)
    numbers = np.sign(options.get("middle", 1.0)) * (0.7 + 0.1 * np.arange(len(sequence)))
    values = [np.array([0.3, -0.5, 0.2]) if word == "ball" else x for word, x in zip(sequence, numbers, strict=True)]
    pose = np.append(POINT_A - rotated(own["orientation"], POINT_B), own["orientation"])
    for word, axis, value in reversed([*zip(sequence, axes, values, strict=True)]):
        if word == "slide":
            pose = slid(pose, value * axis)
        else:
            pose = move(pose, turn_3(value if word == "ball" else value * axis), POINT_A)
    coordinates = lambda q: [*part.coordinates(SPACE, q).values()]

    @jax.jit
    def seen(q):
        joints = [] if "ball" in sequence else part.elementary_joints(SPACE, q)
        return part.residual(SPACE, q, 0.0), coordinates(q), [(joint.point, joint.axis) for joint in joints]

    rows, found, joints = seen(np.stack([GROUND, pose]))
    np.testing.assert_allclose(rows, 0.0, atol=1e-15)
    if joints:
        direction = rotated(pose[3:], rotated(own["orientation"] * [1, -1, -1, -1], axes[-1]))
        np.testing.assert_allclose(joints[-1], [pose[:3] + rotated(pose[3:], POINT_B), direction], rtol=0, atol=1e-14)
    for x, expected in zip(found, values, strict=True):
        np.testing.assert_allclose(x, expected, rtol=0, atol=1e-14)


def test_coordinates_are_the_turns_and_shifts_from_the_given_poses():
    """Of joints with several coordinates, about axes that turn with A."""
    rng = np.random.default_rng(9)
    given, point, first = random_poses(rng, SPACE), rng.normal(size=3), random_unit(rng)
    second, third = across(first)
    places = {"point": point, "axis_1_W": first, "axis_2_W": second, "axis_3_W": third}
    parts = [
        spatial.Universal("J", "a", "b", point=point, axis_a_W=first, axis_b_W=second),
        spatial.Gimbal("J", "a", "b", **places),
        spatial.Planar("J", "a", "b", point=point, axis=first),
    ]
    parts = [part.resolve(SPACE, given) for part in parts]
    x_a = rotated(given[0, 3:], np.asarray(parts[2].x_a))
    x, y, z = 0.7, -0.5, 1.1
    turns = product(turn(first, x), turn(second, y))
    moved = [
        move(given[1], turns, point),
        move(given[1], product(turns, turn(third, z)), point),
        move(given[1], turn(first, x), point, y * x_a + z * np.cross(first, x_a)),
    ]
    # A turns and B along with it, which changes no coordinate.
    away = [np.stack([move(pose, turn(third, 0.9), POINT_A) for pose in (given[0], own)]) for own in moved]

    @jax.jit
    def seen(poses):
        return [part.coordinates(SPACE, q) for part, q in zip(parts, poses, strict=True)]

    expected = (
        {"angle_a": x, "angle_b": y},
        {"angle_1": x, "angle_2": y, "angle_3": z},
        {"angle": x, "displacement": [y, z]},
    )
    for found, wanted in zip(seen(away), expected, strict=True):
        assert found.keys() == wanted.keys()
        for name, value in wanted.items():
            np.testing.assert_allclose(found[name], value, rtol=0, atol=1e-13)


def test_angle_counts_from_the_shortest_turn_that_makes_axes_parallel():
    """Where the axes of a hinge are not parallel at the given poses."""
    rng = np.random.default_rng(10)
    given, axis_a, axis_b = random_poses(rng, SPACE), random_unit(rng), random_unit(rng)
    hinge = {"point_a": POINT_A, "point_b": POINT_B, "axis_a": axis_a, "axis_b": axis_b}
    part = spatial.Revolute("J", "a", "b", **hinge).resolve(SPACE, given)
    start, end = rotated(given[1, 3:], axis_b), rotated(given[0, 3:], axis_a)
    about, angle = np.cross(start, end), np.arccos(start @ end)
    straight = move(given[1], turn(about / np.linalg.norm(about), angle), STILL)
    turned = move(straight, turn(end, 0.6), STILL)
    angles = jax.jit(jax.vmap(lambda b: part.coordinates(SPACE, jnp.stack([given[0], b]))["angle"]))
    np.testing.assert_allclose(angles(np.stack([straight, turned])), [0.0, 0.6], rtol=0, atol=1e-13)


def test_hinge_rows_are_regular_for_every_axis():
    poses = random_poses(np.random.default_rng(3), SPACE)
    axes = np.array([(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8)])
    parts = [spatial.Revolute("hinge", "a", "b", point=STILL, axis=axis).resolve(SPACE, poses) for axis in axes]

    def slopes(part):
        column = lambda u: jax.jvp(lambda q: part.residual(SPACE, q, 0.0), (poses,), (rates(u.reshape(2, 6)),))[1]
        rates = lambda u: jax.vmap(SPACE.rates)(jnp.asarray(poses), u)
        return jax.vmap(column, out_axes=-1)(jnp.eye(12))

    stacked = jax.tree.map(lambda *x: np.stack(x), *parts)
    for jacobian in np.asarray(jax.jit(jax.vmap(slopes))(stacked)):
        assert np.linalg.svd(jacobian[3:], compute_uv=False).min() > 1.0


@pytest.mark.parametrize("cls, axis", [(spatial.Fixed, {}), (spatial.Prismatic, {"axis_a": (1.0, 0.0, 0.0)})])
def test_joint_keeps_a_given_orientation(cls, axis):
    orientation = turn(UP, 0.5)
    part = cls("J", "ground", "b", point_a=STILL, point_b=STILL, orientation=orientation, **axis)
    part = part.resolve(SPACE, TWO_GROUNDS)
    at = lambda p: residual(part, np.stack([GROUND, np.append(STILL, p)]))
    np.testing.assert_allclose(at(orientation), 0.0, atol=1e-15)
    # A turn away by a small angle shows as that angle.
    away = product(orientation, turn(np.array([0.0, 1.0, 0.0]), 1e-4))
    np.testing.assert_allclose(at(away)[-3:], [0.0, 1e-4, 0.0], rtol=0, atol=1e-12)


def test_screw_error_is_axial_distance():
    part = spatial.Screw("screw", "ground", "b", point=STILL, axis=UP, pitch=0.01).resolve(SPACE, TWO_GROUNDS)
    np.testing.assert_allclose(residual(part, np.stack([GROUND, slid(GROUND, 1e-6 * UP)]))[4], -1e-6, rtol=1e-6)
    turns = {"axis_a": UP, "axis_b": UP, "pitch": 0.01, "x_a": (1, 0, 0), "x_b": (0, -1, 0)}
    halfway = spatial.Screw("screw", "ground", "b", point_a=STILL, point_b=STILL, **turns).resolve(SPACE, TWO_GROUNDS)
    # At the given pose the turn is a quarter backwards, so B would stand a quarter of the pitch further at turn zero.
    np.testing.assert_allclose(halfway.offset, 0.01 / 4, rtol=1e-12)
    np.testing.assert_allclose(residual(halfway, TWO_GROUNDS), 0.0, atol=1e-15)


def driver(quantity, **options):
    motion = lambda t, p: p["speed"] * t
    return spatial.Driver("J", "a", "b", quantity=quantity, motion=motion, parameters={"speed": 3.0}, **options)


def test_driver_of_an_angle_passes_many_turns():
    rng = np.random.default_rng(1)
    poses, axis, point = random_poses(rng, SPACE), random_unit(rng), rng.normal(size=3)
    part = driver("angle", axis=axis).resolve(SPACE, poses)
    times = np.array([0.0, 0.4, 1.0, 5.0, 50.0])
    turned = np.stack([np.stack([poses[0], move(poses[1], turn(axis, 3.0 * t), point)]) for t in times])

    @jax.jit
    @jax.vmap
    def seen(q, t):
        rates = lambda u: jax.vmap(SPACE.rates)(q, u.reshape(2, 6))
        slope = lambda u: jax.jvp(lambda q: part.residual(SPACE, q, t), (q,), (rates(u),))[1][0]
        return part.residual(SPACE, q, t), part.measured(SPACE, q), jax.vmap(slope)(jnp.eye(12))

    rows, measured, slopes = seen(turned, times)
    assert part.rheonomic
    np.testing.assert_allclose(rows, 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.ravel(measured), np.angle(np.exp(3.0j * times)), rtol=0, atol=1e-12)
    # The row is the error of the angle, so its multiplier is the driving moment.
    for pose, slope in zip(turned[:, 1], np.asarray(slopes), strict=True):
        np.testing.assert_allclose(rotated(pose[3:], slope[9:]), axis, rtol=0, atol=1e-12)


# Rolling


ROLLING = {
    "disc": lambda axis, plane: spatial.RollingDisc(
        "wheel", "a", radius=0.5, axis=axis, centre=(0.1, -0.2, 0.05), **plane
    ),
    "sphere": lambda axis, plane: spatial.RollingSphere("ball", "a", radius=0.2, **plane),
    "sphere on a plane that spins": lambda axis, plane: spatial.RollingSphere(
        "ball", "a", radius=0.2, spin=2.5, **plane
    ),
}


@pytest.mark.parametrize("name", ROLLING)
def test_rolling_point_of_contact_rests(name):
    """In contact at a random attitude: what the rows leave free moves the lowest point with the plane."""
    rng = np.random.default_rng(4)
    axis, normal, origin = random_unit(rng), random_unit(rng), rng.normal(size=3)
    link = ROLLING[name](axis, {"point": origin, "normal": normal}).resolve(SPACE, random_poses(rng, SPACE, 1))
    contact, rolling = link.components()
    assert contact.name == rolling.name == link.name
    assert contact.bodies == rolling.bodies == link.bodies
    (pose,) = random_poses(rng, SPACE, 1)
    pose = slid(pose, -residual(contact, pose[None])[0] * normal)
    np.testing.assert_allclose(residual(contact, pose[None]), 0.0, atol=1e-14)

    def rows(u):
        rates = SPACE.rates(jnp.asarray(pose), u)[None]
        height = jax.jvp(lambda q: contact.residual(SPACE, q, 0.0), (pose[None],), (rates,))[1]
        return jnp.concatenate([height, rolling.residual(SPACE, pose[None], u[None], 0.0)])

    at_rest, jacobian = map(np.asarray, jax.jit(lambda u: (rows(u), jax.jacfwd(rows)(u)))(np.zeros(6)))
    spin = 2.5 if "spins" in name else 0.0
    assert rolling.linear and rolling.homogeneous == (not spin) == (not np.any(at_rest))
    assert np.linalg.matrix_rank(jacobian, tol=1e-6) == 3
    if name == "disc":
        # The lowest point of the rim, found on the rim itself.
        u, v = across(rotated(pose[3:], axis))
        phi = np.arctan2(-v @ normal, -u @ normal)
        arm = rotated(pose[3:], np.asarray(link.centre)) + 0.5 * (np.cos(phi) * u + np.sin(phi) * v)
    else:
        arm = -0.2 * normal
    np.testing.assert_allclose(normal @ (pose[:3] + arm - origin), 0.0, atol=1e-14)
    _, _, basis = np.linalg.svd(jacobian)
    particular = np.linalg.lstsq(jacobian, -at_rest, rcond=None)[0]
    for free in basis[3:]:
        u = particular + free
        velocity = u[:3] + np.cross(rotated(pose[3:], u[3:]), arm)
        np.testing.assert_allclose(velocity, spin * np.cross(normal, pose[:3] - origin), rtol=0, atol=1e-13)


def test_rolling_disc_that_lies_flat_has_finite_derivatives():
    contact, rolling = spatial.RollingDisc("wheel", "a", radius=0.5).resolve(SPACE, GROUND[None]).components()
    rows = lambda q: jnp.concatenate(
        [contact.residual(SPACE, q, 0.0), rolling.residual(SPACE, q, jnp.ones((1, 6)), 0.0)]
    )
    assert np.all(np.isfinite(jax.jit(jax.jacfwd(rows))(GROUND[None])))


def test_knife_edge():
    pose = np.append([0.3, 0.4, 0.5], turn(UP, 0.7))[None]
    blade = spatial.KnifeEdge("blade", "a", point=(0.2, 0.0, 0.0)).resolve(SPACE, pose)
    c, s = np.cos(0.7), np.sin(0.7)
    velocities = np.zeros((4, 6))
    velocities[0, :2], velocities[1, :2], velocities[2, 2], velocities[3, 5] = (c, s), (-s, c), 1.0, 1.0
    rows = [blade.residual(SPACE, pose, u[None], 0.0)[0] for u in velocities]
    np.testing.assert_allclose(rows, [0.0, 1.0, 0.0, 0.2], rtol=0, atol=1e-15)
    assert blade.linear and blade.homogeneous


# Forces


def test_bushing_law():
    """Sine of the angle about any axis; the force along the axes of A."""
    rng = np.random.default_rng(12)
    given = random_poses(rng, SPACE)
    axis, point = random_unit(rng), rng.normal(size=3)
    part = spatial.Bushing("F", "a", "b", stiffness=(1, 2, 3, 5, 5, 5), point=point).resolve(SPACE, given)
    turned = np.stack([given[0], move(given[1], turn(axis, 2.0), point)])
    shifted = np.stack([given[0], slid(given[1], rotated(given[0, 3:], np.array([0.1, 0.2, 0.3])))])
    wrenches = jax.jit(jax.vmap(lambda q: part.wrenches(SPACE, q, jnp.zeros((2, 6)), 0.0)[1]))
    rest, turning, moving = np.asarray(wrenches(np.stack([given, turned, shifted])))
    np.testing.assert_allclose(rest, 0.0, atol=1e-14)
    moment = rotated(turned[1, 3:], turning[3:]) - np.cross(point - turned[1, :3], turning[:3])
    np.testing.assert_allclose(moment, -5.0 * np.sin(2.0) * axis, rtol=0, atol=1e-12)
    back = given[0, 3:] * [1.0, -1.0, -1.0, -1.0]
    np.testing.assert_allclose(rotated(back, moving[:3]), [-0.1, -0.4, -0.9], rtol=0, atol=1e-13)


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
    assert float(jax.jit(jax.grad(lambda r: spatial.cylinder(m, r, l)[2, 2]))(r)) == pytest.approx(m * r)


# What is refused


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
def test_body_that_is_refused(part, message):
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
        (driver("angle"), "give axis_a"),
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
def test_part_that_is_refused(part, message):
    with pytest.raises(ValueError, match=f"'J': .*{message}"):
        part.resolve(SPACE, TWO_GROUNDS)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: driver("turn"), "'J': quantity must be one of"),
        (lambda: driver("x", axis=Z), "'J': axis has no meaning for quantity='x'"),
        (lambda: driver("angle", axis=Z, point_b=O), "'J': point_b has no meaning for quantity='angle'"),
        (lambda: spatial.Torque("J", "b", torque=Z, frame="space"), "'J': frame must be"),
        (lambda: spatial.rod(1.0, 1.0, "w"), "axis must be one of"),
    ],
)
def test_choice_that_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
