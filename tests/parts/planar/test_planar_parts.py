"""Identities that every part of a planar scene satisfies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
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

import jaxmb as mb
from jaxmb import planar
from jaxmb.linalg.rotations import rotate_2d
from jaxmb.parts import contact, terrain
from jaxmb.parts.planar.kinematics import PLANE

POINT_A, POINT_B = (0.1, -0.2), (0.4, 0.3)
GROUND = jnp.zeros(3)
RATIO, RADIUS = -0.4, 0.3


def random_poses(rng, k=2):
    return jnp.asarray(rng.normal(size=(k, 3)))


def random_unit(rng):
    v = rng.normal(size=2)
    return jnp.asarray(v / np.linalg.norm(v))


def move(pose, angle, centre, shift):
    """The body turned by `angle` about a world point, then shifted."""
    return jnp.concatenate([centre + rotate_2d(angle, pose[:2] - centre) + shift, (pose[2] + angle)[None]])


def net_wrench(poses, wrenches):
    """Resultant force and moment about the world origin."""
    moments = poses[:, 0] * wrenches[:, 1] - poses[:, 1] * wrenches[:, 0] + wrenches[:, 2]
    return np.array([*np.sum(wrenches[:, :2], axis=0), np.sum(moments)])


# Joints


def world(cls):
    return lambda q, point, axis: cls("J", "a", "b", point=point, axis=axis)


def pin(cls):
    return lambda q, point, axis: cls("J", "a", "b", point=point)


def of_b(motion):
    return lambda q, point, axis, x: q.at[1].set(motion(q[1], point, axis, x))


def on_link(q, point, axis, x):
    """B turned about its own end of the rod, then the rod about its other end."""
    A, B = PLANE.point(q[0], jnp.array(POINT_A)), PLANE.point(q[1], jnp.array(POINT_B))
    return q.at[1].set(move(move(q[1], x[0], B, jnp.zeros(2)), x[1], A, jnp.zeros(2)))


def circle_of(radius):
    """A circle about the origin of A through the point of B."""
    return planar.PointOnCurve(
        "J",
        "a",
        "b",
        lambda point, p: jnp.dot(point, point) - p["radius"] ** 2,
        point_b=POINT_B,
        parameters={"radius": radius},
    )


def on_circle(q, point, axis, x):
    B = PLANE.point(q[1], jnp.array(POINT_B))
    return q.at[1].set(move(move(q[1], x[0], B, jnp.zeros(2)), x[1], q[0, :2], jnp.zeros(2)))


def meshed(q, point, axis, x):
    """The gear A turned by x[0] on the carrier C, and everything else that the gears leave free."""
    return (
        (q + x[1:].reshape(3, 3))
        .at[:, 2]
        .set(jnp.stack([q[0, 2] + x[0] + x[3], q[1, 2] + RATIO * x[0] + x[3], q[2, 2] + x[3]]))
    )


def on_rack(q, point, axis, x):
    """The rack turned and shifted, the pinion along with it, off it, and turned while it travels."""
    turn, shift, spin, off = x[0], x[1:3], x[3], x[4]
    along = rotate_2d(q[1, 2], axis)
    travel = -RADIUS * spin * along + off * jnp.stack([-along[1], along[0]])
    A = PLANE.point(q[0], jnp.array(POINT_A))
    pinion = move(q[0], spin, A, travel)
    return jnp.stack([move(pinion, turn, jnp.zeros(2), shift), move(q[1], turn, jnp.zeros(2), shift)])


CASES = {
    "Revolute": Case(2, pin(planar.Revolute), of_b(lambda b, point, a, x: move(b, x[0], point, jnp.zeros(2)))),
    "Fixed": Case(3, pin(planar.Fixed), lambda q, point, a, x: q),
    "PointOnLine": Case(1, world(planar.PointOnLine), of_b(lambda b, point, a, x: move(b, x[0], point, x[1] * a))),
    "Prismatic": Case(
        2, world(planar.Prismatic), of_b(lambda b, point, a, x: move(b, jnp.array(0.0), point, x[0] * a))
    ),
    "Distance": Case(1, lambda q, point, a: planar.Distance("J", "a", "b", point_a=POINT_A, point_b=POINT_B), on_link),
    "PointOnCurve": Case(
        1,
        lambda q, point, a: circle_of(jnp.linalg.norm(PLANE.body_point(q[0], PLANE.point(q[1], jnp.array(POINT_B))))),
        on_circle,
    ),
    "Gear": Case(1, lambda q, point, a: planar.Gear("J", "a", "b", ratio=RATIO, carrier="c"), meshed, bodies=3),
    "RackAndPinion": Case(
        1,
        lambda q, point, a: planar.RackAndPinion(
            "J", "a", "b", radius=RADIUS, axis_b=a, point_a=POINT_A, point_b=POINT_B
        ),
        on_rack,
    ),
}


def set_up(case):
    rng = np.random.default_rng(7)
    poses = random_poses(rng, case.bodies)
    frame = (jnp.asarray(rng.normal(size=2)), random_unit(rng))
    part = case.build(poses, *frame).resolve(PLANE, poses)
    motion = lambda x: case.motion(poses, *frame, x)
    # Gear and rack: all motions; otherwise those of B relative to A.
    whole = type(part) in (planar.Gear, planar.RackAndPinion)
    freedoms = 3 * (case.bodies if whole else 1) - case.rows
    numbers = {planar.Gear: 10, planar.RackAndPinion: 5}.get(type(part), freedoms)
    x = jnp.asarray(rng.uniform(0.3, 1.0, size=numbers))
    # All bodies carried along, several turns.
    moved = jnp.stack([move(q, jnp.array(9.0), jnp.zeros(2), jnp.ones(2)) for q in motion(x)])
    return Setup(PLANE, case, rng, poses, part, motion, x, freedoms, moved, random_poses(rng, case.bodies))


@pytest.fixture(params=CASES, scope="module")
def setup(request):
    return set_up(CASES[request.param])


@pytest.mark.slow("Revolute")
def test_joint_holds_along_admissible_motions(setup):
    check_joint_holds(setup)


def test_joint_rank_and_freedoms(setup):
    check_joint_rank(setup)


def test_joint_reaction_has_no_net_wrench(setup):
    check_joint_reaction(setup, net_wrench)


def test_joint_resolves_to_body_fixed_form(setup):
    check_joint_resolves(setup)


def test_joint_parameter_derivatives(setup):
    check_parameter_derivatives(lambda part: setup.residual(part, setup.elsewhere), setup.part, setup.rng)


def test_joint_stacks(setup):
    check_joint_stacks(setup)


def test_distance_multiplier_is_the_rod_force():
    poses = random_poses(np.random.default_rng(5))
    part = planar.Distance("rod", "a", "b", point_a=POINT_A, point_b=POINT_B).resolve(PLANE, poses)
    np.testing.assert_allclose(
        jnp.linalg.norm(jax.jacfwd(lambda q: part.residual(PLANE, q, 0.0))(poses)[0, 1, :2]), 1.0
    )


def test_pinion_on_top_of_a_rack_turns_clockwise_to_the_right():
    poses = jnp.array([[0.0, RADIUS, 0.0], [0.0, 0.0, 0.0]])
    part = planar.RackAndPinion("J", "a", "b", radius=RADIUS).resolve(PLANE, poses)
    rolled = poses.at[0].add(jnp.array([RADIUS * 0.5, 0.0, -0.5]))
    np.testing.assert_allclose(part.residual(PLANE, rolled, 0.0), 0.0, atol=1e-15)


def test_gears_that_mesh_outside_turn_against_each_other():
    poses = jnp.zeros((3, 3))
    part = planar.Gear("J", "a", "b", ratio=-1.0 / 2.0).resolve(PLANE, poses)
    assert part.bodies == ("a", "b", "ground")
    turned = poses.at[0, 2].set(1.0).at[1, 2].set(-0.5)
    np.testing.assert_allclose(part.residual(PLANE, turned, 0.0), 0.0, atol=1e-15)


# Drivers


QUANTITIES = ("angle", "x", "y", "distance")


def driver(quantity, **kwargs):
    motion = lambda t, p: p["speed"] * t
    return planar.Driver("drive", "a", "b", quantity=quantity, motion=motion, parameters={"speed": 3.0}, **kwargs)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_driver(quantity):
    rng = np.random.default_rng(2)
    poses = random_poses(rng)
    points = {} if quantity == "angle" else {"point_a": POINT_A, "point_b": POINT_B}
    part = driver(quantity, **points).resolve(PLANE, poses)
    d = PLANE.point(poses[1], jnp.asarray(POINT_B)) - PLANE.point(poses[0], jnp.asarray(POINT_A))
    expected = {
        "angle": poses[1, 2] - poses[0, 2],
        "x": rotate_2d(poses[0, 2], jnp.array([1.0, 0.0])) @ d,
        "y": rotate_2d(poses[0, 2], jnp.array([0.0, 1.0])) @ d,
        "distance": np.linalg.norm(d),
    }[quantity]
    assert part.rheonomic
    np.testing.assert_allclose(part.measured(PLANE, poses), [expected], rtol=1e-13)
    np.testing.assert_allclose(part.residual(PLANE, poses, jnp.array(expected / 3.0)), [0.0], rtol=0, atol=1e-14)
    row = jax.jacfwd(lambda q: part.residual(PLANE, q, 0.0))(poses)
    assert rank(row.reshape(1, 6)) == 1
    np.testing.assert_allclose(net_wrench(poses, row[0]), 0.0, atol=1e-13)
    check_parameter_derivatives(lambda p: p.residual(PLANE, poses, 0.4), part, rng)


# Rolling


ROLLING = {"KnifeEdge": planar.KnifeEdge("blade", "a", point=(0.2, 0.0))}


@pytest.mark.parametrize("name", ROLLING)
def test_rolling_parameter_derivatives(name):
    rng = np.random.default_rng(3)
    poses, velocities = random_poses(rng, 1), random_poses(rng, 1)
    rows = lambda part: part.residual(PLANE, poses, velocities, 0.0)
    check_parameter_derivatives(rows, ROLLING[name].resolve(PLANE, poses), rng)


def test_knife_edge():
    pose = jnp.array([[0.3, 0.4, 0.7]])
    blade = ROLLING["KnifeEdge"].resolve(PLANE, pose)
    rows = lambda u: blade.residual(PLANE, pose, jnp.asarray(u)[None], 0.0)
    c, s = np.cos(0.7), np.sin(0.7)
    np.testing.assert_allclose(rows([c, s, 0.0]), [0.0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(rows([-s, c, 0.0]), [1.0])
    np.testing.assert_allclose(rows([0.0, 0.0, 1.0]), [0.2])
    assert blade.linear and blade.homogeneous and blade.rows == 1


# Forces


def springs(damping):
    points = {"point_a": POINT_A, "point_b": POINT_B}
    laws = {
        "normal": contact.Linear(30.0),
        "friction": contact.Coulomb(0.4 * damping, transition_speed=0.5),
        "damping": 0.5 * damping,
    }
    return {
        "SpringDamper": planar.SpringDamper(
            "F", "a", "b", stiffness=30.0, damping=2.0 * damping, free_length=0.4, **points
        ),
        "TorsionalSpringDamper": planar.TorsionalSpringDamper(
            "F", "a", "b", stiffness=30.0, damping=2.0 * damping, free_angle=0.3
        ),
        "Bushing": planar.Bushing(
            "F", "a", "b", stiffness=(1.0, 2.0, 3.0), damping=damping * np.array([0.6, 0.5, 0.4]), **points
        ),
        "DraftGear": planar.DraftGear(
            "F",
            "a",
            "b",
            stiffness=30.0,
            unloading=1.0 - 0.6 * damping,
            preload=2.0,
            slack=0.05,
            travel=0.2,
            stop_stiffness=50.0,
            damping=0.5 * damping,
            transition_speed=2.0,
            smoothing=0.3,
            free_length=0.4,
            **points,
        ),
        "PlateContact": planar.PlateContact(
            "F", ("a", "b"), radius=2.0, centre=POINT_A, start=(1.3, -0.4), end=(2.5, 0.3), edge=0.6, **laws
        ),
        "DiscContact": planar.DiscContact(
            "F", ("a", "b"), radius=2.0, centre=POINT_A, radii=0.7, centres=POINT_B, **laws
        ),
    }


def pairs():
    return springs(1.0) | {
        "Torque": planar.Torque("F", "b", torque=2.0, reaction="a"),
        "RotationalDamper": planar.RotationalDamper("F", "a", "b", damping=2.0),
    }


def forces():
    """Every force; those between two bodies are `pairs`."""
    points = {"point_a": POINT_A, "point_b": POINT_B}
    path = [("a", (1.0, 0.2)), ("b", (-0.6, 0.3)), ("a", (0.1, -0.9))]
    return pairs() | {
        "Damper": planar.Damper("F", "a", "b", damping=2.0, **points),
        "PointForce": planar.PointForce("F", "b", force=(1.0, 2.0), point=POINT_A),
        "body PointForce": planar.PointForce("F", "b", force=(1.0, 2.0), point=POINT_A, frame="body"),
        "Track": planar.Track("F", path, pretension=2.0, stiffness=30.0, free_length=1.0),
        "Contact": planar.Contact(
            "F",
            ("a", "b"),
            terrain=terrain.Slope(0.2),
            normal=contact.Linear(30.0),
            friction=contact.Coulomb(0.4, transition_speed=0.5),
            radius=2.0,
            damping=0.5,
        ),
        "Tyre": planar.Tyre(
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


def test_the_deflection_of_a_tyre_decays_over_its_relaxation_length():
    tyre = planar.Tyre(
        "F",
        "a",
        terrain=terrain.Flat(),
        normal=contact.Linear(30.0),
        radius=0.5,
        coefficient=0.4,
        slip_stiffness=5.0,
        relaxation_length=0.3,
        deflection=0.1,
        transition_speed=0.2,
    )
    # Rolling without slip at 2 m/s, then locked.
    pose = jnp.array([[1.0, 0.5, 0.3]])
    part, speed = tyre.resolve(PLANE, pose), np.hypot(2.0, 0.2)
    for spin, slip in ((-4.0, 0.0), (0.0, 2.0)):
        rates = part.state_rates(PLANE, pose, jnp.array([[2.0, 0.0, spin]]), 0.0)
        np.testing.assert_allclose(rates["deflection"], [-slip - speed / 0.3 * 0.1], rtol=1e-12)


def force_state():
    rng = np.random.default_rng(9)
    return random_poses(rng), random_poses(rng), random_poses(rng)


@pytest.mark.slow("PlateContact-0.0", "PlateContact-1.0", "DiscContact-0.0", "DiscContact-1.0")
@pytest.mark.parametrize("damping", [0.0, 1.0])
@pytest.mark.parametrize("name", springs(0.0))
def test_spring_power_is_loss_of_energy(name, damping):
    given, poses, velocities = force_state()
    part = springs(damping)[name].resolve(PLANE, given)
    assert part.conservative
    power = jnp.sum(part.wrenches(PLANE, poses, velocities, 0.0) * velocities)
    energy, energy_rate = jax.jvp(lambda q: part.energy(PLANE, q, 0.0), (poses,), (velocities,))
    assert energy > 0
    if damping:
        assert power + energy_rate < -1e-3
    else:
        np.testing.assert_allclose(power, -energy_rate, rtol=1e-12)


@pytest.mark.slow("PlateContact")
@pytest.mark.parametrize("name", pairs())
def test_action_equals_reaction(name):
    given, poses, velocities = force_state()
    wrenches = pairs()[name].resolve(PLANE, given).wrenches(PLANE, poses, velocities, 0.0)
    assert wrenches.shape == (2, 3)
    assert jnp.max(jnp.abs(wrenches)) > 0.1
    np.testing.assert_allclose(net_wrench(poses, wrenches), 0.0, atol=1e-12)


@pytest.mark.slow("PlateContact", "Track")
@pytest.mark.parametrize("name", forces())
def test_force_parameter_derivatives(name):
    part = forces()[name]
    given, poses, velocities = (x[: len(part.bodies)] for x in force_state())
    part = part.resolve(PLANE, given)
    wrenches = eqx.filter_jit(lambda part: jnp.ravel(part.wrenches(PLANE, poses, velocities, 0.0)))
    check_parameter_derivatives(wrenches, part, np.random.default_rng(0))


def test_damper_and_point_force():
    given, poses, velocities = force_state()
    damper = planar.Damper("F", "a", "b", damping=2.0, point_a=POINT_A, point_b=POINT_B).resolve(PLANE, given)
    wrenches = damper.wrenches(PLANE, poses, velocities, 0.0)
    np.testing.assert_allclose(net_wrench(poses, wrenches)[:2], 0.0, atol=1e-13)
    slip = PLANE.point_velocity(poses[1], velocities[1], damper.point_b) - PLANE.point_velocity(
        poses[0], velocities[0], damper.point_a
    )
    np.testing.assert_allclose(jnp.sum(wrenches * velocities), -2.0 * slip @ slip, rtol=1e-12)
    for frame in ("world", "body"):
        force = planar.PointForce("F", "a", force=(1.0, 2.0), point=POINT_A, frame=frame).resolve(PLANE, given[:1])
        wrench = force.wrenches(PLANE, poses[:1], velocities[:1], 0.0)[0]
        force_W = np.array([1.0, 2.0]) if frame == "world" else PLANE.direction(poses[0], force.force)
        np.testing.assert_allclose(wrench[:2], force_W, rtol=1e-13)
        velocity = PLANE.point_velocity(poses[0], velocities[0], force.point)
        np.testing.assert_allclose(wrench @ velocities[0], force_W @ velocity, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("free_length", [0.0, 0.5])
def test_spring_of_zero_length(free_length):
    poses, velocities = jnp.zeros((2, 3)), jnp.ones((2, 3))
    part = planar.SpringDamper("F", "a", "b", stiffness=30.0, damping=2.0, free_length=free_length)
    part = part.resolve(PLANE, poses)
    law = lambda q: part.wrenches(PLANE, q, velocities, 0.0)
    np.testing.assert_allclose(law(poses), 0.0, atol=1e-15)
    np.testing.assert_allclose(jax.grad(lambda q: part.energy(PLANE, q, 0.0))(poses), 0.0, atol=1e-15)
    jacobian = jax.jit(jax.jacfwd(law))(poses)
    np.testing.assert_allclose(jacobian[1, :2, 1, :2], -30.0 * np.eye(2), rtol=0, atol=1e-13)
    by_velocity = jax.jacfwd(lambda v: part.wrenches(PLANE, poses, v, 0.0))(velocities)
    np.testing.assert_allclose(by_velocity[1, :2, 1, :2], -2.0 * np.eye(2), rtol=0, atol=1e-13)


@pytest.mark.slow
def test_motions_about_a_spring_of_zero_length_are_damped():
    body = planar.Body("body", mass=1.0, inertia=0.1)
    slide = planar.Prismatic("slide", "ground", "body", point=(0.0, 0.0), axis=(1.0, 0.0))
    spring = planar.SpringDamper("spring", "ground", "body", stiffness=4.0, damping=0.5, free_length=0.0)
    system = mb.Scene([body], joints=[slide], forces=[spring]).compile()
    state = mb.assemble(system)
    found = mb.linearise(system, state).eigenvalues
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(np.roots([1.0, 0.5, 4.0])), rtol=1e-12)

    def end(rate):
        start = mb.State(state.q, rate * jnp.array([1.0, 0.0, 0.0]))
        return mb.simulate(system, start, t1=0.7, rtol=1e-10)["slide"].displacement[-1]

    damped = np.sqrt(4.0 - 0.25**2)
    exact = np.exp(-0.25 * 0.7) * np.sin(damped * 0.7) / damped
    np.testing.assert_allclose(jax.jit(jax.grad(end))(0.0), exact, rtol=1e-8)


def test_springs_rest_at_the_given_poses():
    given, _, _ = force_state()
    for part in (
        planar.SpringDamper("F", "a", "b", stiffness=30.0),
        planar.TorsionalSpringDamper("F", "a", "b", stiffness=30.0),
        planar.Bushing("F", "a", "b", stiffness=(1.0, 2.0, 3.0), point=(0.5, 0.6)),
    ):
        wrenches = part.resolve(PLANE, given).wrenches(PLANE, given, jnp.zeros((2, 3)), 0.0)
        np.testing.assert_allclose(wrenches, 0.0, atol=1e-13)


# Bodies


BODIES = {
    "Body": (
        planar.Body("a", mass=2, inertia=1, position=(1, 2), angle=0.5, velocity=(4, 5), angular_velocity=7),
        ([1, 2, 0.5], [4, 5, 7]),
    ),
    "PointMass": (planar.PointMass("m", mass=1.0, position=(1, 2), velocity=(4, 5)), ([1, 2], [4, 5])),
}


@pytest.mark.parametrize("name", BODIES)
def test_body_state(name):
    body, (pose, velocities) = BODIES[name]
    body.check()
    np.testing.assert_array_equal(body.pose(), pose)
    np.testing.assert_array_equal(body.velocities(), velocities)
    assert (body.dimension, body.rotates) == (2, len(pose) == 3)


def test_inertias_against_sums_over_points():
    grid = (np.arange(200) + 0.5) / 100 - 1
    x, y = (c.ravel() for c in np.meshgrid(grid, grid))
    inside = x**2 + y**2 < 1
    assert planar.disc(3.0, 0.4) == pytest.approx(3.0 * 0.4**2 * np.mean((x**2 + y**2)[inside]), rel=1e-3)
    assert planar.box(3.0, 0.4, 0.6) == pytest.approx(3.0 * np.mean((0.2 * x) ** 2 + (0.3 * y) ** 2), rel=1e-3)
    assert planar.rod(3.0, 0.4) == pytest.approx(planar.box(3.0, 0.4, 0.0))


# Errors


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (planar.Body("hull", mass=0.0, inertia=1.0), "mass must be positive"),
        (planar.Body("hull", mass=1.0, inertia=-1.0), "inertia must be positive"),
        (planar.Body("hull", mass=1.0, inertia=1.0, position=(0.0, 0.0, 0.0)), r"position must have shape \(2,\)"),
        (planar.Body("hull", mass=1.0, inertia=1.0, angle=np.nan), "angle must be finite"),
        (planar.PointMass("hull", mass=-1.0), "mass must be positive"),
    ],
)
def test_body_errors(part, message):
    with pytest.raises(ValueError, match=f"'hull': .*{message}"):
        part.check()


O, X = (0.0, 0.0), (1.0, 0.0)
TWO = ("J", "a", "b")


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (planar.Revolute(*TWO), "give point_a and point_b"),
        (planar.Revolute(*TWO, point=O, point_a=O, point_b=O), "not both"),
        (planar.Revolute(*TWO, point=(0.0, 0.0, 0.0)), r"point must have shape \(2,\)"),
        (planar.PointOnLine(*TWO, point=O), "give axis_a .fixed in 'a'. or axis"),
        (planar.PointOnLine(*TWO, point=O, axis=(2.0, 0.0)), "axis must be a unit vector.*length 2"),
        (planar.Prismatic(*TWO, point=O, axis_a=O), "axis_a must be a unit vector.*length 0"),
        (planar.Distance(*TWO), "length must be positive"),
        (planar.RackAndPinion(*TWO, radius=0.0), "radius must be positive"),
        (planar.RackAndPinion(*TWO, radius=1.0, axis_b=O), "axis_b must be a unit vector"),
        (planar.Gear(*TWO, ratio=0.0), "ratio must not be zero"),
        (planar.KnifeEdge("J", "a", axis=O), "axis must be a unit vector"),
        (planar.SpringDamper(*TWO, stiffness=-1.0), "stiffness must be non-negative"),
        (planar.TorsionalSpringDamper(*TWO, stiffness=1.0, damping=-1.0), "damping must be non-negative"),
        (planar.Bushing(*TWO, stiffness=(1.0, 1.0), point=O), r"stiffness must have shape \(3,\)"),
        (planar.Torque("J", "b", torque=np.inf), "torque must be finite"),
    ],
)
def test_part_errors(part, message):
    with pytest.raises(ValueError, match=f"'J': .*{message}"):
        part.resolve(PLANE, jnp.zeros((len(part.bodies), 3)))


@pytest.mark.slow
def test_errors_of_choices():
    with pytest.raises(ValueError, match="'drive': quantity must be one of"):
        driver("w")
    with pytest.raises(ValueError, match="'drive': quantity='z' belongs to spatial scenes"):
        driver("z").resolve(PLANE, jnp.zeros((2, 3)))
    with pytest.raises(ValueError, match="'F': frame must be"):
        planar.PointForce("F", "a", force=X, frame="space")


@pytest.mark.slow
def test_every_part_meets_its_identities():
    check_every_part_has_cases(planar, QUANTITIES, CASES, ROLLING, forces().values(), BODIES)
