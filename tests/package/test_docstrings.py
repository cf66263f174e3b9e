"""The examples in docstrings and topics run, and every public name has one, or stands in that of another name.

Examples refer to `jax`, `jnp`, `np`, `jaxmb` or `mb`, `planar` and `spatial`, to the pendulum of the example of `Scene`
and a state of it, and to a `motion` of it. Those of joints run by themselves.
"""

import ast
import functools
import inspect
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_part import TYRE_FILE
from exports import exported
from trajectories import motion_of

import jaxmb as mb
from jaxmb import mechanisms, planar, spatial
from jaxmb.parts import AbstractCompound, AbstractConstraint, AbstractVelocityConstraint
from jaxmb.reference import topics
from jaxmb.reference.entries import entries, members

MOST_PROGRAMS = 275

MODULES = {"jax": jax, "jnp": jnp, "np": np, "jaxmb": mb, "mb": mb, "planar": planar, "spatial": spatial}
# The coordinates of the joints in their examples, at the given poses.
ZERO_3 = (0.0, 0.0, 0.0)
PLANAR = {
    "Revolute": {"angle": -1.5},
    "Fixed": {},
    "PointOnLine": {"displacement": 0.3, "angle": 0.0},
    "Prismatic": {"displacement": 0.3},
    "Distance": {},
    "InextensibleBeam": {},
    "PointOnCurve": {"angle": 0.0},
    "Gear": {},
    "RackAndPinion": {},
    "KnifeEdge": {},
    "Driver": {},
}
SPATIAL = {
    "Spherical": {"rotation": ZERO_3},
    "Revolute": {"angle": 0.0},
    "Universal": {"angle_a": 0.0, "angle_b": 0.0},
    "Gimbal": {"angle_1": 0.0, "angle_2": 0.0, "angle_3": 0.0},
    "Cylindrical": {"angle": 0.0, "displacement": 0.0},
    "Screw": {"angle": 0.0, "displacement": 0.0},
    "Prismatic": {"displacement": 0.0},
    "Planar": {"angle": 0.0, "displacement": (0.0, 0.0)},
    "Fixed": {},
    "Distance": {},
    "InextensibleBeam": {},
    "PointOnPlane": {},
    "PointOnLine": {"displacement": 0.0},
    "Composite": {"angle_1": 0.0, "displacement_1": 0.0},
    "KnifeEdge": {},
    "RollingDisc": {},
    "RollingSphere": {},
    "Driver": {},
}
JOINTS = [(module, name) for module, known in ((planar, PLANAR), (spatial, SPATIAL)) for name in known]


