"""Named frames: parts on them, bodies whose mass centre is elsewhere, and what is measured at them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from part_cases import random_poses, rotated

import jaxmb as mb
from jaxmb import planar, rotations, sections, spatial
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE
from jaxmb.system.quantities import Solved

J = np.diag([0.02, 0.09, 0.07])
TURN = np.asarray(rotations.from_axis_angle(np.array([0.6, 0.0, 0.8]), 0.7))
G = mb.Gravity((0.0, 0.0, -9.81))


def random_state(system, seed=0):
    random = np.random.default_rng(seed)
    q = jax.jit(lambda q: system.normalize(0.0, q))(random.normal(size=system.nq))
    return q, random.normal(size=system.nu)


def two_bodies(*, joints=(), forces=(), frames=()):
    bodies = [spatial.Body("a", mass=1.0, inertia=J), spatial.Body("b", mass=2.0, inertia=J, position=(1.0, 0.0, 0.0))]
    return mb.Scene(bodies, joints=joints, forces=forces, frames=frames).compile()


FRAMES = (
    spatial.Frame("on a", "a", position=(0.3, 0.1, -0.2), orientation=TURN),
    spatial.Frame("on b", "b", position=(-0.5, 0.2, 0.0)),
)


def in_a(direction):
    return np.asarray(rotations.rotate(jnp.asarray(TURN), jnp.asarray(direction)))


@pytest.mark.slow
def test_a_joint_on_frames_is_that_joint_at_their_points_and_axes():
    y = (0.0, 1.0, 0.0)
    points = {"point_a": (0.1, 0.0, 0.0), "point_b": (0.0, 0.0, 0.0)}
    on = spatial.Revolute("hinge", "on a", "on b", axis_a=y, axis_b=y, **points)
    by_hand = spatial.Revolute(
        "hinge",
        "a",
        "b",
        point_a=np.array([0.3, 0.1, -0.2]) + in_a([0.1, 0.0, 0.0]),
        point_b=(-0.5, 0.2, 0.0),
        axis_a=in_a(y),
        axis_b=y,
    )
    one, other = two_bodies(joints=[on], frames=FRAMES), two_bodies(joints=[by_hand])
    # The rows across the axis are along other perpendiculars, so each is looked at where the other holds.
    for system, other_system in ((one, other), (other, one)):
        q = mb.assemble(system, fix={"a.position": (0.0, 0.0, 0.0)}).q
        np.testing.assert_allclose(other_system.position_residual(0.0, q), 0.0, rtol=0, atol=1e-10)
    assert one.velocity_rank == other.velocity_rank == 5


@pytest.mark.slow
def test_a_frame_that_moves_takes_its_joint_along():
    """The joint's points follow the numbers of the frame, as in a scene that is compiled with them."""
    joint = spatial.Spherical("ball", "on a", "on b", point_a=(0.1, 0.0, 0.0), point_b=(0.0, 0.0, 0.0))
    system = two_bodies(joints=[joint], frames=FRAMES)
    moved = mb.with_parameters(system, {"on a.position": (0.0, 0.0, 0.5), "on a.orientation": (1.0, 0.0, 0.0, 0.0)})
    there = spatial.Frame("on a", "a", position=(0.0, 0.0, 0.5))
    compiled = two_bodies(joints=[joint], frames=(there, FRAMES[1]))
    q, u = random_state(system)
    for own in ("position_residual", "coordinate_jacobian"):
        np.testing.assert_allclose(getattr(moved, own)(0.0, q), getattr(compiled, own)(0.0, q), rtol=0, atol=1e-13)
    assert float(jnp.max(jnp.abs(moved.velocity_residual(0.0, q, u) - system.velocity_residual(0.0, q, u)))) > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize(
    "force",
    [
        spatial.SpringDamper("force", "on a", "on b", stiffness=7.0, point_a=(0.1, 0.0, 0.0)),
        spatial.Bushing("force", "on a", "on b", stiffness=np.arange(1.0, 7.0), point=(0.2, 0.0, 0.1)),
        spatial.Beam("force", "on a", "on b", section=sections.Circle(radius=0.3, modulus=50.0, poisson_ratio=0.3)),
    ],
)
def test_forces_on_frames_do_the_work_of_their_energy(force):
    system = two_bodies(forces=[force], frames=FRAMES)
    q, u = random_state(system)
    _, power = jax.jvp(lambda q: system.potential_energy(0.0, q), (q,), (system.rates(0.0, q, u),))
    own = system.force(0.0, q, u) - two_bodies().force(0.0, q, u)
    assert abs(power) > 1e-2
    np.testing.assert_allclose(own @ u, -power, rtol=1e-12)


def test_a_torque_in_the_axes_of_a_frame_turns_with_it():
    system = two_bodies(forces=[spatial.Torque("t", body="on a", torque=(1.0, 2.0, 3.0), frame="body")], frames=FRAMES)
    q, u = random_state(system)
    push = jax.jit(lambda system: system.force(0.0, q, u))
    own = np.asarray(push(system)) - np.asarray(push(two_bodies()))
    np.testing.assert_allclose(own[3:6], in_a([1.0, 2.0, 3.0]), rtol=0, atol=1e-13)


