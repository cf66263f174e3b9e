"""Everything that the package exports has cases in the tests: a new class without them fails here."""

import types
import typing

import diffrax
import pytest
from every_contact import CONTACTS
from every_dry_friction import FRICTIONS
from every_formulation import FORMULATIONS
from every_part import EXAMPLES, METHODS
from exports import OF_SCENES, exported, missing
from laws import FRICTION, LAWS, TERRAINS

import jaxmb as mb
from jaxmb import formulations, manifold, planar, solvers, spatial
from jaxmb.parts import (
    AbstractBody,
    AbstractConstraint,
    AbstractForce,
    AbstractFrictionLaw,
    AbstractNormalLaw,
    AbstractTerrain,
    contact,
    terrain,
)

CHOICES = [choice for options in METHODS.values() for choice in options.values()]


def test_a_class_without_cases_is_found():
    module = types.SimpleNamespace(Revolute=planar.Revolute, Sleeve=planar.Prismatic, box=planar.box)
    assert missing(module, AbstractConstraint, ["Revolute"]) == {"Sleeve"}
    assert missing(module, AbstractConstraint, ["Revolute", "Sleeve"]) == set()
    assert missing(module, AbstractForce) == set()
    # As an instance in a table, a class has its own name.
    bodies = types.SimpleNamespace(Body=planar.Body, PointMass=planar.PointMass)
    assert missing(bodies, AbstractBody, [planar.Body("a", mass=1.0, inertia=1.0)]) == {"PointMass"}


def examples(space):
    return [example.part for name, example in EXAMPLES.items() if name.startswith(space)]


@pytest.mark.parametrize("module, name", [(planar, "planar"), (spatial, "spatial"), (mb, "functions")])
def test_every_part_stands_in_a_scene(module, name):
    # Every one of these scenes has gravity. Friction in the plane stands among the functions and laws of joints.
    laws = examples("functions") if module is planar else []
    contacts = [part for part, _, _ in CONTACTS.values()] + [part for *_, part in FRICTIONS.values()]
    assert missing(module, OF_SCENES, examples(name), laws, contacts, ["Gravity"]) == set()


@pytest.mark.parametrize(
    "module, kinds, cases",
    [
        (contact, AbstractNormalLaw, LAWS.values()),
        (contact, AbstractFrictionLaw, FRICTION.values()),
        (terrain, AbstractTerrain, TERRAINS.values()),
        (formulations, formulations.AbstractFormulation, FORMULATIONS.values()),
        (manifold, manifold.AbstractManifold, CHOICES),
        (solvers, (diffrax.AbstractSolver, diffrax.AbstractStepSizeController), CHOICES),
    ],
    ids=["normal forces", "friction", "terrains", "formulations", "manifolds", "solvers"],
)
def test_every_law_and_method_has_cases(module, kinds, cases):
    assert exported(module, kinds)
    assert missing(module, kinds, cases) == set()


def test_every_form_of_a_formulation_has_cases():
    own = formulations.UdwadiaKalaba
    forms = typing.get_args(typing.get_type_hints(own)["method"])
    assert set(forms) == {case.method for case in FORMULATIONS.values() if isinstance(case, own)}