# Examples that go on from that of another name, whose names they use.
AFTER = {
    "Identification": "identify",
    "Optimum": "optimise",
    "robust": "optimise",
    "Floquet": "floquet",
    "Regulator": "lqr",
    "parts.AbstractFlexibleFrame": "parts.AbstractFlexibleBody",
    "planar.ModalFrame": "planar.ElasticBody",
    "viz.plot_root_locus": "root_locus",
    "viz.plot_sweep": "sweep",
}
# What examples refer to besides.
BEFORE = {
    "modules": """
import types
import equinox as eqx
net = eqx.nn.MLP(2, 1, 4, 1, key=jax.random.key(0))
law = lambda poses, velocities, t, p: jnp.zeros((1, 3)).at[0, 2].set(p["net"](velocities[0, :2])[0])
friction = jaxmb.Force("friction", "bar", law, parameters={"net": net})
system = jaxmb.Scene([bar], joints=[pin], forces=[friction]).compile()
fit = types.SimpleNamespace(parameters=jaxmb.parameters(system))
""",
    "design": """
system = jaxmb.mechanisms.four_bar().system
""",
    "batch": """
angle_at_end = lambda length, mass: length**2 * mass
lengths, masses = np.linspace(1.0, 2.0, 5), np.linspace(2.0, 3.0, 5)
""",
    "read_measurements": """
from pathlib import Path
Path("run.csv").write_text("t,phi,rate\\n0.0,0.5,0.0\\n0.1,0.44,-1.2\\n0.2,0.25,-2.5\\n")
""",
    "load_sweep": """
speeds = mb.cases.grid(speed=np.linspace(0.0, 5.0, 3))
mb.sweep(lambda speed: {"angle": 2.0 * speed}, speeds, "runs.zarr", progress=False)
""",
}
BEFORE["spatial.Body.from_mesh"] = """
import trimesh
trimesh.creation.box((100.0, 20.0, 10.0)).export("arm.stl")
"""
BEFORE["spatial.MagicFormulaTyre"] = f"""
import shutil
shutil.copy({str(TYRE_FILE)!r}, "tyre.tir")
"""
MOTOR = """
motor = jaxmb.JointForce("motor", "pin.angle", force=0.0)
system = jaxmb.Scene([bar], joints=[pin], forces=[motor]).compile()
"""
BEFORE |= dict.fromkeys(("plan", "Phase", "plan_phases"), MOTOR)
BEFORE["PhasedPlan"] = f"""{MOTOR}
half = jaxmb.Phase(system, controls={{"motor.force": None}}, duration=0.5, running="effort", intervals=2)
rest, turned = ({{"pin.angle": angle, "pin.angle_rate": 0.0}} for angle in (0.0, 1.0))
both = jaxmb.plan_phases([half, half], start=rest, end=turned)
"""
BEFORE["Plan"] = BEFORE["Plan.objective_of"] = f"""{MOTOR}
rest, turned = ({{"pin.angle": angle, "pin.angle_rate": 0.0}} for angle in (0.0, 1.0))
options = {{"controls": {{"motor.force": None}}, "duration": 1.0, "running": "effort", "intervals": 4}}
best = jaxmb.plan(system, start=rest, end=turned, **options)
start = jaxmb.assemble(system)
"""
BOUNCE = """
ball = planar.Body("ball", mass=1.0, inertia=planar.disc(1.0, 0.1), position=(0.0, 0.5))
floor = jaxmb.RigidContact("floor", "ball", terrain=jaxmb.terrain.Flat(), radius=0.1, restitution=0.8)
bouncing = jaxmb.Scene([ball], joints=[floor], forces=[jaxmb.Gravity((0.0, -9.81))]).compile()
motion = jaxmb.simulate(bouncing, jaxmb.assemble(bouncing), t1=0.5)
"""
INERTIA = "<ixx>0.001</ixx><iyy>0.02</iyy><izz>0.02</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>"
ARM = f"""
from pathlib import Path
rod = "<geom type='capsule' size='0.03' fromto='0 0 0 0.5 0 0'/>"
Path("arm.xml").write_text(
    f"<mujoco><worldbody><body name='upper'><joint name='shoulder' axis='0 1 0'/>{{rod}}"
    f"<body name='lower' pos='0.5 0 0'><joint name='elbow' axis='0 1 0' range='-90 90'/>{{rod}}</body></body>"
    "</worldbody><actuator><motor name='motor' joint='elbow'/></actuator></mujoco>"
)
Path("arm.urdf").write_text(
    "<robot name='arm'><link name='base'/><link name='upper'><inertial><origin xyz='0.25 0 0'/><mass value='1'/>"
    "<inertia ixx='0.001' iyy='0.02' izz='0.02' ixy='0' ixz='0' iyz='0'/></inertial></link>"
    "<joint name='shoulder' type='revolute'><parent link='base'/><child link='upper'/><axis xyz='0 1 0'/>"
    "<limit lower='-1' upper='1' effort='1' velocity='1'/></joint></robot>"
)
Path("arm.sdf").write_text(
    "<sdf version='1.9'><model name='arm'><link name='upper'><inertial><pose>0.25 0 0 0 0 0</pose><mass>1</mass>"
    "<inertia>{INERTIA}</inertia></inertial></link>"
    "<joint name='shoulder' type='revolute'><parent>world</parent><child>upper</child>"
    "<axis><xyz>0 1 0</xyz></axis></joint></model></sdf>"
)
"""
BEFORE |= dict.fromkeys(("ContactEvents", "Event", "Trajectory.events"), BOUNCE)
BEFORE |= dict.fromkeys(("importers", "importers.mjcf", "importers.sdf", "importers.urdf"), ARM)


def codes(text):
    return re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def example(thing):
    (code,) = codes(inspect.getdoc(thing))
    return code


@functools.cache
def examples():
    """The code in the docstrings of all public names and of members of classes, by name."""
    known = entries().values()
    every = [*known, *(own for entry in known if entry.kind == "class" for own in members(entry))]
    found = {entry.name: codes(inspect.cleandoc(entry.thing.__doc__ or "")) for entry in every if entry.kind != "field"}
    return {name: "\n".join(own) for name, own in found.items() if own}


ALONE = [f"{module.__name__.partition('.')[2]}.{name}" for module, name in JOINTS]
TOGETHER = [name for name in examples() if name not in ALONE]


@pytest.fixture(scope="module")
def names():
    """What the examples refer to: modules, and the pendulum of that of `Scene`."""
    scope: dict[str, Any] = dict(MODULES)
    exec(example(mb.Scene), scope)
    scope["state"] = mb.assemble(scope["system"], fix={"bar.angle": 0.5})
    return scope


@pytest.fixture(scope="module")
def motion(names):
    """The pendulum swings; how it was computed matters to no example."""
    ts = np.linspace(0.0, 1.0, 11)
    angle, rate = 0.5 * np.cos(3.0 * ts), -1.5 * np.sin(3.0 * ts)
    place = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), angle], axis=1)
    along = rate[:, None] * np.stack([-0.5 * np.sin(angle), 0.5 * np.cos(angle), np.ones(11)], axis=1)
    return motion_of(names["system"], ts, place, along)


