"""The own coordinates of joints: in initial states, along motions, and their derivatives."""

import jax.numpy as jnp
import numpy as np
import pytest
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar, rotations, spatial

J = np.diag([0.01, 0.08, 0.07])


@pytest.fixture(scope="module")
def arm():
    """A hinge on the ground, then a universal joint; along x at the given poses."""
    rod = lambda name, x: spatial.Body(name, mass=1.0, inertia=J, position=(x, 0.0, 0.0))
    joints = [
        spatial.Revolute("hip", "ground", "thigh", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)),
        spatial.Universal(
            "knee", "thigh", "shank", point=(1.0, 0.0, 0.0), axis_a_W=(0.0, 1.0, 0.0), axis_b_W=(0.0, 0.0, 1.0)
        ),
    ]
    forces = [mb.Gravity((0.0, 0.0, -9.81))]
    return mb.Scene([rod("thigh", 0.5), rod("shank", 1.5)], joints=joints, forces=forces).compile()


def turn(axis, angle):
    return rotations.from_axis_angle(jnp.array(axis), angle)


@pytest.mark.slow
def test_joint_coordinates_give_attitudes(arm):
    hip, first, second = 0.7, 1.9, -2.4
    state = mb.assemble(arm, fix={"hip.angle": hip, "knee.angle_a": first, "knee.angle_b": second})
    thigh, shank = state.q[3:7], state.q[10:14]
    expected = turn((0.0, 1.0, 0.0), hip)
    np.testing.assert_allclose(jnp.abs(thigh @ expected), 1.0, rtol=0, atol=1e-14)
    relative = rotations.multiply(turn((0.0, 1.0, 0.0), first), turn((0.0, 0.0, 1.0), second))
    np.testing.assert_allclose(jnp.abs(shank @ rotations.multiply(expected, relative)), 1.0, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_joint_coordinates_along_a_motion_are_continuous_and_have_their_derivatives(arm):
    rates = {"hip.angle": 9.0, "knee.angle_a": 0.3, "knee.angle_b": 0.2}
    start = mb.assemble(arm, fix={"hip.angle": 0.1}, rates=rates)
    ts = np.linspace(0.0, 1.6, 1601)
    motion = mb.simulate(arm, start, t1=1.6, saveat=ts, rtol=1e-10)
    hip, knee = motion["hip"], motion["knee"]
    assert hip.angle[0] == pytest.approx(0.1, abs=1e-13) and np.ptp(hip.angle) > 2 * np.pi
    first = [hip.angle_rate[0], knee.angle_a_rate[0], knee.angle_b_rate[0]]
    np.testing.assert_allclose(first, list(rates.values()), rtol=0, atol=1e-12)
    for value, rate, scale in (
        (hip.angle, hip.angle_rate, 2e-3),
        (hip.angle_rate, hip.angle_acceleration, 2e-1),
        (knee.angle_a, knee.angle_a_rate, 2e-3),
        (knee.angle_b, knee.angle_b_rate, 2e-3),
    ):
        central = (np.asarray(value[2:]) - np.asarray(value[:-2])) / (ts[2:] - ts[:-2])
        np.testing.assert_allclose(central, rate[1:-1], rtol=0, atol=scale)
    # At fewer times, the same numbers.
    few = mb.simulate(arm, start, t1=1.6, saveat=ts[::20], rtol=1e-10)
    np.testing.assert_allclose(few["hip"].angle, hip.angle[::20], rtol=0, atol=1e-7)


@pytest.mark.slow
def test_joint_angles_two_full_turns_apart_are_one_position(arm):
    for angle in (np.pi + 0.01, 0.01 - np.pi, 0.01):
        one, other = (mb.assemble(arm, fix={"hip.angle": x}) for x in (angle, angle + 4 * np.pi))
        np.testing.assert_allclose(one.q, other.q, rtol=0, atol=1e-13)


def test_joint_angles_in_the_plane_count_turns():
    rod = planar.Body("rod", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    system = mb.Scene([rod], joints=[planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))]).compile()
    state = mb.assemble(system, fix={"pin.angle": 4 * np.pi + 0.3}, rates={"pin.angle": 2.0})
    assert state.q[2] == pytest.approx(4 * np.pi + 0.3, abs=1e-12) and state.u[2] == pytest.approx(2.0, abs=1e-12)


