"""What a user reads after a slip: the nearest names, what an object has, and which values depend on each other."""

import math
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.parts import AbstractForce, fields


@pytest.fixture(scope="module")
def pendulum():
    rod = planar.Body("rod", mass=1.0, inertia=0.1, position=(0.5, 0.0), angle=0.0)
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    forces = [mb.Gravity((0.0, -9.81)), planar.Torque("motor", "rod", torque=0.0)]
    return mb.Scene([rod], joints=[pin], forces=forces).compile()


@pytest.fixture(scope="module")
def motion(pendulum):
    return mb.simulate(pendulum, mb.assemble(pendulum), t1=0.01, error=True)


def test_an_unknown_coordinate_lists_those_of_the_body(pendulum):
    with pytest.raises(ValueError, match=r"'rod' has 'rod\.x', 'rod\.y', 'rod\.angle'"):
        mb.assemble(pendulum, fix={"rod.phi": 0.3})
    with pytest.raises(ValueError, match=r"did you mean 'rod\.angle'\?"):
        mb.assemble(pendulum, fix={"rod.angel": 0.3})


def gust(poses, velocities, t, parameters):
    return jnp.array([[math.sin(t), 0.0, 0.0]])


wind = mb.Force("wind", "bob", gust)


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (
            lambda system: mb.with_inputs(system, {"pin.point_a": lambda t: np.array([np.sin(t), 0.0])}),
            r"`.*np\.sin\(t\).*` needs the time as a number, and the input 'pin\.point_a' is traced by JAX: .*Use jnp",
        ),
        (
            lambda system: mb.with_inputs(system, {"rod.mass": lambda t: 1.0 if t > 0.5 else 2.0}),
            "needs the time as a number",
        ),
        (
            lambda system: mb.design(system, {"length": 1.0}, lambda v: {"rod.inertia": float(v["length"])}),
            "needs a design variable as a number, and derive",
        ),
        (lambda system: mb.optimise(lambda v: np.sin(v["x"]), {"x": 1.0}), "a parameter.* the function of optimise"),
        (
            lambda system: mb.Scene([planar.Body("bob", mass=1.0, inertia=0.1)], forces=[wind]).compile(),
            r"test_messages\.py:\d+: `return .*math\.sin\(t\).*` needs an argument .*wrenches of Force 'wind'",
        ),
        (
            lambda system: mb.Scene([planar.PointMass("bob", mass=1.0)], forces=[wind]).compile(),
            "needs an argument as a number, and Force 'wind'",
        ),
        (
            lambda system: mb.lagrangian.LagrangianSystem(lambda t, q, v, p: 0.5 * np.dot(v, v), q=[1.0]),
            r"`.*np\.dot\(v, v\).*` needs an argument as a number, and lagrangian is traced",
        ),
    ],
    ids=["NumPy", "branch", "design", "optimise", "Force", "Force on a point", "LagrangianSystem"],
)
def test_numbers_that_functions_of_the_user_do_not_get(pendulum, use, message):
    with pytest.raises(ValueError, match=message):
        use(pendulum)


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (
            lambda: mb.optimise(lambda v: v["y"], {"x": 3.0}),
            "asks for 'y', which the function of optimise does not get; v has 'x'",
        ),
        (
            lambda: mb.lagrangian.LagrangianSystem(
                kinetic=lambda t, q, v, p: v @ v,
                potential=lambda t, q, p: p["g"] * q[0],
                q=[1.0],
                parameters={"G": 9.81},
            ),
            "asks for 'g', which potential does not get; p has 'G'",
        ),
        (
            lambda: mb.Scene(
                [planar.Body("bob", mass=1.0, inertia=0.1)],
                joints=[planar.Driver("d", "ground", "bob", quantity="angle", motion=lambda t, p: p["w"] * t)],
            ).compile(),
            "asks for 'w', which residual of Driver 'd' does not get; p has no names",
        ),
        (
            lambda: mb.Scene(
                [planar.PointMass("bob", mass=1.0)],
                forces=[mb.Force("wind", "bob", lambda x, v, t, p: -p["c"] * v, parameters={"d": 1.0})],
            ).compile(),
            "asks for 'c', which Force 'wind' does not get; p has 'd'",
        ),
    ],
    ids=["optimise", "LagrangianSystem", "Driver", "Force on a point"],
)
def test_names_that_functions_of_the_user_do_not_get(use, message):
    with pytest.raises(ValueError, match=rf"test_messages\.py:\d+: `.*` {message}"):
        use()


