"""Scenes that are made of others."""

import pytest

import jaxmb as mb
from jaxmb import planar


def test_a_scene_is_extended():
    scene = mb.mechanisms.get("four_bar").scene
    mass, mark = planar.PointMass("mass", mass=1.0), planar.Frame("mark", "crank", position=(0.1, 0.0))
    rod = planar.Distance("rod", "ground", "mass", point_a=(0.0, 0.0), length=1.0)
    motor = planar.Torque("motor", "crank", torque=1.0)
    more = scene.extended(bodies=[mass], joints=[rod], forces=[motor], frames=[mark], without=["D"])
    assert more.bodies == (*scene.bodies, mass) and more.frames == (mark,)
    assert more.joints == (*(own for own in scene.joints if own.name != "D"), rod)
    assert more.forces == (*scene.forces, motor)
    with pytest.raises(ValueError, match="without: Unknown part 'E'"):
        scene.extended(without=["E"])
    with pytest.raises(ValueError, match="motor"):
        more.extended(forces=[motor])