# Of more than about a second.
LONG = (
    *("shapes", "mechanisms", "mechanisms.ride", "importers", "manifold", "simulate", "Trajectory", "load"),
    *("ContactEvents", "Event", "RESULTS", "identify", "Identification", "Experiment", "optimise", "Optimum"),
    *("robust", "linearise", "Linearisation", "root_locus", "RootLocus", "steady_motion", "floquet", "Floquet"),
    *("sweep", "mechanisms.Shoes", "viz.show", "viz.plot_root_locus", "report.stress_test", "report.work_precision"),
    *("lqr", "Regulator"),
    *("formulations.Multipliers", "formulations.NullSpace", "formulations.Poincare", "formulations.UdwadiaKalaba"),
    *(
        "manifold.Baumgarte",
        "manifold.Chart",
        "manifold.Partition",
        "manifold.Projection",
        "solvers.Adams",
        "solvers.integrate",
    ),
    *("solvers.MultistepController", "solvers.Hermite", "Trajectory.events", "Rope", "planar.Cylinder"),
    *("kinematics_and_compliance", "required_forces", "KinematicsAndCompliance", "RequiredForces", "Servo"),
    *("formulations.Partitioned", "lagrangian.QuasiVelocities", "formulations.accelerations", "system"),
    *("lagrangian.LagrangianSystem", "spatial.MagicFormulaTyre", "assembly_gap", "planar.Friction", "modules"),
    *("solvers.integrate", "JointCoupling", "smooth_step", "Trajectory.end", "evaluate", "viz.plot_sweep"),
    *("PhasedPlan", "plan_phases", "Trajectory.plot", "Loads", "Plan", "plan", "Plan.objective_of"),
    *("Trajectory.continued", "viz.save_movie", "viz.explore", "viz.Explorer"),
)


# One process alone has computed by ways of its own before the example of `setup`.
@pytest.mark.filterwarnings("ignore:JAX has computed something already")
@pytest.mark.slow(*LONG)
@pytest.mark.parametrize("name", TOGETHER)
def test_examples(name, names, request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("JAXMB_CACHE", "off")
    scope = dict(names)
    code = examples()[name]
    before = examples()[AFTER[name]] if name in AFTER else BEFORE.get(name, "")
    if re.search(r"\bmotion\b", code) and "motion = " not in before + code:
        scope["motion"] = request.getfixturevalue("motion")
    exec(before, scope)
    exec(code, scope)
    match name:
        case "assembly_gap":
            # The bar's centre is 0.3 m farther from the pin than the pin holds it, in units of 0.5 m.
            np.testing.assert_allclose(scope["gap"], 0.6, rtol=1e-9)
        case "equilibrium":
            np.testing.assert_allclose(np.sin(scope["hanging"].q[2]), -1.0, atol=1e-9)
            np.testing.assert_allclose(np.sin(scope["upright"].q[2]), 1.0, atol=1e-9)
        case "floquet":
            np.testing.assert_allclose(scope["periodic"].multipliers, 1.0, atol=1e-6)
        case "identify":
            assert scope["fit"].converged
            np.testing.assert_allclose(scope["fit"].parameters["bar.inertia"], 1.0 / 12.0, rtol=1e-6)
        case "linearise" | "Linearisation":
            # A bar on a pin: the square of its frequency is 3 g / 2 l.
            frequency = np.abs(scope["about_rest"].eigenvalues.imag)
            np.testing.assert_allclose(frequency, np.sqrt(1.5 * 9.81), rtol=1e-9)
        case "lqr":
            # An upright bar with 3 g / 2 l = 14.715: the cost X of (angle, rate) solves two quadratic equations.
            angle, rate = scope["regulator"].gains[0]
            np.testing.assert_allclose([angle**2 - 9.81 * angle, rate**2 - 2 * angle / 3], [100.0, 10.0], rtol=1e-9)
        case "optimise":
            assert scope["best"].success
            np.testing.assert_allclose(scope["best"].outputs["angle"], 0.0, atol=1e-6)
        case "steady_motion":
            speed = np.linalg.norm(scope["circling"].u)
            np.testing.assert_allclose(speed, 0.6 * np.sqrt(9.81 / 0.8), rtol=1e-5)
        case "Trajectory":
            assert np.ptp(scope["motion"].energy) < 1e-7


@pytest.mark.slow(but=("compiling",))
@pytest.mark.parametrize("name", topics())
def test_examples_of_topics(name, names, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(mb, "setup", lambda **_: None)
    monkeypatch.chdir(tmp_path)
    code = codes(topics()[name].text)
    assert code
    scope = dict(names)
    exec("\n".join(code), scope)
    match name:
        case "contacts":
            assert len(scope["motion"].events) == 1
        case "derivatives":
            assert np.isfinite(scope["slope"])
        case "getting-started":
            # The names of the script are those that all examples take up.
            assert scope.keys() >= names.keys() | {"motion"}
        case "signs-and-units":
            assert capsys.readouterr().out.splitlines()[0] == "30°, 1.5e+07 Pa, 314.2 rad/s"
            np.testing.assert_allclose(scope["hanging"].q[2], -np.pi / 2, atol=1e-9)
        case "inputs":
            assert scope["motion"].stats["num_steps"] > 0
        case "throw":
            assert "came to t =" in (out := capsys.readouterr().out)
            assert mb.RESULTS[mb.RESULTS.max_steps_reached] in out
        case "tolerances":
            assert 0.0 < scope["estimated"].error.largest < 1e-6


# Results that the example of the function shows that returns them, and classes and functions for parts of the package.
RESULTS_OF = {
    "importers.Exported": "importers.to_mjcf",
    "importers.ImportedModel": "importers.mjcf",
    "viz.MovingPicture": "viz.show",
    "cases.Cases": "cases",
    "mechanisms.Mechanism": "mechanisms",
    "mechanisms.References": "mechanisms",
    "report.Table": "report.work_precision",
    "parts.Module": "parts.module",
}


def referred_to():
    """All that stands in examples as a name in a module, such as `jaxmb.terrain.Flat`."""
    found = set()
    for code in examples().values():
        scope, tree = dict(MODULES), ast.parse(code)
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom | ast.Import):
                exec(ast.unparse(node), scope)
        dotted = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute | ast.Name)}
        for name in dotted:
            first, *others = name.split(".")
            if first in scope and all(other.isidentifier() for other in others):
                found.add(id(functools.reduce(lambda thing, other: getattr(thing, other, None), others, scope[first])))
    return found


