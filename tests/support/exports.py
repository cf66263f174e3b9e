"""The classes that the package exports, and those without cases in tests."""

import inspect

import jaxmb as mb
from jaxmb.parts import (
    AbstractBody,
    AbstractCompound,
    AbstractConstraint,
    AbstractForce,
    AbstractNonIdeal,
    AbstractTendon,
    AbstractVelocityConstraint,
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
# A program is no constraint of its own, and gravity is no force between bodies, but both are parts of scenes.
OF_SCENES = (*PARTS, mb.Servo, mb.Gravity)


def exported(module, kinds):
    """Names of the classes of these kinds that a module exports. Those for users to derive from are called Abstract…"""
    return {
        name
        for name in dir(module)
        if not name.startswith(("_", "Abstract"))
        and inspect.isclass(value := getattr(module, name))
        and issubclass(value, kinds)
    }


def missing(module, kinds, *tables):
    """Names of exported classes without a case in any of the tables, whose entries are names or instances."""
    cases = {entry if isinstance(entry, str) else type(entry).__name__ for table in tables for entry in table}
    return exported(module, kinds) - cases