def test_points_of_a_frame_are_fixed_in_its_body():
    """A point given in the frame, and the same one in the body, are at one place of the world."""
    frame, pose = planar.Frame("tip", "bar", position=(0.3, 0.1), angle=0.4), np.array([0.7, -0.2, 1.1])
    own, c, s = np.array([0.5, -0.6]), np.cos(0.4), np.sin(0.4)
    in_body = np.array([0.3 + c * own[0] - s * own[1], 0.1 + s * own[0] + c * own[1]])
    np.testing.assert_allclose(frame.point(PLANE, own), in_body, rtol=1e-14)
    np.testing.assert_allclose(PLANE.point(frame.pose(PLANE, pose), own), PLANE.point(pose, in_body), rtol=1e-14)


def test_a_frame_turns_with_its_body():
    """Its angular velocity is the body's, in its own axes; its origin moves with the body."""
    rng, (frame, _) = np.random.default_rng(2), FRAMES
    (pose,), velocity = random_poses(rng, SPACE, 1), rng.normal(size=6)
    found = np.asarray(frame.velocity(SPACE, pose, velocity))
    np.testing.assert_allclose(rotated(TURN, found[3:]), velocity[3:], rtol=1e-13)
    arm = np.array([0.3, 0.1, -0.2])
    np.testing.assert_allclose(found[:3], velocity[:3] + rotated(pose[3:], np.cross(velocity[3:], arm)), rtol=1e-13)


def test_a_blade_on_a_frame_slides_along_its_axis():
    """A velocity constraint: the velocity of the frame's origin across its own axis is zero."""
    frame = planar.Frame("skate", "sled", position=(0.3, 0.1), angle=0.4)
    blade = planar.KnifeEdge("blade", "skate", axis=(1.0, 0.0))
    body = planar.Body("sled", mass=1.0, inertia=0.2)
    system = mb.Scene([body], joints=[blade], frames=[frame]).compile()
    q, u = random_state(system)
    q = np.asarray(q)
    origin = np.array([-np.sin(q[2]), np.cos(q[2])]), np.array([np.cos(q[2]), np.sin(q[2])])
    velocity = u[:2] + u[2] * (0.3 * origin[0] - 0.1 * origin[1])
    across = np.array([-np.sin(q[2] + 0.4), np.cos(q[2] + 0.4)])
    (found,) = jax.jit(lambda q, u: system.velocity_residual(0.0, q, u))(q, u)
    np.testing.assert_allclose(abs(found), abs(velocity @ across), rtol=1e-12)


def linked(centre=(0.4, -0.1, 0.05)):
    """A body on a hinge at its own origin, which is not its mass centre; and an accelerometer."""
    body = spatial.Body("arm", mass=1.3, inertia=J, centre=centre, angular_velocity=(0.0, 2.0, 0.0))
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    imu = spatial.Frame("imu", "arm", position=(0.2, 0.1, 0.0), orientation=TURN)
    return mb.Scene([body], joints=[hinge], forces=[G], frames=[imu]).compile()