def needs_no_example(entry):
    """Modules, abstract classes, exceptions, tuples of results, mechanisms, results of functions."""
    module, is_class = entry.name.rpartition(".")[0], inspect.isclass(entry.thing)
    if is_class and (entry.short.startswith("Abstract") or issubclass(entry.thing, Exception | tuple)):
        return True
    if module == "mechanisms" and entry.short in mechanisms.names():
        return True
    return entry.kind == "module" or entry.name in RESULTS_OF


def test_every_public_name_has_an_example():
    known, found = entries(), referred_to()
    assert (
        set(RESULTS_OF) <= known.keys()
        and set(RESULTS_OF.values()) | AFTER.keys() | set(AFTER.values()) <= examples().keys()
    )
    without = [
        entry.name
        for entry in known.values()
        if entry.name not in examples() and id(entry.thing) not in found and not needs_no_example(entry)
    ]
    assert not without


LONG_OF_JOINTS = ("Screw", "Composite", "KnifeEdge", "RollingDisc", "RollingSphere", "Driver", "PointOnLine")


def test_every_joint_has_an_example():
    kinds = (AbstractConstraint, AbstractVelocityConstraint, AbstractCompound)
    assert exported(planar, kinds) == PLANAR.keys() and exported(spatial, kinds) == SPATIAL.keys()


@pytest.mark.slow(*(f"jaxmb.spatial-{name}" for name in LONG_OF_JOINTS), "jaxmb.planar-InextensibleBeam")
@pytest.mark.parametrize(("module", "name"), JOINTS, ids=lambda own: getattr(own, "__name__", own))
def test_examples_of_joints(module, name):
    """Their docstrings say what they connect, and which coordinates they have, with these values in the example."""
    cls, scope = getattr(module, name), dict(MODULES)
    exec(example(cls), scope)
    (joint,) = (own for own in scope.values() if type(own) is cls)
    system, text = scope["system"], inspect.getdoc(cls) or ""
    assert joint.name in system.catalogue.constraint_names()
    for field in ("body_a", "body_b") if hasattr(joint, "body_a") else ("body",):
        assert f"`{field}`" in text
    expected = (PLANAR if module is planar else SPATIAL)[name]
    own = {key: at for key, at in system.joint_coordinates().items() if key.split(".")[0] == joint.name}
    assert {key.split(".")[1] for key in own} == expected.keys() == joint.quantities.keys()
    assert expected or "no coordinates" in text
    at = lambda q: [system.catalogue.joint_coordinate(own[f"{joint.name}.{field}"], 0.0, q) for field in expected]
    found = jax.jit(at)(system.guess.q) if expected else []
    for (field, value), own_value in zip(expected.items(), found, strict=True):
        assert f"`{field}`" in text
        np.testing.assert_allclose(own_value, value, atol=1e-12)