def test_an_angle_in_degrees_is_warned_of():
    scene = mb.Scene([mb.planar.Body("rod", mass=1.0, inertia=0.1, angle=90.0)])
    with pytest.warns(UserWarning, match=r"'rod': the angle 90 rad is more than .*; .*np.deg2rad\(90\) is 1.571"):
        scene.compile()


def test_a_fixed_angle_in_degrees_is_warned_of(pendulum):
    with pytest.warns(UserWarning, match=r"fix=\{'rod\.angle': …\}: the angle 90 rad is more than a full") as caught:
        mb.assemble(pendulum, fix={"rod.angle": 90.0})
    assert caught[0].filename == __file__
    with pytest.warns(UserWarning, match=r"fix=\{'pin\.angle': …\}: the angle 45 rad is more than a full") as caught:
        mb.assemble(pendulum, fix={"pin.angle": 45.0})
    assert caught[0].filename == __file__


@pytest.mark.slow
def test_views_list_what_they_have(motion):
    with pytest.raises(AttributeError, match="angular_velocity; got 'omega'"):
        getattr(motion["rod"], "omega")  # noqa: B009
    with pytest.raises(AttributeError, match=r"trajectory.quantity\("):
        getattr(motion["rod"], "acceleration")  # noqa: B009
    assert dir(motion["rod"]) == sorted(["position", "velocity", "angle", "orientation", "angular_velocity"])


def test_what_is_printed_of_a_joint_and_where_a_motion_is_saved(motion, tmp_path):
    assert repr(motion["pin"]).startswith("Motion of 'pin': ") and "angle_rate" in repr(motion["pin"])
    with pytest.raises(ValueError, match=r"writes \.npz, got .*motion.csv"):
        motion.save(tmp_path / "motion.csv")


@pytest.mark.slow
def test_what_is_printed_of_a_motion_and_of_its_forces(pendulum, motion):
    assert str(motion["rod"]).startswith("BodyMotion: position (1, 2) m, velocity (1, 2) m/s, angle (1,) rad, ")
    assert "orientation" not in str(motion["rod"]) and str(motion.reactions["pin"]).startswith(
        "Reaction: force (1, 2) N"
    )
    assert str(motion).endswith("Names: rod, pin\nForces, in motion.forces: motor")
    for name, view in (("rod", "motion"), ("pin", "motion"), ("motor", "motion.forces")):
        with pytest.raises(AttributeError, match=re.escape(f"{view}['{name}']")):
            getattr(motion, name)
    with pytest.raises(AttributeError, match="no attribute 'mass'"):
        getattr(motion, "mass")  # noqa: B009
    with pytest.raises(KeyError, match=r"motion\.forces\['motor'\]"):
        motion["motor"]
    largest, errors = float(motion.error.largest), motion.error.ys
    unit = np.array([pendulum.length, pendulum.length, 1.0])
    relative = lambda error, y: np.max(np.asarray(error) / unit) / np.max(np.abs(np.asarray(y)) / unit)
    assert largest == pytest.approx(max(relative(errors.q, motion.ys.q), relative(errors.u, motion.ys.u)))
    assert str(motion.error) == f"GlobalError: at most {largest:.2g} of the largest coordinate or velocity"
    assert str(motion.constraint_violation).startswith("ConstraintViolation: at most ")


@pytest.mark.parametrize("driven", [False, True])
def test_a_scene_that_cannot_move_says_so(pendulum, driven):
    rod = planar.Body("rod", mass=1.0, inertia=0.1)
    turned = planar.Driver("hold", "ground", "rod", quantity="angle", motion=lambda t, p: 2.0 * t)
    pin = planar.Revolute("pin", "ground", "rod", point=(0.0, 0.0))
    joints = [pin, turned] if driven else [planar.Fixed("weld", "ground", "rod", point=(0.0, 0.0))]
    text = str(mb.Scene([rod], joints=joints).compile())
    assert ("The constraints prescribe every motion" if driven else "nothing can move") in text
    assert "planar, 1 body\n" in text and "0 coordinates, 0 velocities" in text
    assert "can move" not in str(pendulum) and "1 coordinate, 1 velocity" in str(pendulum)
    assert "left out of the computation, since nothing here needs it\n" in str(pendulum)


