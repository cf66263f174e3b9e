"""What a user reads after a slip: the nearest names, what an object has, and which values depend on each other."""

import dataclasses
import math
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trajectories import motion_of

import jaxmb as mb
from jaxmb import planar
from jaxmb.lagrangian import LagrangianSystem
from jaxmb.parts import AbstractForce, fields


def rod(**changes):
    return planar.Body("rod", **({"mass": 1.0, "inertia": 0.1} | changes))


def pinned():
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    forces = [mb.Gravity((0.0, -9.81)), planar.Torque("motor", "rod", torque=0.0)]
    return mb.Scene([rod(position=(0.5, 0.0), angle=0.0)], joints=[pin], forces=forces)


@pytest.fixture(scope="module")
def pendulum():
    return pinned().compile()


@pytest.fixture(scope="module")
def motion(pendulum):
    return motion_of(pendulum, [0.0], pendulum.guess.q[None], pendulum.guess.u[None])


def gust(poses, velocities, t, parameters):
    return jnp.array([[math.sin(t), 0.0, 0.0]])


class Learned(AbstractForce):
    """A moment [N m] from a neural network of the body's velocity."""

    name: str = fields.name()
    body: str = fields.body_name()
    network: Any

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros((1, 3)).at[0, 2].add(self.network(velocities[0])[0])


def learned():
    network = eqx.nn.MLP(3, 1, 4, 1, key=jax.random.key(0))
    return mb.Scene([rod()], forces=[Learned("net", "rod", network)]).compile()


def moved(where):
    """A scene of a number that JAX traces."""

    def at(x):
        number = x if where == "mass" else (x, 0.0)
        return mb.Scene([rod(**{where: number})]).compile().guess.q[0]

    return lambda system: jax.grad(at)(0.5)