SHIFT, ANGLE, VECTOR = 0.3, 0.4, np.array([0.3, -0.5, 0.2])
AXIS = {"point": (0.0, 0.0, 0.0), "axis": (0.0, 0.0, 1.0)}
GIVEN = {
    "Cylindrical": (AXIS, {"angle": ANGLE, "displacement": SHIFT}),
    "Screw": (AXIS | {"pitch": 2 * np.pi * SHIFT / ANGLE}, {"angle": ANGLE}),
    "Prismatic": (AXIS, {"displacement": SHIFT}),
    "Planar": (AXIS, {"angle": ANGLE, "displacement": np.array([0.2, -0.1])}),
    "PointOnLine": (AXIS, {"displacement": SHIFT}),
    "Spherical": ({"point": (0.0, 0.0, 0.0)}, {"rotation": VECTOR}),
}


@pytest.mark.slow(but=("Spherical",))
@pytest.mark.parametrize("kind", GIVEN)
def test_joint_coordinates_give_the_position_of_each_joint(kind):
    options, values = GIVEN[kind]
    body = spatial.Body("body", mass=1.0, inertia=J)
    system = mb.Scene([body], joints=[getattr(spatial, kind)("joint", "ground", "body", **options)]).compile()
    state = mb.assemble(system, fix={f"joint.{name}": value for name, value in values.items()})
    position, attitude = np.array([0.0, 0.0, SHIFT]), np.array([1.0, 0.0, 0.0, 0.0])
    if "angle" in values:
        attitude = np.array([np.cos(ANGLE / 2), 0.0, 0.0, np.sin(ANGLE / 2)])
    if kind == "Spherical":
        size = np.linalg.norm(VECTOR)
        position, attitude = 0 * VECTOR, np.append(np.cos(size / 2), np.sin(size / 2) * VECTOR / size)
    if kind == "Planar":
        # Its directions are those that the compiled joint has.
        x = np.asarray(mb.parameters(system)["joint.x_a"])
        position = values["displacement"][0] * x + values["displacement"][1] * np.cross((0.0, 0.0, 1.0), x)
    np.testing.assert_allclose(state.q[:3], position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.abs(attitude @ np.asarray(state.q[3:])), 1.0, rtol=0, atol=1e-13)


def floating(*forces):
    sequence, axes = ("slide",) * 3 + ("hinge",) * 3, np.tile(np.eye(3), (2, 1))
    joint = spatial.Composite("root", "ground", "body", sequence=sequence, axes_W=axes, point=(0.0, 0.0, 0.0))
    return mb.Scene([spatial.Body("body", mass=1.0, inertia=J)], joints=[joint], forces=forces).compile()


def test_joint_that_leaves_all_motions_free_has_coordinates_and_no_reaction():
    system = floating()
    assert system.rows == () and system.velocity_rank == 0
    assert {"root.displacement_3", "root.angle_1"} < set(system.joint_coordinates())
    assert "Composite  root  0 rows each, which have coordinates only" in str(system)
    rubs = spatial.Friction("rub", "root", coefficient=0.1, radius=0.1, transition_speed=0.1)
    with pytest.raises(ValueError, match="'rub' acts in Composite 'root', which leaves all motions free"):
        floating(rubs)


@pytest.mark.slow
def test_joint_that_leaves_all_motions_free_gives_a_state():
    system = floating()
    place = {"root.displacement_2": 0.4, "root.angle_1": 0.3, "root.angle_2": -0.5, "root.angle_3": 2.0}
    state = mb.assemble(system, fix=place, rates={"root.displacement_3": 0.7})
    np.testing.assert_allclose(state.q[:3], [0.0, 0.4, 0.0], rtol=0, atol=1e-13)
    turns = [turn(axis, place[f"root.angle_{k}"]) for k, axis in enumerate(np.eye(3), 1)]
    attitude = rotations.multiply(turns[0], rotations.multiply(turns[1], turns[2]))
    np.testing.assert_allclose(jnp.abs(attitude @ state.q[3:]), 1.0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(state.u[:3], [0.0, 0.0, 0.7], rtol=0, atol=1e-13)


def test_joint_coordinates_that_are_not_there_are_refused(arm):
    for options, message in (
        ({"fix": {"hip.angel": 0.3}}, "did you mean 'hip.angle'"),
        ({"fix": {"hip.angle": [0.3, 0.1]}}, "Coordinate 'hip.angle'"),
        ({"rates": {"knee.angle": 0.3}}, "'knee.angle'"),
        ({"rates": {"knee.angle_a": "fast"}}, "Rate 'knee.angle_a'"),
    ):
        with pytest.raises(ValueError, match=message):
            mb.assemble(arm, **options)
    motion = motion_of(arm, [0.0], np.asarray(arm.guess.q)[None], np.zeros((1, 12)))
    with pytest.raises(AttributeError, match="'knee' has angle_a, angle_a_acceleration"):
        _ = motion["knee"].angle
    with pytest.raises(ValueError, match="Unknown body, joint or frame 'hips'"):
        _ = motion["hips"]