def test_views_by_name_are_mappings(motion):
    assert "pin" in motion.reactions and "knee" not in motion.reactions
    assert motion.reactions.get("knee") is None
    for error in (KeyError, ValueError):
        with pytest.raises(error, match="Unknown joint 'knee'; there are 'pin'"):
            motion.reactions["knee"]


def test_motions_are_looked_up_by_name(motion):
    assert list(motion) == ["rod", "pin"]
    assert "rod" in motion and "pin" in motion and "knee" not in motion
    assert motion.get("knee") is None and motion.get("rod") is not None


@pytest.mark.parametrize(
    ("lookup", "message"),
    [
        (lambda system, motion: motion["rud"], "Unknown body, joint or frame 'rud'; did you mean 'rod'?"),
        (
            lambda system, motion: mb.with_parameters(system, {"rod.mas": 1.0}),
            "Unknown parameter 'rod.mas'; did you mean 'rod.mass'?",
        ),
        (
            lambda system, motion: mb.assemble(system, fix={"rod.angel": 1.0}),
            "Unknown coordinate 'rod.angel'; did you mean 'rod.angle'?",
        ),
        (
            lambda system, motion: mb.Scene(
                [planar.Body("rod", mass=1.0, inertia=1.0)], joints=[planar.Revolute("pin", "ground", "rodd")]
            ),
            "Revolute 'pin': Unknown body 'rodd'; did you mean 'rod' or 'ground'?",
        ),
    ],
)
def test_unknown_names_are_errors_of_keys_and_of_values(pendulum, motion, lookup, message):
    for kind in (KeyError, ValueError, mb.UnknownNameError):
        with pytest.raises(kind) as raised:
            lookup(pendulum, motion)
        assert str(raised.value) == message


@pytest.mark.parametrize("where", ["mass", "position"])
def test_scenes_are_compiled_outside_of_traced_functions(where):
    def moved(x):
        bar = planar.Body("bar", **({"mass": 1.0, "inertia": 1.0} | {where: x if where == "mass" else (x, 0.0)}))
        return mb.Scene([bar]).compile().guess.q[0]

    with pytest.raises(ValueError, match=r"Body 'bar' has a number that JAX traces.*jaxmb\.with_parameters"):
        jax.grad(moved)(0.5)


def test_a_body_where_a_joint_is_needed():
    bar = planar.Body("bar", mass=1.0, inertia=1.0)
    pin = planar.Revolute("pin", "ground", "bar", point=(0.0, 0.0))
    with pytest.raises(ValueError, match=r"JointSpring 'spring': 'bar' is not a joint; the part acts on joints.*'pin'"):
        mb.Scene([bar], joints=[pin], forces=[mb.JointSpring("spring", "bar.angle", stiffness=1.0)]).compile()


def test_unknown_names_in_functions_of_the_user_keep_their_message(pendulum):
    with pytest.raises(mb.UnknownNameError, match=r"^Unknown parameter 'rod.mas'; did you mean 'rod.mass'"):
        mb.design(
            pendulum, {"m": 1.0}, lambda v: dict(mb.parameters(mb.with_parameters(pendulum, {"rod.mas": v["m"]})))
        )


def test_unknown_arguments_of_parts():
    with pytest.raises(TypeError, match=r"SpringDamper has no argument 'k'; it takes .*stiffness, damping"):
        planar.SpringDamper("spring", "ground", "rod", k=3.0)  # pyright: ignore
    with pytest.raises(TypeError, match="did you mean 'stiffness'"):
        planar.SpringDamper("spring", "ground", "rod", stifness=3.0)  # pyright: ignore
    with pytest.raises(TypeError, match=r"Revolute takes 3 arguments by position.*give by name: point_a, point_b"):
        planar.Revolute("pin", "ground", "rod", (0.0, 0.0), (1.0, 0.0))  # pyright: ignore


def test_bodies_and_joints_of_a_scene_by_position():
    with pytest.raises(TypeError, match=r"Scene takes 1 arguments by position, bodies; got 2; .*: joints, forces"):
        mb.Scene([planar.PointMass("bob", mass=1.0)], [])  # pyright: ignore


def test_the_name_of_a_part_in_place_of_its_numbers(pendulum):
    with pytest.raises(ValueError, match=r"Unknown parameter 'pin'; 'pin' has 'pin\.point_a', 'pin\.point_b'"):
        mb.with_inputs(pendulum, {"pin": lambda t: t})


