"""Springs, forces and prescribed motions of the own coordinates of joints."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts.planar.kinematics import PLANE
from jaxmb.parts.spatial.kinematics import SPACE

MOST_PROGRAMS = 100

J = np.diag([0.02, 0.09, 0.07])


def pendulums(*parts, joints=()):
    """Two rods in the plane on pins, along x at the given poses."""
    rod = lambda name, x: planar.Body(name, mass=1.0, inertia=0.1, position=(x, 0.0))
    pins = [
        planar.Revolute("hip", "ground", "thigh", point=(0.0, 0.0)),
        planar.Revolute("knee", "thigh", "shank", point=(1.0, 0.0)),
    ]
    forces = [mb.Gravity((0.0, -9.81)), *parts]
    return mb.Scene([rod("thigh", 0.5), rod("shank", 1.5)], joints=[*joints, *pins], forces=forces).compile()


def hinged(*parts, joints=()):
    """A body on a hinge about y, and one on a slide along it."""
    bodies = [spatial.Body("arm", mass=1.0, inertia=J, position=(0.5, 0.0, 0.0)), spatial.PointMass("bead", mass=0.3)]
    own = [
        spatial.Revolute("hip", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)),
        spatial.PointOnLine("slide", "ground", "bead", point=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0)),
    ]
    return mb.Scene(bodies, joints=[*joints, *own], forces=[mb.Gravity((0.0, 0.0, -9.81)), *parts]).compile()


@jax.jit
def forces_of(system, q, u):
    return system.force(jnp.zeros(()), q, u), system.potential_energy(0.0, q)


def test_parts_of_an_angle_are_torsional_springs_in_the_plane():
    """A spring, and a servo of the position, which has no energy."""
    spring = mb.JointSpring("spring", "knee.angle", stiffness=12.0, damping=1.6, free=0.1)
    numbers = {"stiffness": 12.0, "damping": 1.6, "free_angle": 0.1}
    servo = mb.Actuator("servo", "knee.angle", control=0.2, gear=2.0, gain=(3.0, 0.0, 0.0), bias=(0.0, -3.0, -0.4))
    others = [planar.TorsionalSpringDamper("spring", "thigh", "shank", **numbers), spring, servo]
    systems = [pendulums(part) for part in others]
    q, u = np.random.default_rng(0).normal(size=(2, 6))
    (expected, energy), own, actuated = (forces_of(system, q, u) for system in systems)
    np.testing.assert_allclose(own[0], expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(own[1], energy, rtol=0, atol=1e-12)
    np.testing.assert_allclose(actuated[0], expected, rtol=0, atol=1e-12)
    assert {"spring.stiffness", "spring.damping", "spring.free"} < set(mb.parameters(systems[1]))
    assert not any(name.startswith("spring.joint") for name in mb.parameters(systems[1]))


@pytest.mark.slow
def test_a_spring_of_an_angle_in_space_has_a_moment_about_the_axis():
    system = hinged(mb.JointSpring("spring", "hip.angle", stiffness=3.0, damping=0.4, free=-0.3))
    free = hinged()
    for angle, rate in ((0.4, 1.0), (-1.9, -2.0), (2.5, 0.3)):
        state = mb.assemble(system, fix={"hip.angle": angle}, rates={"hip.angle": rate})
        found = forces_of(system, state.q, state.u)[0] - forces_of(free, state.q, state.u)[0]
        expected = np.zeros_like(found)
        expected[4] = -3.0 * (angle + 0.3) - 0.4 * rate
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_springs_on_many_joints_are_one_group():
    springs = [mb.JointSpring(f"spring {j}", f"{j}.angle", stiffness=k) for j, k in (("hip", 1.0), ("knee", 2.0))]
    system = pendulums(*springs)
    assert len(system.forces.groups) == 1 and mb.parameters(system)["spring knee.stiffness"] == 2.0


def test_a_change_of_the_joint_reaches_its_spring():
    """The axis that the spring of a displacement acts along is that of the joint."""
    push = mb.JointForce("push", "hip.angle", force=0.7)
    system = hinged(mb.JointSpring("spring", "slide.displacement", stiffness=2.0, free=0.0), push)
    turned = mb.with_parameters(system, {"slide.axis_a": (0.0, 0.0, 1.0)})
    q = np.append(system.guess.q[:7], [0.3, 0.0, 0.5])
    after, before = (np.asarray(forces_of(own, q, np.zeros(9))[0]) for own in (turned, system))
    np.testing.assert_allclose((after - before)[6:], [0.6, 0.0, -1.0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(before[3:6], [0.0, 0.7, 0.0], rtol=0, atol=1e-14)


@pytest.mark.slow
def test_a_driven_joint_may_stand_before_the_joint_it_drives():
    drive = mb.JointDriver("drive", "knee.angle", rate=1.5)
    system = pendulums(joints=[drive])
    start = mb.assemble(system)
    motion = mb.simulate(system, start, t1=0.8, saveat=np.linspace(0.0, 0.8, 5))
    np.testing.assert_allclose(motion["knee"].angle, 1.5 * motion.ts, rtol=0, atol=1e-12)
    np.testing.assert_allclose(motion["knee"].angle_rate, 1.5, rtol=0, atol=1e-12)
    # It is listed last, after the joints that it may drive.
    assert system.rows[-1] == ("drive", 0)


@pytest.mark.slow
def test_a_hinge_that_is_driven_through_two_turns_in_space():
    system = hinged(joints=[mb.JointDriver("drive", "hip.angle", value=0.1, rate=8.0)])
    motion = mb.simulate(system, mb.assemble(system), t1=1.7, saveat=np.linspace(0.0, 1.7, 35))
    np.testing.assert_allclose(motion["hip"].angle, 0.1 + 8.0 * motion.ts, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_turns_are_counted_beside_joints_of_elements():
    """The derivatives of all rows by the coordinates, of the count of turns as well."""
    system = hinged(joints=[mb.FixedTendon("cord", "hip.angle", coefficients=(0.3,))])
    q = np.append(system.guess.q[:3], [np.cos(0.35), 0.0, np.sin(0.35), 0.0, *system.guess.q[7:]])
    q[-1] = 0.21
    expected, found = jax.jit(
        lambda q: (
            jax.jacfwd(lambda q: system.coordinate_residual(0.0, q))(q),
            system.prepared().coordinate_jacobian(0.0, q),
        )
    )(q)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def spring(coordinate, stiffness=1.0, **options):
    return mb.JointSpring("s", coordinate, stiffness=stiffness, **options)


ROD, WELD = planar.Body("rod", mass=1.0, inertia=0.1), planar.Fixed("weld", "ground", "rod", point=(0.0, 0.0))
TWICE = [("thigh", (0.2, 0.0)), ("thigh", (0.2, 0.0)), ("shank", (0.0, 0.1))]
MEET = [("ground", (0.0, 1.0)), ("thigh", (0.5, 0.1)), ("shank", (-0.5, 0.1))]
NO_ANGLE = "middle belongs to an angle in space, which '{}' is not; leave it out"
REFUSED = {
    "no joint": (lambda: pendulums(spring("hop.angle")), "JointSpring 's': Unknown joint 'hop'"),
    "no coordinate": (lambda: pendulums(spring("hip.angel")), "JointSpring 's': Unknown coordinate 'hip.angel'"),
    "stiffness": (lambda: pendulums(spring("hip.angle", -1.0)), "stiffness must be non-negative"),
    "two forces": (
        lambda: pendulums(mb.JointForce("s", "hip.angle", force=[1.0, 2.0])),
        r"force must have the shape of 'hip.angle', \(\)",
    ),
    "a joint": (lambda: pendulums(mb.JointForce("s", "hip", force=1.0)), "Unknown coordinate 'hip'"),
    "middle in the plane": (lambda: pendulums(spring("hip.angle", middle=1.0)), NO_ANGLE.format("hip.angle")),
    "middle of an actuator in the plane": (
        lambda: pendulums(mb.Actuator("s", "hip.angle", middle=1.0)),
        NO_ANGLE.format("hip.angle"),
    ),
    "middle of a slide": (
        lambda: hinged(spring("slide.displacement", middle=0.5)),
        NO_ANGLE.format(r"slide\.displacement"),
    ),
    "middle of an actuator of a slide": (
        lambda: hinged(mb.Actuator("s", "slide.displacement", middle=0.5)),
        NO_ANGLE.format(r"slide\.displacement"),
    ),
    "one point": (
        lambda: pendulums(joints=[mb.Tendon("cord", TWICE)]),
        r"'cord': the neighbours path\[0\] and path\[1\] coincide at the given poses",
    ),
    "two points at one place": (
        lambda: pendulums(joints=[mb.Tendon("cord", MEET)]),
        r"'cord': the neighbours path\[1\] and path\[2\] coincide at the given poses",
    ),
    "a stop without ends": (lambda: pendulums(joints=[mb.Stop("s", "hip.angle")]), "give lower, upper or both"),
    "a stop without range": (
        lambda: pendulums(joints=[mb.Stop("s", "hip.angle", lower=1.0, upper=-1.0)]),
        "lower must be less than upper, got 1.0 and -1.0",
    ),
    "a stop that gives more back": (
        lambda: pendulums(joints=[mb.Stop("s", "hip.angle", lower=0.0, restitution=1.5)]),
        "restitution must lie between 0 and 1, got 1.5",
    ),
    "a stop that draws": (
        lambda: pendulums(joints=[mb.Stop("s", "hip.angle", lower=0.0, restitution=-0.5)]),
        "restitution must be non-negative",
    ),
    "one stop of an angle in space": (
        lambda: hinged(joints=[mb.Stop("s", "hip.angle", lower=-1.0)]),
        "an angle in space is known up to full turns; give lower and upper of its range",
    ),
    "stops of more than a turn in space": (
        lambda: hinged(joints=[mb.Stop("s", "hip.angle", lower=-4.0, upper=4.0)]),
        "must be less than a full turn, got -4.0 to 4.0",
    ),
    "a weld": (
        lambda: mb.Scene([ROD], joints=[WELD], forces=[mb.JointForce("f", "weld.angle", force=1.0)]).compile(),
        "Fixed 'weld' has no coordinate",
    ),
}


@pytest.mark.parametrize("build, message", REFUSED.values(), ids=REFUSED)
def test_parts_of_joints_that_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_middle_is_that_of_an_angle_in_space():
    hinged(spring("hip.angle", middle=0.5))


def on_one_axis(names, *joints):
    """Wheels that turn about the vertical axis, and further joints."""
    wheels = [spatial.Body(name, mass=1.0, inertia=(0.1, 0.1, 0.2)) for name in names]
    hinge = {"point": (0.0, 0.0, 0.0), "axis": (0.0, 0.0, 1.0)}
    axles = [spatial.Revolute(f"{name} axle", "ground", name, **hinge) for name in names]
    return mb.Scene(wheels, joints=[*axles, *joints]).compile()


def test_row_of_a_coupling_is_its_polynomials():
    pins = [planar.Revolute(name, "ground", name, point_a=(0.0, 0.0), point_b=(0.0, 0.0)) for name in "xyz"]
    powers, zeros = np.array([[0.4, 0.5, -0.3, 0.7], [0.1, -0.2, 0.6, 0.0]]), np.array([0.2, -0.3])
    numbers = {"coefficients": powers, "zero": 0.15, "other_zero": zeros}
    part = mb.JointCoupling("couple", "x.angle", ("y.angle", "z.angle"), **numbers)
    part = part.of_sources(pins, [(0, 1), (0, 2), (0, 3)])
    poses = np.zeros((4, 3))
    poses[:, 2] = 0.0, 0.9, 1.4, -0.8
    expected = 0.9 - 0.15 - np.polyval(powers[0, ::-1], 1.4 - 0.2) - np.polyval(powers[1, ::-1], 0.3 - 0.8)
    found = jax.jit(lambda q: part.residual(PLANE, q, 0.0))(poses)
    np.testing.assert_allclose(found, [expected], rtol=0, atol=1e-14)


def test_length_of_a_tendon_goes_on_over_full_turns():
    """The scalar coordinates count the turns, and the hinges give the angles within them."""
    turns, axis, count = np.array([7.0, -3.5]), np.array([0.0, 0.6, 0.8]), np.array([7.2, -3.3])
    numbers = {"axis_a": axis, "axis_b": axis, "x_a": (1.0, 0.0, 0.0), "x_b": (1.0, 0.0, 0.0)}
    still = {"point_a": np.zeros(3), "point_b": np.zeros(3)}
    hinges = [spatial.Revolute(name, "ground", name, **numbers, **still) for name in "ab"]
    part = mb.FixedTendon("cord", ("a.angle", "b.angle"), coefficients=(0.3, -0.2))
    part = part.of_sources(hinges, [(0, 1), (0, 2)])
    poses = np.zeros((5, 7))
    poses[0, 3] = 1.0
    poses[1:3, 3], poses[1:3, 4:] = np.cos(turns / 2), np.sin(turns / 2)[:, None] * axis
    poses[3:, 0] = count
    length, rows = jax.jit(lambda q: (part.length(SPACE, q), part.residual(SPACE, q, 0.0)))(poses)
    np.testing.assert_allclose(length, 0.3 * 7.0 - 0.2 * -3.5, rtol=1e-13)
    np.testing.assert_allclose(rows, count - turns, rtol=0, atol=1e-13)


def test_couplings_that_jump_at_half_a_turn_are_named():
    couple = lambda name, *coefficients: mb.JointCoupling(
        f"to {name}", f"{name} axle.angle", "a axle.angle", coefficients=coefficients
    )
    numbers = {"b": (0.0, 1.5), "c": (0.0, -2.0), "d": (0.1, 0.0, 0.3), "e": (0.2,)}
    system = on_one_axis("abcde", *(couple(name, *given) for name, given in numbers.items()))

    def said(angle):
        q = np.array(system.guess.q)
        q[system.coordinate_names()["a.orientation"]] = np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)
        return [text.split(" jumps where ")[0] for text in system.catalogue.jumps_of_rows(0.0, jnp.asarray(q))]

    assert said(np.pi - 1e-4) == said(1e-4 - np.pi) == ["JointCoupling 'to b'", "JointCoupling 'to d'"]
    assert said(3.0) == []


@pytest.mark.slow
def test_a_gear_of_any_ratio_turns_without_end_along_a_tendon():
    turns = mb.FixedTendon("turns", ("a axle.angle",), coefficients=(1.0,))
    gear = mb.JointCoupling("gear", "b axle.angle", "turns.length", coefficients=(0.0, 2.5))
    system = on_one_axis("ab", turns, gear)
    motion = mb.simulate(system, mb.assemble(system, rates={"a axle.angle": 4.0}), t1=5.0, saveat=[2.0, 5.0])
    np.testing.assert_allclose(motion["b axle"].angle, 10.0 * np.array([2.0, 5.0]), rtol=1e-7)
    np.testing.assert_allclose(motion.quantity("turns.length"), 4.0 * np.array([2.0, 5.0]), rtol=1e-7)
