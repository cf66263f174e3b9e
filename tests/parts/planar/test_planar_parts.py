"""Laws of single parts of a planar scene, bodies, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from part_cases import move, turned_2d

import jaxmb as mb
from jaxmb import planar
from jaxmb.parts import contact, terrain
from jaxmb.parts.planar.kinematics import PLANE

POINT_A, POINT_B = (0.1, -0.2), (0.4, 0.3)


def residual(part, poses, given=None):
    """In NumPy."""
    poses = np.asarray(poses, float)
    given = np.zeros_like(poses) if given is None else np.asarray(given, float)
    return np.asarray(part.resolve(PLANE, given).residual(PLANE, poses, 0.0))


# Joints


def test_pinion_on_top_of_a_rack_turns_clockwise_to_the_right():
    rack = planar.RackAndPinion("J", "a", "b", radius=0.3)
    given = [[0.0, 0.3, 0.0], [0.0, 0.0, 0.0]]
    found = residual(rack, [[0.15, 0.3, -0.5], [0.0, 0.0, 0.0]], given)
    np.testing.assert_allclose(found, 0.0, atol=1e-15)


def test_gears_that_mesh_outside_turn_against_each_other():
    gear = planar.Gear("J", "a", "b", ratio=-0.5)
    found = residual(gear, [[0.0, 0.0, 1.0], [0.0, 0.0, -0.5], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(found, 0.0, atol=1e-15)
    assert gear.bodies == ("a", "b", "ground")


def test_displacement_is_along_the_axis_of_a_body_that_is_turned():
    rng = np.random.default_rng(5)
    given, (c, s) = rng.normal(size=(2, 3)), np.array([0.6, 0.8])
    moved = given + np.array([[0.0] * 3, [0.7 * c, 0.7 * s, 0.0]])
    for cls in (planar.Prismatic, planar.PointOnLine):
        part = cls("J", "a", "b", point=(0.3, -0.4), axis=(c, s)).resolve(PLANE, given)
        # The slot turns with A, and B with it about the same place.
        together = np.stack([move(pose, 0.9, np.array([0.2, 0.5])) for pose in moved])
        for poses in (moved, together):
            np.testing.assert_allclose(part.coordinates(PLANE, poses)["displacement"], 0.7, rtol=1e-13)


def test_slide_is_pictured_beside_the_mass_centre():
    """On its line, and where this is nearest to the origin of B."""
    poses = np.array([[0.3, -0.2, 0.4], [1.1, 0.9, -0.5]])
    part = planar.Prismatic("J", "a", "b", point=(0.8, 0.1), axis=(0.6, 0.8)).resolve(PLANE, poses)
    ends = [PLANE.point(poses[1], np.asarray(own.point_b)) for own in (part, part.pictured(PLANE))]
    np.testing.assert_allclose(ends[0], [0.8, 0.1], rtol=1e-13)
    expected = poses[1, :2] + (ends[0] - poses[1, :2]) @ [0.8, -0.6] * np.array([0.8, -0.6])
    np.testing.assert_allclose(ends[1], expected, rtol=1e-13)


def test_knife_edge():
    pose = np.array([[0.3, 0.4, 0.7]])
    blade = planar.KnifeEdge("blade", "a", point=(0.2, 0.0)).resolve(PLANE, pose)
    c, s = np.cos(0.7), np.sin(0.7)
    velocities = np.array([(c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)])
    rows = [blade.residual(PLANE, pose, u[None], 0.0)[0] for u in velocities]
    np.testing.assert_allclose(rows, [0.0, 1.0, 0.2], rtol=0, atol=1e-15)
    assert blade.linear and blade.homogeneous and blade.rows == 1


# Forces


def test_rotational_damper_acts_against_the_relative_rate():
    part = planar.RotationalDamper("F", "a", "b", damping=2.0)
    turning = np.array([[0.1, 0.2, 0.7], [-0.3, 0.4, -0.5]])
    found = part.wrenches(PLANE, np.zeros((2, 3)), turning, 0.0)
    np.testing.assert_allclose(found, [[0.0, 0.0, -2.4], [0.0, 0.0, 2.4]], rtol=1e-14)


def test_slip_in_a_joint_is_relative():
    """Bodies that move as one do not slip."""
    rng = np.random.default_rng(6)
    poses, (along, turning), relative = rng.normal(size=(2, 3)), (np.array([0.4, -0.3]), 0.8), np.array([0.2, -0.1])
    part = planar.Friction("rub", "pin", coefficient=0.2, radius=0.05, point=POINT_B)
    sideways = lambda arm: np.array([-arm[1], arm[0]])
    velocities = np.stack([np.append(along + turning * sideways(pose[:2]), turning) for pose in poses])
    np.testing.assert_allclose(part.slip(PLANE, poses, velocities), 0.0, rtol=0, atol=1e-15)
    arm = turned_2d(poses[1, 2], POINT_B)
    velocities[1] += [*(relative - 1.7 * sideways(arm)), 1.7]
    np.testing.assert_allclose(part.slip(PLANE, poses, velocities), [*relative, 0.05 * 1.7], rtol=1e-12)


def test_deflection_of_a_tyre_decays_over_its_relaxation_length():
    laws = {"terrain": terrain.Flat(), "normal": contact.Linear(30.0), "radius": 0.5, "transition_speed": 0.2}
    grip = {"coefficient": 0.4, "slip_stiffness": 5.0, "relaxation_length": 0.3, "deflection": 0.1}
    pose = np.array([[1.0, 0.5, 0.3]])
    part = planar.Tyre("F", "a", **laws, **grip).resolve(PLANE, pose)
    # Rolling without slip at 2 m/s, then locked.
    moving = jnp.array([[[2.0, 0.0, -4.0]], [[2.0, 0.0, 0.0]]])
    rates = jax.jit(jax.vmap(lambda v: part.state_rates(PLANE, pose, v, 0.0)["deflection"]))(moving)
    speed = np.hypot(2.0, 0.2)
    np.testing.assert_allclose(np.ravel(rates), np.array([0.0, -2.0]) - speed / 0.3 * 0.1, rtol=1e-12)


@pytest.mark.slow
def test_spring_of_zero_length_damps_motions_about_it():
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


# What is refused


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
def test_body_that_is_refused(part, message):
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
def test_part_that_is_refused(part, message):
    with pytest.raises(ValueError, match=f"'J': .*{message}"):
        part.resolve(PLANE, np.zeros((len(part.bodies), 3)))


MOVES = {"motion": lambda t, p: p["speed"] * t, "parameters": {"speed": 3.0}}


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: planar.Driver("J", "a", "b", quantity="w", **MOVES), "quantity must be one of"),
        (
            lambda: planar.Driver("J", "a", "b", quantity="z", **MOVES).resolve(PLANE, np.zeros((2, 3))),
            "quantity='z' belongs to spatial scenes",
        ),
        (lambda: planar.PointForce("J", "a", force=X, frame="space"), "frame must be"),
    ],
)
def test_choice_that_is_refused(build, message):
    with pytest.raises(ValueError, match=f"'J': {message}"):
        build()