@pytest.mark.slow
def test_initial_states_that_cannot_be(pendulum):
    measured = {"measured": {"rod.angle": np.zeros(2)}, "ts": [0.01, 0.02], "free": {"rod.inertia": 0.1}}
    with pytest.raises(ValueError, match=r"coordinates of bodies, not of joints, and 'pin\.angle' is of a joint"):
        mb.identify(pendulum, **measured, free_initial=("pin.angle",))
    with pytest.raises(ValueError, match=r"rod\.x and rod\.angle depend on each other"):
        mb.identify(pendulum, **measured, fix={"rod.angle": 1.0, "rod.x": 0.3})


def test_unknown_arguments_of_functions(pendulum):
    with pytest.raises(TypeError, match="simulate has no argument 'tol'; did you mean 'rtol'"):
        mb.simulate(pendulum, mb.assemble(pendulum), t1=1.0, tol=1e-3)  # pyright: ignore
    with pytest.raises(TypeError, match="assemble has no argument 'fixed'; did you mean 'fix'"):
        mb.assemble(pendulum, fixed={"rod.angle": 0.3})  # pyright: ignore


def test_fixed_coordinates_that_depend_on_each_other(pendulum):
    with pytest.raises(ValueError, match=r"rod\.x and rod\.angle depend on each other: of these 2 .* only 1 can be"):
        mb.assemble(pendulum, fix={"rod.x": 0.3, "rod.angle": 1.0})


@pytest.mark.slow
def test_a_coordinate_of_a_joint_that_depends_on_another_fixed_one(pendulum):
    with pytest.raises(ValueError, match=r"with rod\.angle, pin\.angle fixed: rod\.angle and pin\.angle depend"):
        mb.assemble(pendulum, fix={"rod.angle": 0.3, "pin.angle": 1.0})


@pytest.mark.parametrize(
    ("name", "rate"),
    [("rod.angle_rate", "rod.angle"), ("pin.angle_rate", "pin.angle"), ("rod.velocity", "rod.velocity")],
)
def test_a_rate_is_no_coordinate(pendulum, name, rate):
    with pytest.raises(ValueError, match=rf"'{name}' is a rate, .* assemble takes it as rates=\{{'{rate}': …\}}"):
        mb.assemble(pendulum, fix={name: 1.0})


@pytest.mark.parametrize(
    "program",
    [
        mb.JointDriver("drive", "pin.angle", rate=1.0),
        mb.JointCoupling("drive", "pin.angle", "hip.angle", coefficients=(0.0, 1.0)),
    ],
)
def test_servos_of_parts_on_coordinates(program):
    with pytest.raises(ValueError, match="Servo 'drive': the program must be a constraint between bodies"):
        mb.Servo(program)


class Learned(AbstractForce):
    """A moment [N m] from a neural network of the body's velocity."""

    name: str = fields.name()
    body: str = fields.body_name()
    network: Any

    def wrenches(self, space, poses, velocities, t):
        return jnp.zeros((1, 3)).at[0, 2].add(self.network(velocities[0])[0])


def test_modules_as_fields():
    """A module in a field without a declaration is refused with what to do."""
    rod = planar.Body("rod", mass=1.0, inertia=0.1)
    network = eqx.nn.MLP(3, 1, 4, 1, key=jax.random.key(0))
    with pytest.raises(ValueError, match=r"Learned 'net': network\.activation is .*fields\.module\(\)"):
        mb.Scene([rod], forces=[Learned("net", "rod", network)]).compile()


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
    system = mb.lagrangian.LagrangianSystem(
        lambda t, q, v, p: 0.5 * jnp.sum(v**2) - 0.5 * jnp.sum(q**2), q=[0.1], coordinates=["theta"]
    )
    state = mb.assemble(system, rates={"theta_rate": 2.0})
    assert float(state.u[0]) == 2.0
    motion = mb.simulate(system, state, t1=0.1)
    assert list(motion) == ["theta", "theta_rate"]
    np.testing.assert_array_equal(motion["theta_rate"], motion.quantity("theta_rate"))
    np.testing.assert_array_equal(motion["theta_rate"], motion.ys.u[:, 0])
    with pytest.raises(ValueError, match="'theta_rate' is the name of the rate of 'theta'"):
        mb.lagrangian.LagrangianSystem(
            lambda t, q, v, p: 0.5 * jnp.sum(v**2), q=[0.1, 0.2], coordinates=["theta", "theta_rate"]
        )