wind = mb.Force("wind", "bob", gust)
BOB, POINT = planar.Body("bob", mass=1.0, inertia=0.1), planar.PointMass("bob", mass=1.0)
HERE = r"test_messages\.py:\d+: `.*` "
# Numbers, names and arguments that functions and parts do not get or take.
SLIPS = {
    "number: NumPy": (
        lambda system: mb.with_inputs(system, {"pin.point_a": lambda t: np.array([np.sin(t), 0.0])}),
        r"`.*np\.sin\(t\).*` needs the time as a number, and the input 'pin\.point_a' is traced by JAX: .*Use jnp",
    ),
    "number: branch": (
        lambda system: mb.with_inputs(system, {"rod.mass": lambda t: 1.0 if t > 0.5 else 2.0}),
        "needs the time as a number",
    ),
    "number: design": (
        lambda system: mb.design(system, {"length": 1.0}, lambda v: {"rod.inertia": float(v["length"])}),
        "needs a design variable as a number, and derive",
    ),
    "number: optimise": (
        lambda system: mb.optimise(lambda v: np.sin(v["x"]), {"x": 1.0}),
        "a parameter.* the function of optimise",
    ),
    "number: Force": (
        lambda system: mb.Scene([BOB], forces=[wind]).compile(),
        r"test_messages\.py:\d+: `return .*math\.sin\(t\).*` needs an argument .*wrenches of Force 'wind'",
    ),
    "number: Force on a point": (
        lambda system: mb.Scene([POINT], forces=[wind]).compile(),
        "needs an argument as a number, and Force 'wind'",
    ),
    "number: LagrangianSystem": (
        lambda system: LagrangianSystem(lambda t, q, v, p: 0.5 * np.dot(v, v), q=[1.0]),
        r"`.*np\.dot\(v, v\).*` needs an argument as a number, and lagrangian is traced",
    ),
    "name: optimise": (
        lambda system: mb.optimise(lambda v: v["y"], {"x": 3.0}),
        f"{HERE}asks for 'y', which the function of optimise does not get; v has 'x'",
    ),
    "name: LagrangianSystem": (
        lambda system: LagrangianSystem(
            kinetic=lambda t, q, v, p: v @ v,
            potential=lambda t, q, p: p["g"] * q[0],
            q=[1.0],
            parameters={"G": 9.81},
        ),
        f"{HERE}asks for 'g', which potential does not get; p has 'G'",
    ),
    "name: Driver": (
        lambda system: mb.Scene(
            [BOB], joints=[planar.Driver("d", "ground", "bob", quantity="angle", motion=lambda t, p: p["w"] * t)]
        ).compile(),
        f"{HERE}asks for 'w', which residual of Driver 'd' does not get; p has no names",
    ),
    "name: Force on a point": (
        lambda system: mb.Scene(
            [POINT], forces=[mb.Force("wind", "bob", lambda x, v, t, p: -p["c"] * v, parameters={"d": 1.0})]
        ).compile(),
        f"{HERE}asks for 'c', which Force 'wind' does not get; p has 'd'",
    ),
    "name within a function": (
        lambda system: mb.design(
            system, {"m": 1.0}, lambda v: dict(mb.parameters(mb.with_parameters(system, {"rod.mas": v["m"]})))
        ),
        r"^Unknown parameter 'rod\.mas'; did you mean 'rod\.mass'",
    ),
    "coordinate of a body": (
        lambda system: mb.assemble(system, fix={"rod.phi": 0.3}),
        r"'rod' has 'rod\.x', 'rod\.y', 'rod\.angle'",
    ),
    "part in place of its numbers": (
        lambda system: mb.with_inputs(system, {"pin": lambda t: t}),
        r"Unknown parameter 'pin'; 'pin' has 'pin\.point_a', 'pin\.point_b'",
    ),
    "body in place of a joint": (
        lambda system: pinned().extended(forces=[mb.JointSpring("spring", "rod.angle", stiffness=1.0)]).compile(),
        r"JointSpring 'spring': 'rod' is not a joint; the part acts on joints.*'pin'",
    ),
    "traced mass": (moved("mass"), r"Body 'rod' has a number that JAX traces.*jaxmb\.with_parameters"),
    "traced position": (moved("position"), r"Body 'rod' has a number that JAX traces.*jaxmb\.with_parameters"),
    "module in a field": (lambda system: learned(), r"Learned 'net': network\.activation is .*fields\.module\(\)"),
    **{
        f"{name} is a rate": (
            lambda system, name=name: mb.assemble(system, fix={name: 1.0}),
            rf"'{name}' is a rate, .* assemble takes it as rates=\{{'{rate}': …\}}",
        )
        for name, rate in (
            ("rod.angle_rate", "rod.angle"),
            ("pin.angle_rate", "pin.angle"),
            ("rod.velocity", "rod.velocity"),
        )
    },
    "servo of a driver of a coordinate": (
        lambda system: mb.Servo(mb.JointDriver("drive", "pin.angle", rate=1.0)),
        "Servo 'drive': the program must be a constraint between bodies",
    ),
    "servo of a coupling": (
        lambda system: mb.Servo(mb.JointCoupling("drive", "pin.angle", "hip.angle", coefficients=(0.0, 1.0))),
        "Servo 'drive': the program must be a constraint between bodies",
    ),
    "argument of a part": (
        lambda system: planar.SpringDamper("spring", "ground", "rod", k=3.0),  # pyright: ignore
        "SpringDamper has no argument 'k'; it takes .*stiffness, damping",
    ),
    "argument with a letter less": (
        lambda system: planar.SpringDamper("spring", "ground", "rod", stifness=3.0),  # pyright: ignore
        "did you mean 'stiffness'",
    ),
    "arguments of a part by position": (
        lambda system: planar.Revolute("pin", "ground", "rod", (0.0, 0.0), (1.0, 0.0)),  # pyright: ignore
        r"Revolute takes 3 arguments by position.*give by name: point_a, point_b",
    ),
    "joints of a scene by position": (
        lambda system: mb.Scene([POINT], []),  # pyright: ignore
        r"Scene takes 1 arguments by position, bodies; got 2; .*: joints, forces",
    ),
    "argument of simulate": (
        lambda system: mb.simulate(system, system.guess, t1=1.0, tol=1e-3),  # pyright: ignore
        "simulate has no argument 'tol'; did you mean 'rtol'",
    ),
    "argument of assemble": (
        lambda system: mb.assemble(system, fixed={"rod.angle": 0.3}),  # pyright: ignore
        "assemble has no argument 'fixed'; did you mean 'fix'",
    ),
    "coordinate that is the rate of another": (
        lambda system: LagrangianSystem(
            lambda t, q, v, p: 0.5 * jnp.sum(v**2), q=[0.1, 0.2], coordinates=["theta", "theta_rate"]
        ),
        "'theta_rate' is the name of the rate of 'theta'",
    ),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_what_is_said_of_a_slip(pendulum, slip):
    use, message = SLIPS[slip]
    with pytest.raises((ValueError, TypeError), match=message):
        use(pendulum)


UNKNOWN = [
    (
        lambda system, motion: motion["rud"],
        "Unknown body, joint or frame 'rud'; did you mean 'rod'?",
    ),
    (
        lambda system, motion: mb.with_parameters(system, {"rod.mas": 1.0}),
        "Unknown parameter 'rod.mas'; did you mean 'rod.mass'?",
    ),
    (
        lambda system, motion: mb.assemble(system, fix={"rod.angel": 1.0}),
        "Unknown coordinate 'rod.angel'; did you mean 'rod.angle'?",
    ),
    (
        lambda system, motion: mb.Scene([rod()], joints=[planar.Revolute("pin", "ground", "rodd")]),
        "Revolute 'pin': Unknown body 'rodd'; did you mean 'rod' or 'ground'?",
    ),
]


def test_unknown_names_are_errors_of_keys_and_of_values(pendulum, motion):
    for lookup, message in UNKNOWN:
        for kind in (KeyError, ValueError, mb.UnknownNameError):
            with pytest.raises(kind) as raised:
                lookup(pendulum, motion)
            assert str(raised.value) == message


def test_an_angle_in_degrees_is_warned_of(pendulum):
    scene = mb.Scene([rod(angle=90.0)])
    with pytest.warns(UserWarning, match=r"'rod': the angle 90 rad is more than .*; .*np.deg2rad\(90\) is 1.571"):
        scene.compile()
    with pytest.warns(UserWarning, match=r"fix=\{'rod\.angle': …\}: the angle 90 rad is more than a full") as caught:
        mb.assemble(pendulum, fix={"rod.angle": 90.0})
    assert caught[0].filename == __file__


@pytest.mark.parametrize("driven", [False, True])
def test_a_scene_that_cannot_move_says_so(pendulum, driven):
    turned = planar.Driver("hold", "ground", "rod", quantity="angle", motion=lambda t, p: 2.0 * t)
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    joints = [pin, turned] if driven else [planar.Fixed("weld", "ground", "rod", point=(0.0, 0.0))]
    text = str(mb.Scene([rod()], joints=joints).compile())
    assert ("The constraints prescribe every motion" if driven else "nothing can move") in text
    assert "planar, 1 body\n" in text and "0 coordinates, 0 velocities" in text
    assert "can move" not in str(pendulum) and "1 coordinate, 1 velocity" in str(pendulum)
    assert "left out of the computation, since nothing here needs it\n" in str(pendulum)


def test_views_of_a_motion_are_mappings_by_name(motion, tmp_path):
    assert list(motion) == ["rod", "pin"]
    assert "rod" in motion and "pin" in motion and "knee" not in motion
    assert motion.get("knee") is None and motion.get("rod") is not None
    assert "pin" in motion.reactions and "knee" not in motion.reactions
    assert motion.reactions.get("knee") is None
    for error in (KeyError, ValueError):
        with pytest.raises(error, match="Unknown joint 'knee'; there are 'pin'"):
            motion.reactions["knee"]
    assert repr(motion["pin"]).startswith("Motion of 'pin': ") and "angle_rate" in repr(motion["pin"])
    with pytest.raises(ValueError, match=r"writes \.npz, got .*motion.csv"):
        motion.save(tmp_path / "motion.csv")
    with pytest.raises(AttributeError, match="angular_velocity; got 'omega'"):
        getattr(motion["rod"], "omega")  # noqa: B009
    with pytest.raises(AttributeError, match=r"trajectory.quantity\("):
        getattr(motion["rod"], "acceleration")  # noqa: B009
    assert dir(motion["rod"]) == sorted(["position", "velocity", "angle", "orientation", "angular_velocity"])
    for name, view in (("rod", "motion"), ("pin", "motion"), ("motor", "motion.forces")):
        with pytest.raises(AttributeError, match=re.escape(f"{view}['{name}']")):
            getattr(motion, name)
    with pytest.raises(AttributeError, match="no attribute 'mass'"):
        getattr(motion, "mass")  # noqa: B009
    with pytest.raises(KeyError, match=r"motion\.forces\['motor'\]"):
        motion["motor"]


def test_errors_and_violations_of_a_motion_are_relative_to_the_size(pendulum):
    """That of the machine for lengths, of the largest coordinate for errors."""
    length, q = float(pendulum.length), np.array([[0.5, 0.0, 0.2]])
    assert length != 1.0
    motion = motion_of(pendulum, [0.0], q + np.array([0.5 * np.cos(0.2) - 0.5 + 1e-3, 0.5 * np.sin(0.2), 0.0]), 0.0 * q)
    violated = motion.constraint_violation
    # The sizes of rows differ a little from that of the machine.
    np.testing.assert_allclose(violated.position, [1e-3 / length], rtol=0.03)
    np.testing.assert_array_equal(violated.velocity, [0.0])
    closer = motion_of(pendulum, [0.0], np.asarray(motion.ys.q) + np.array([2e-3, 0.0, 3e-3]), 0.0 * q)
    error = dataclasses.replace(motion, closer=closer).error
    sizes = np.array([length, length, 1.0])
    relative = lambda x: np.max(np.abs(np.asarray(x)) / sizes)
    np.testing.assert_allclose(error.largest, relative([2e-3, 0.0, 3e-3]) / relative(motion.ys.q), rtol=1e-9)
    assert str(violated).startswith("ConstraintViolation: at most ")


@pytest.mark.slow
def test_what_is_printed_of_a_motion_and_of_its_forces(pendulum):
    motion = mb.simulate(pendulum, mb.assemble(pendulum), t1=0.01, error=True)
    assert str(motion["rod"]).startswith("BodyMotion: position (1, 2) m, velocity (1, 2) m/s, angle (1,) rad, ")
    assert "orientation" not in str(motion["rod"])
    assert str(motion.reactions["pin"]).startswith("Reaction: force (1, 2) N")
    assert str(motion).endswith("Names: rod, pin\nForces, in motion.forces: motor")
    largest = float(motion.error.largest)
    assert str(motion.error) == f"GlobalError: at most {largest:.2g} of the largest coordinate or velocity"


@pytest.mark.slow
def test_coordinates_that_depend_on_each_other(pendulum):
    measured = {"measured": {"rod.angle": np.zeros(2)}, "ts": [0.01, 0.02], "free": {"rod.inertia": 0.1}}
    for call, message in (
        (
            lambda: mb.assemble(pendulum, fix={"rod.x": 0.3, "rod.angle": 1.0}),
            r"rod\.x and rod\.angle depend on each other: of these 2 .* only 1 can be",
        ),
        (
            lambda: mb.assemble(pendulum, fix={"rod.angle": 0.3, "pin.angle": 1.0}),
            r"with rod\.angle, pin\.angle fixed: rod\.angle and pin\.angle depend",
        ),
        (
            lambda: mb.identify(pendulum, **measured, free_initial=("pin.angle",)),
            r"coordinates of bodies, not of joints, and 'pin\.angle' is of a joint",
        ),
        (
            lambda: mb.identify(pendulum, **measured, fix={"rod.angle": 1.0, "rod.x": 0.3}),
            r"rod\.x and rod\.angle depend on each other",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.slow
def test_a_rate_has_one_name_everywhere(pendulum):
    """`trajectory["pin"].angle_rate` is `"pin.angle_rate"` in `rates=`, quantities and states."""
    by_coordinate, by_rate, of_body = (
        mb.assemble(pendulum, rates={name: 2.0}) for name in ("pin.angle", "pin.angle_rate", "rod.angle_rate")
    )
    np.testing.assert_array_equal(by_rate.u, by_coordinate.u)
    np.testing.assert_allclose(of_body.u, by_rate.u, rtol=1e-14)
    motion = mb.simulate(pendulum, by_rate, t1=0.01)
    np.testing.assert_array_equal(motion.quantity("pin.angle_rate"), motion["pin"].angle_rate)
    rest = mb.equilibrium(pendulum)
    assert mb.linearise(pendulum, rest, coordinates=["pin.angle"]).states == ("pin.angle", "pin.angle_rate")
    assert mb.linearise(pendulum, rest, rates=["pin.angle_rate"]).states == ("rod.angle", "pin.angle_rate")
    for name in ("pin", "rod"):
        with pytest.raises(ValueError, match=f"'{name}.angle' and '{name}.angle_rate' are the same rate"):
            mb.assemble(pendulum, rates={f"{name}.angle": 2.0, f"{name}.angle_rate": 2.0})
    with pytest.raises(ValueError, match=r"Unknown rate 'pin\.angle\.rate'"):
        mb.assemble(pendulum, rates={"pin.angle.rate": 2.0})


def test_the_rate_of_a_generalized_coordinate_has_one_name():
    system = LagrangianSystem(
        lambda t, q, v, p: 0.5 * jnp.sum(v**2) - 0.5 * jnp.sum(q**2), q=[0.1], coordinates=["theta"]
    )
    state = mb.assemble(system, rates={"theta_rate": 2.0})
    assert float(state.u[0]) == 2.0
    motion = motion_of(system, [0.0], state.q[None], state.u[None])
    assert list(motion) == ["theta", "theta_rate"]
    np.testing.assert_array_equal(motion["theta_rate"], motion.quantity("theta_rate"))
    np.testing.assert_array_equal(motion["theta_rate"], motion.ys.u[:, 0])
