"""Laws of parts without a machine: as written by hand, as in a motion, with derivatives, and wrong arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_part import TYRE_FILE
from trajectories import motion_of

import jaxmb as mb
from jaxmb import contact, planar, spatial, terrain
from jaxmb.bodies.units import named
from jaxmb.parts import magic_formula
from jaxmb.parts.planar.kinematics import PLANE

ANGLE, RATE, FLAT = 0.4, 1.3, terrain.Flat()
ON_ANGLE = {
    "spring": mb.JointSpring("spring", "pin.angle", stiffness=20.0, damping=0.5, free=0.1),
    "force": mb.JointForce("force", "pin.angle", force=3.0),
    "stop": mb.JointStop("stop", "pin.angle", lower=-0.5, upper=0.3, stiffness=100.0, exponent=1.5, damping=2.0),
    "friction": mb.JointFriction("friction", "pin.angle", force=0.7, transition_speed=0.5),
    "table spring": mb.TableSpring("table spring", "pin.angle", values=(-1.0, 0.0, 0.3, 1.0), forces=(-9.0, 0, 1, 8)),
    "table damper": mb.TableDamper("table damper", "pin.angle", rates=(-1.0, 0.0, 1.0, 3.0), forces=(-2.0, 0, 1, 5)),
    "table motor": mb.TableMotor(
        "table motor", "pin.angle", speeds=(0.0, 10.0, 30.0), torques=(0.8, 0.7, 0.1), control=-0.6, gear=8.0
    ),
    "actuator": mb.Actuator("actuator", "pin.angle", control=0.9, gain=(5, 1, 0), bias=(0, -4, -2), gear=1.5),
}
GROUND = {"normal": contact.Hertz(1e6), "damping": 300.0, "radius": 0.3, "smoothing": 1e-4, "terrain": FLAT}
GRIP = {"coefficient": 0.9, "slip_stiffness": 15.0, "relaxation_length": 0.2}


def tyre(**changes):
    return planar.Tyre("tyre", "wheel", **(GROUND | GRIP | changes))


# By hand


def test_curves_by_hand():
    spring, springs = ON_ANGLE["spring"], np.linspace(-1.0, 1.0, 5)
    np.testing.assert_allclose(
        spring.curve(springs, rate=[[0.0], [2.0]]), [-20 * (springs - 0.1), -20 * (springs - 0.1) - 1.0]
    )
    line = planar.SpringDamper("line", "ground", "bar", stiffness=30.0, damping=2.0, free_length=0.5)
    np.testing.assert_allclose(line.curve([0.5, 0.7], rate=0.1), [0.2, 6.2])
    motor = mb.Motor("motor", "pin.angle", mode="speed", command=10.0, gain=2.0, lag=0.05, limit=15.0)
    np.testing.assert_allclose(motor.curve(rate=[0.0, 10.0]), [15 * np.tanh(20 / 15), 0.0])
    assert ON_ANGLE["friction"].curve(rate=0.5) == pytest.approx(-0.7 * np.tanh(1.0))
    held = mb.Motor("motor", "pin.angle", mode="position", command=0.2, gain=4.0, damping=0.5, lag=0.05)
    np.testing.assert_allclose(held.curve([0.7, 0.7, 0.2], rate=[0.0, 2.0, -3.0]), [-2.0, -3.0, 1.5])
    servo = mb.Actuator("servo", "pin.angle", bias=(0.0, -10.0, 0.0), force_range=(-2.0, 3.0))
    np.testing.assert_allclose(servo.curve([-1.0, 0.1, 1.0]), [3.0, -1.0, -2.0])


def test_activation_follows_the_control_by_hand():
    """At the rate of its distance from the control over the lag; the control is that within its range."""
    numbers = {"control": np.array(1.6), "control_range": np.array([-1.0, 1.0]), "activation": np.array(0.2)}
    servo = mb.Actuator("servo", "pin.angle", lag=0.05, **numbers)
    assert float(servo.state_rates(PLANE, None, None, 0.0)["activation"]) == pytest.approx((1.0 - 0.2) / 0.05)


def test_a_progressive_stop_by_hand():
    """Its force at either end, and its energy, whose slope is the force."""
    width, stiffness, exponent, at = 0.1, 100.0, 1.5, np.array([-0.9, -0.45, 0.1, 0.32, 0.5])
    limits = {"lower": -0.5, "upper": 0.3, "stiffness": stiffness, "exponent": exponent, "smoothing": width}
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(0.0, 0.0))
    stop = mb.JointStop("stop", "pin.angle", **limits).of_sources([pin], [(0, 1)])
    beyond = np.stack([-0.5 - at, at - 0.3])
    depths = 0.5 * (beyond + np.hypot(beyond, width))
    slopes = 0.5 * (1 + beyond / np.hypot(beyond, width))
    np.testing.assert_allclose(stop.curve(at), np.array([1, -1]) @ (stiffness * depths**exponent * slopes), rtol=1e-12)
    poses = np.zeros((5, 2, 3))
    poses[:, 1, 2] = at
    found = jax.jit(jax.vmap(lambda q: (stop.energy(PLANE, q, 0.0), stop.gaps(PLANE, q, 0.0))))(poses)
    np.testing.assert_allclose(found[0], np.sum(stiffness * depths**2.5 / 2.5, axis=0), rtol=1e-12)
    np.testing.assert_allclose(found[1], -beyond.T, rtol=0, atol=1e-14)


def test_steady_forces_of_a_tyre_by_hand():
    load, ratio, angle = 4e3, np.array([0.0, 0.05, 0.3]), np.array([[0.0], [0.1], [-0.2]])
    forces = tyre().forces(load=load, slip_ratio=ratio, slip_angle=angle)
    slips = np.stack(np.broadcast_arrays(ratio, -np.tan(angle)))
    size = np.maximum(np.linalg.norm(15 * slips / 0.9, axis=0), 1e-300)
    known = 0.9 * load * np.tanh(size) * 15 * slips / 0.9 / size
    np.testing.assert_allclose([forces.fx, forces.fy], known, rtol=1e-12, atol=1e-9)
    assert forces.mz.shape == (3, 3) and not np.any(forces.mz)
    # One direction, and another grip sideways.
    sideways = tyre(slip_stiffness=(15.0, 10.0)).forces(load=load, slip_angle=1e-6)
    assert sideways.fy == pytest.approx(-10.0 * load * 1e-6)


def test_forces_of_a_contact_by_hand():
    ground = planar.Contact("road", "wheel", friction=contact.Coulomb(0.8, transition_speed=0.1), **GROUND)
    depth = np.array([-0.02, 0.0, 0.02])
    forces = ground.forces(depth=depth, rate=0.05, slip=[[0.02], [-3.0]])
    root = np.sqrt(depth**2 + 1e-8)
    smooth = (depth + root) / 2
    step = np.clip(smooth / 0.01, 0, 1)
    step = step**3 * (10 + step * (6 * step - 15))
    normal = 1e6 * smooth**1.5 * (1 + depth / root) / 2 + 300 * step * 0.05
    np.testing.assert_allclose(forces.normal, np.stack([normal, normal]), rtol=1e-7)
    load = 1e6 * smooth**1.5 * smooth**2 / (smooth**2 + 0.25e-8) + 300 * step * 0.05
    np.testing.assert_allclose(forces.friction[1], 0.8 * load, rtol=2e-2)
    # A body that leaves the ground is not pulled, and one without friction slips.
    assert ground.forces(depth=0.02, rate=-1e3).normal == 0
    smooth_ground = planar.Contact("road", "wheel", **GROUND)
    assert smooth_ground.forces(depth=0.02, slip=1.0).friction == 0


def test_wrong_arguments():
    for call, message in (
        (lambda: mb.JointSpring("spring", "pin.angle", stiffness=1.0).curve(0.0), "JointSpring 'spring': give free"),
        (lambda: ON_ANGLE["spring"].curve("much"), "JointSpring 'spring': value must be an array of real numbers"),
        (lambda: ON_ANGLE["spring"].curve([0.0, 1.0], [1.0, 2.0, 3.0]), r"value \(2,\), rate \(3,\)"),
        (lambda: tyre().forces(load=np.nan), "Tyre 'tyre': load must not be NaN"),
        (lambda: planar.SpringDamper("line", "a", "b", stiffness=1.0).curve(1.0), "give free_length"),
        (lambda: planar.TorsionalSpringDamper("coil", "a", "b", stiffness=1.0).curve(1.0), "give free_angle"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


# As in a motion


@pytest.mark.slow(but=("friction",))
@pytest.mark.parametrize("name", ON_ANGLE)
def test_laws_along_a_coordinate_are_those_of_a_motion(name):
    part = ON_ANGLE[name]
    bar = planar.Body("bar", mass=1.0, inertia=0.1)
    system = mb.Scene(
        [bar], joints=[planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))], forces=[part]
    ).compile()
    state = mb.State(jnp.array([0.0, 0.0, ANGLE]), jnp.array([0.0, 0.0, RATE]))
    wrench = mb.evaluate(system, state, name)[-1]
    assert float(part.curve(ANGLE, RATE)) == pytest.approx(float(wrench[2]), rel=1e-13)


@pytest.mark.slow
def test_forces_of_a_contact_are_those_of_a_motion():
    for friction in (
        contact.Coulomb(0.8, transition_speed=0.1),
        contact.Janosi(
            cohesion=1e3, friction_angle=0.5, shear_modulus=0.02, length=0.2, area=0.02, transition_speed=0.1
        ),
    ):
        ground = planar.Contact("road", "wheel", friction=friction, **GROUND)
        wheel = planar.Body("wheel", mass=10.0, inertia=0.5)
        system = mb.Scene([wheel], forces=[ground]).compile()
        for sinking, travel, spin in ((0.1, 2.0, -9.0), (-5.0, 2.0, -5.0)):
            state = mb.State(jnp.array([0.0, 0.295, 0.0]), jnp.array([travel, -sinking, spin]))
            wrench = mb.evaluate(system, state, "road")[0]
            forces = ground.forces(depth=0.005, rate=sinking, slip=travel + 0.3 * spin, travel=travel)
            np.testing.assert_allclose([forces.friction, forces.normal], wrench[:2], rtol=1e-10, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["brush", "magic formula, right"])
def test_forces_of_a_tyre_are_those_of_a_motion(kind):
    """A wheel that rolls steadily, with the deflection of steady slip."""
    speed, ratio, angle = 15.0, 0.04, 0.07
    if kind == "brush":
        part = tyre(terrain=FLAT, transition_speed=1e-7, damping=0.0)
        lengths = lambda load: 0.2 * jnp.ones(2)
    else:
        file = TYRE_FILE
        side = "right" if "right" in kind else None
        part = spatial.MagicFormulaTyre("tyre", "wheel", file, terrain=FLAT, side=side, transition_speed=1e-7)
        lengths = lambda load: magic_formula.Point(
            "6.1", part.coefficients, load, 0.0, part.pressure
        ).relaxation_lengths()
    wheel = spatial.Body("wheel", mass=10.0, inertia=(0.5, 0.9, 0.5))
    system = mb.Scene([wheel], forces=[part]).compile()
    height = part.radius - 0.01
    q = jnp.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0])
    u = jnp.array([speed, speed * np.tan(angle), 0.0, 0.0, speed * (1 + ratio) / height, 0.0])
    load = float(mb.evaluate(system, mb.State(q, u, jnp.zeros(2)), "tyre")[0, 2])
    deflection = lengths(load) * jnp.array([ratio, -np.tan(angle)])
    wrench = mb.evaluate(system, mb.State(q, u, deflection), "tyre")[0]
    forces = part.forces(load=load, slip_ratio=ratio, slip_angle=angle, speed=speed)
    np.testing.assert_allclose([forces.fx, forces.fy], wrench[:2], rtol=1e-6)
    if kind != "brush":
        np.testing.assert_allclose(forces.mz, wrench[5], rtol=1e-6)


def test_tension_of_a_spring_is_the_force_that_it_exerts():
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    own = {"stiffness": 30.0, "damping": 2.0, "free_length": 0.5}
    line = planar.SpringDamper("line", "ground", "bar", point_a=(0.0, 1.0), point_b=(0.5, 0.0), **own)
    system = mb.Scene([bar], joints=[pin], forces=[line, mb.Gravity((0.0, -9.81))]).compile()
    angle, rate = np.array([0.0, -0.3, 0.5]), np.array([0.0, -2.0, 1.0])
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    moves = rate[:, None] * np.stack([-0.5 * along[:, 1], 0.5 * along[:, 0], np.ones(3)], axis=1)
    motion = motion_of(system, np.arange(3.0), np.column_stack([0.5 * along, angle]), moves)
    np.testing.assert_allclose(motion["line"].length, np.linalg.norm(along - [0.0, 1.0], axis=1), rtol=1e-12)
    forces = np.linalg.norm(motion.forces["line"][:, 1, :2], axis=1)
    np.testing.assert_allclose(np.abs(motion["line"].tension), forces, rtol=1e-12)
    assert named(system, "line.tension").unit == "N"
