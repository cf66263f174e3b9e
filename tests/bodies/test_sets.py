"""A compiled scene is made of sets of stacked parts; its names follow from its structure alone."""

import jax
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar
from jaxmb.bodies import catalogue, parameters


@pytest.fixture(scope="module")
def system():
    bar = planar.Body("bar", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    forces = [mb.Gravity((0.0, -9.81)), planar.Torque("motor", "bar", torque=1.5)]
    tip = planar.Frame("tip", "bar", position=(0.5, 0.0))
    return mb.Scene([bar], joints=[pin], forces=forces, frames=[tip]).compile()


PLACES = {
    "bar.mass": ".bodies.groups",
    "pin.point_b": ".constraints.position",
    "motor.torque": ".forces.groups",
    "gravity.acceleration": ".forces.gravity",
    "tip.position": ".frames",
}


def test_parameter_stands_in_one_set(system):
    for name, place in PLACES.items():
        changed = mb.with_parameters(system, {name: np.asarray(mb.parameters(system)[name]) + 0.25})
        pairs = zip(jax.tree_util.tree_leaves_with_path(system), jax.tree.leaves(changed), strict=True)
        moved = [jax.tree_util.keystr(path) for (path, before), after in pairs if not np.array_equal(before, after)]
        assert len(moved) == 1 and moved[0].startswith(place)
        assert jax.tree.structure(changed) == jax.tree.structure(system)


def test_names_are_found_once_for_all_systems_of_a_structure(system, monkeypatch):
    quantities, names = list(system.quantities()), list(mb.parameters(system))
    heavier = mb.with_parameters(system, {"bar.mass": 2.0})

    def refuse(*_):
        raise AssertionError("names are searched again")

    monkeypatch.setattr(catalogue, "body_measures", refuse)
    monkeypatch.setattr(catalogue, "joint_coordinates", refuse)
    monkeypatch.setattr(parameters, "stacked_numbers", refuse)
    again = mb.with_parameters(heavier, {"bar.mass": 3.0})
    assert list(again.quantities()) == quantities and list(mb.parameters(again)) == names
    assert list(again.joint_coordinates()) == ["pin.angle"]