@pytest.mark.slow
def test_a_body_given_in_the_frame_of_its_link():
    centre = np.array([0.4, -0.1, 0.05])
    system = linked(centre)
    body = spatial.Body("arm", mass=1.3, inertia=J, position=centre, angular_velocity=(0.0, 2.0, 0.0))
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    other = mb.Scene([body], joints=[hinge], forces=[G]).compile()
    first, second = mb.assemble(system, rates={"hinge.angle": 2.0}), mb.assemble(other, rates={"hinge.angle": 2.0})
    np.testing.assert_allclose(first.q, second.q, rtol=0, atol=1e-14)
    ends = [mb.simulate(s, y, t1=0.6, rtol=1e-11).ys for s, y in ((system, first), (other, second))]
    np.testing.assert_allclose(ends[0].u, ends[1].u, rtol=0, atol=1e-9)
    # The mass centre is a number of the system.
    moved = mb.with_parameters(system, {"arm.centre": (0.6, 0.0, 0.0)})
    np.testing.assert_allclose(mb.assemble(moved, fix={"hinge.angle": 0.0}).q[:3], [0.6, 0.0, 0.0], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_what_an_accelerometer_and_a_gyroscope_measure():
    system = linked()
    ts = np.linspace(0.0, 0.5, 501)
    motion = mb.simulate(system, mb.assemble(system, rates={"hinge.angle": 2.0}), t1=0.5, saveat=ts, rtol=1e-11)
    imu = motion["imu"]
    central = lambda x: (np.asarray(x[2:]) - np.asarray(x[:-2])) / 2e-3
    np.testing.assert_allclose(central(imu.position), imu.velocity[1:-1], rtol=0, atol=1e-4)
    np.testing.assert_allclose(central(imu.velocity), imu.acceleration[1:-1], rtol=0, atol=1e-3)
    np.testing.assert_allclose(central(imu.angular_velocity), imu.angular_acceleration[1:-1], rtol=0, atol=1e-3)
    arm = lambda field: motion.quantity(f"arm.{field}")
    np.testing.assert_allclose(central(arm("velocity")), arm("acceleration")[1:-1], rtol=0, atol=1e-3)
    np.testing.assert_allclose(central(arm("angular_velocity")), arm("angular_acceleration")[1:-1], rtol=0, atol=1e-3)
    felt = jax.vmap(rotations.unrotate)(imu.orientation, imu.acceleration - jnp.array([[0.0, 0.0, -9.81]]))
    np.testing.assert_allclose(imu.specific_force, felt, rtol=0, atol=1e-12)
    # The origin of the frame: 0.2 and 0.1 from the hinge in the link's frame, whatever the mass centre.
    np.testing.assert_allclose(np.linalg.norm(imu.position, axis=1), np.hypot(0.2, 0.1), rtol=0, atol=1e-12)
    axis = np.asarray(rotations.unrotate(jnp.asarray(TURN), jnp.array([0.0, 1.0, 0.0])))
    rate = np.asarray(motion["hinge"].angle_rate)
    np.testing.assert_allclose(imu.angular_velocity, rate[:, None] * axis, rtol=0, atol=1e-11)


def test_frames_on_frames_and_on_the_ground():
    frames = [
        planar.Frame("bench", "ground", position=(1.0, 2.0), angle=0.5),
        planar.Frame("hand", "arm", position=(0.3, 0.0), angle=0.2),
        planar.Frame("tool", "hand", position=(0.0, 0.1), angle=-0.4),
    ]
    arm = planar.Body("arm", mass=1.0, inertia=0.1, position=(1.0, 2.0), angle=0.5)
    pin = planar.Revolute("pin", "bench", "arm", point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    system = mb.Scene([arm], joints=[pin], forces=[mb.Gravity((0.0, -9.81))], frames=frames).compile()
    state = mb.assemble(system)
    ys = jax.tree.map(lambda y: y[None], state)
    solved = Solved(jnp.array([[2.0, 1.0, 0.0]]), jnp.zeros((1, 2)))
    tool = lambda field: system.quantities()[f"tool.{field}"].value(jnp.zeros(1), ys, solved)[0]
    turn = lambda angle: np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    hand = np.array([1.0, 2.0]) + turn(0.5) @ [0.3, 0.0]
    np.testing.assert_allclose(tool("position"), hand + turn(0.7) @ [0.0, 0.1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(tool("angle"), 0.3, rtol=0, atol=1e-12)
    # At rest it feels the force that holds it up, in its own axes.
    np.testing.assert_allclose(turn(0.3) @ tool("specific_force"), [2.0, 1.0 + 9.81], rtol=0, atol=1e-12)
    assert {"tool.position", "hand.angle", "bench.position"} < set(mb.parameters(system))


@pytest.mark.slow
def test_derivatives_by_the_numbers_of_a_frame_and_of_a_mass_centre():
    system = linked()
    values = {name: mb.parameters(system)[name] for name in ("arm.centre", "imu.position")}

    def measured(values):
        changed = mb.with_parameters(system, values)
        motion = mb.simulate(changed, mb.assemble(changed, rates={"hinge.angle": 2.0}), t1=0.2, rtol=1e-10)
        return motion.quantity("imu.specific_force")[-1] @ jnp.array([1.0, 0.7, -0.3])

    reverse = jax.jit(jax.grad(measured))(values)
    value = jax.jit(measured)
    for name, gradient in reverse.items():
        for k in range(3):
            step = 1e-4 * np.eye(3)[k]
            both = [float(value(values | {name: values[name] + sign * step})) for sign in (1, -1)]
            np.testing.assert_allclose(gradient[k], (both[0] - both[1]) / 2e-4, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("frames", "joint", "message"),
    [
        ([spatial.Frame("f", "c")], None, "Frame 'f': Unknown body 'c'"),
        ([spatial.Frame("f", "g"), spatial.Frame("g", "f")], None, "is fixed in itself"),
        ([spatial.Frame("a", "b")], None, "'a' is used twice"),
        ([planar.Frame("f", "a")], None, "Frame 'f' is planar, but the scene is spatial"),
        (
            [spatial.Frame("f", "a", orientation=(2.0, 0.0, 0.0, 0.0))],
            None,
            "orientation must be unit Euler parameters",
        ),
        (["a"], None, "frames must hold planar.Frame or spatial.Frame"),
        ([spatial.Frame("f", "a")], spatial.Spherical("j", "a", "f", point=(0.0, 0.0, 0.0)), "two frames of one body"),
    ],
)
def test_frames_that_cannot_be(frames, joint, message):
    with pytest.raises(ValueError, match=message):
        two_bodies(frames=frames, joints=[] if joint is None else [joint])
