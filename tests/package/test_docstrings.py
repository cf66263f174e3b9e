"""The examples in docstrings run: those of joints by themselves, the others, one after the other, on a pendulum."""

import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from exports import exported

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import AbstractCompound, AbstractConstraint, AbstractVelocityConstraint

EXAMPLES = {
    "Scene": mb.Scene,
    "assemble": mb.assemble,
    "simulate": mb.simulate,
    "equilibrium": mb.equilibrium,
    "identify": mb.identify,
    "linearise": mb.linearise,
    "root_locus": mb.root_locus,
    "Trajectory": mb.Trajectory,
    "LagrangianSystem": mb.lagrangian.LagrangianSystem,
    "Force": mb.Force,
    "Series": mb.Series,
}

MODULES = {"jax": jax, "jnp": jnp, "np": np, "jaxmb": mb, "planar": planar, "spatial": spatial}
# The coordinates of the joints in their examples, at the given poses.
ZERO_3 = (0.0, 0.0, 0.0)
PLANAR = {
    "Revolute": {"angle": -1.5},
    "Fixed": {},
    "PointOnLine": {"displacement": 0.3, "angle": 0.0},
    "Prismatic": {"displacement": 0.3},
    "Distance": {},
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
    "PointOnPlane": {},
    "PointOnLine": {"displacement": 0.0},
    "Composite": {"angle_1": 0.0, "displacement_1": 0.0},
    "KnifeEdge": {},
    "RollingDisc": {},
    "RollingSphere": {},
    "Driver": {},
}
JOINTS = [(module, name) for module, known in ((planar, PLANAR), (spatial, SPATIAL)) for name in known]


def example(thing):
    code = re.search(r"```python\n(.*?)```", inspect.getdoc(thing), re.DOTALL)
    assert code is not None
    return code.group(1)


@pytest.fixture(scope="module")
def names():
    """What the examples refer to: modules, and the pendulum of that of `Scene`."""
    scope = dict(MODULES)
    exec(example(mb.Scene), scope)
    scope["state"] = mb.assemble(scope["system"], fix={"bar.angle": 0.5})
    return scope


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples(name, names):
    scope = dict(names)
    exec(example(EXAMPLES[name]), scope)
    match name:
        case "equilibrium":
            np.testing.assert_allclose(np.sin(scope["hanging"].q[2]), -1.0, atol=1e-9)
            np.testing.assert_allclose(np.sin(scope["upright"].q[2]), 1.0, atol=1e-9)
        case "identify":
            assert scope["fit"].converged
            np.testing.assert_allclose(scope["fit"].parameters["bar.inertia"], 1.0 / 12.0, rtol=1e-6)
        case "linearise":
            # A bar on a pin: the square of its frequency is 3 g / 2 l.
            frequency = np.abs(scope["about_rest"].eigenvalues.imag)
            np.testing.assert_allclose(frequency, np.sqrt(1.5 * 9.81), rtol=1e-9)
        case "Trajectory":
            assert np.ptp(scope["motion"].energy) < 1e-7


def test_every_joint_has_an_example():
    kinds = (AbstractConstraint, AbstractVelocityConstraint, AbstractCompound)
    assert exported(planar, kinds) == PLANAR.keys() and exported(spatial, kinds) == SPATIAL.keys()


@pytest.mark.parametrize(("module", "name"), JOINTS, ids=lambda own: getattr(own, "__name__", own))
def test_examples_of_joints(module, name):
    """Their docstrings say what they connect, and which coordinates they have, with these values in the example."""
    cls, scope = getattr(module, name), dict(MODULES)
    exec(example(cls), scope)
    (joint,) = (own for own in scope.values() if type(own) is cls)
    system, text = scope["system"], inspect.getdoc(cls)
    assert joint.name in system.constraint_names()
    for field in ("body_a", "body_b") if hasattr(joint, "body_a") else ("body",):
        assert f"`{field}`" in text
    expected = (PLANAR if module is planar else SPATIAL)[name]
    own = {key: at for key, at in system.joint_coordinates().items() if key.split(".")[0] == joint.name}
    assert {key.split(".")[1] for key in own} == expected.keys()
    assert expected or "no coordinates" in text
    for field, value in expected.items():
        assert f"`{field}`" in text
        found = system.joint_coordinate(own[f"{joint.name}.{field}"], 0.0, system.guess.q)
        np.testing.assert_allclose(found, value, atol=1e-12)
