"""Everything that the package exports has cases in the tests: a new class without them fails here."""

import inspect
import types
import typing

import diffrax
import pytest
import test_contact
import test_every_part
import test_formulations
import test_planar_parts
import test_servo_friction
import test_spatial_parts

import jaxmb as mb
from jaxmb import formulations, manifold, planar, solvers, spatial
from jaxmb.parts import (
    AbstractBody,
    AbstractCompound,
    AbstractConstraint,
    AbstractForce,
    AbstractFrictionLaw,
    AbstractNonIdeal,
    AbstractNormalLaw,
    AbstractTendon,
    AbstractTerrain,
    AbstractVelocityConstraint,
    contact,
    fields,
    terrain,
)

PARTS = (
    AbstractBody,
    AbstractConstraint,
    AbstractVelocityConstraint,
    AbstractCompound,
    AbstractForce,
    AbstractNonIdeal,
    AbstractTendon,
)
METHODS = [choice for options in test_every_part.METHODS.values() for choice in options.values()]
# A program is no constraint of its own, and gravity is no force between bodies, but both are parts of scenes.
OF_SCENES = (*PARTS, mb.Servo, mb.Gravity)


def exported(module, kinds):
    """Names of the classes of these kinds that a module exports. Those for users to derive from are called Abstract…"""
    return {
        name
        for name, value in vars(module).items()
        if inspect.isclass(value) and issubclass(value, kinds) and not name.startswith(("_", "Abstract"))
    }


def missing(module, kinds, *tables):
    """Names of exported classes without a case in any of the tables, whose entries are names or instances."""
    cases = {entry if isinstance(entry, str) else type(entry).__name__ for table in tables for entry in table}
    return exported(module, kinds) - cases


def test_a_class_without_cases_is_found():
    module = types.SimpleNamespace(Revolute=planar.Revolute, Sleeve=planar.Prismatic, box=planar.box)
    assert missing(module, AbstractConstraint, ["Revolute"]) == {"Sleeve"}
    assert missing(module, AbstractConstraint, ["Revolute", "Sleeve"]) == set()
    assert missing(module, AbstractForce) == set()
    # As an instance in a table, a class has its own name.
    bodies = types.SimpleNamespace(Body=planar.Body, PointMass=planar.PointMass)
    assert missing(bodies, AbstractBody, [planar.Body("a", mass=1.0, inertia=1.0)]) == {"PointMass"}


def examples(space):
    return [example.part for name, example in test_every_part.EXAMPLES.items() if name.startswith(space)]


def laws_of_joints(dimension):
    systems = [scene() for scene in test_servo_friction.SCENES.values()]
    return [g.group.part for own in systems if own.layout.space.dimension == dimension for g in own.nonideal]


@pytest.mark.parametrize("module, tests", [(planar, test_planar_parts), (spatial, test_spatial_parts)])
def test_every_part_meets_its_identities(module, tests):
    # The cases of a driver are the quantities that it can drive.
    (quantities,) = (own.of for own in fields.declarations(module.Driver).values() if own.kind == "choice")
    assert set(tests.QUANTITIES) == set(quantities)
    laws = laws_of_joints(module.Body("a", mass=1.0, inertia=1.0).dimension)
    tables = tests.CASES, ["Driver"], tests.ROLLING, tests.forces().values(), tests.BODIES, laws
    assert missing(module, PARTS, *tables) == set()


@pytest.mark.parametrize("module, name", [(planar, "planar"), (spatial, "spatial"), (mb, "functions")])
def test_every_part_stands_in_a_scene(module, name):
    # Every one of these scenes has gravity. Friction in the plane stands among the functions and laws of joints.
    laws = examples("functions") if module is planar else []
    assert missing(module, OF_SCENES, examples(name), laws, ["Gravity"]) == set()


@pytest.mark.parametrize(
    "module, kinds, cases",
    [
        (contact, AbstractNormalLaw, test_contact.LAWS.values()),
        (contact, AbstractFrictionLaw, test_contact.FRICTION.values()),
        (terrain, AbstractTerrain, test_contact.TERRAINS.values()),
        (formulations, formulations.AbstractFormulation, test_formulations.FORMULATIONS.values()),
        (manifold, manifold.AbstractManifold, METHODS),
        (solvers, (diffrax.AbstractSolver, diffrax.AbstractStepSizeController), METHODS),
    ],
    ids=["normal forces", "friction", "terrains", "formulations", "manifolds", "solvers"],
)
def test_every_law_and_method_has_cases(module, kinds, cases):
    assert exported(module, kinds)
    assert missing(module, kinds, cases) == set()


def test_every_form_of_a_formulation_has_cases():
    own = formulations.UdwadiaKalaba
    forms = typing.get_args(typing.get_type_hints(own)["method"])
    assert set(forms) == {case.method for case in test_formulations.FORMULATIONS.values() if isinstance(case, own)}
