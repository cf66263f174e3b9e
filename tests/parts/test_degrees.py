"""Numbers that are angles by their declared unit, given in degrees: a warning names the part and the number."""

import warnings

import numpy as np
import pytest

import jaxmb as mb
from jaxmb import contact, parts, planar, spatial, terrain


def of(part=None, space=planar, frames=()):
    """A rod on a pin and a cart on a rail with another part."""
    at, axis = (lambda x: (x, 0.0)), {}
    inertia, along = 0.1, (1.0, 0.0)
    if space is spatial:
        at, inertia, along, axis = (lambda x: (x, 0.0, 0.0)), np.eye(3), (1.0, 0.0, 0.0), {"axis": (0.0, 0.0, 1.0)}
    bodies = [space.Body(name, mass=1.0, inertia=inertia, position=at(x)) for name, x in (("rod", 0.5), ("cart", 3.0))]
    joints = [
        space.Revolute("pin", "ground", "rod", point=at(0.0), **axis),
        space.Prismatic("rail", "ground", "cart", point=at(3.0), axis=along),
    ]
    forces = [part] if isinstance(part, parts.AbstractForce) else []
    joints += [part] if part is not None and not forces else []
    return mb.Scene(bodies, joints=joints, forces=forces, frames=frames)


class Catch(parts.AbstractForce):
    """A user's own force with an angle."""

    name: str = parts.name()
    body: str = parts.body_name()
    beyond: parts.Number = parts.parameter(unit="rad")

    def wrenches(self, space, poses, velocities, t):
        return velocities * self.beyond


JANOSI = {"cohesion": 0.0, "shear_modulus": 0.01, "length": 0.1, "area": 0.01, "transition_speed": 0.1}


def on_ground(**law):
    laws = {"terrain": terrain.Flat(-2.0), "radius": 0.1, "normal": contact.Linear(1e3)}
    return planar.Contact("part", "rod", friction=contact.Janosi(**JANOSI, **law), **laws)


def along(cls, coordinate="pin.angle", **numbers):
    return cls("part", coordinate, **numbers)


# A number in degrees, its value, and the part.
DEGREES = {
    "Stop": ("lower", -45.0, along(mb.Stop, lower=-45.0)),
    "JointStop": ("upper", 30.0, along(mb.JointStop, lower=-1.0, upper=30.0, stiffness=1.0)),
    "JointDriver": ("value", 90.0, along(mb.JointDriver, value=90.0)),
    "JointSpring": ("free", 60.0, along(mb.JointSpring, stiffness=1.0, free=60.0)),
    "JointCoupling": (
        "other_zero",
        30.0,
        mb.JointCoupling("part", "rail.displacement", "pin.angle", coefficients=(0.0, 1.0), other_zero=30.0),
    ),
    "TableSpring": ("values", -30.0, along(mb.TableSpring, values=(-30.0, 0.0, 30.0), forces=(-1.0, 0.0, 1.0))),
    "Motor": ("command", 30.0, along(mb.Motor, mode="position", command=30.0, gain=1.0, lag=0.1)),
    "TorsionalSpringDamper": (
        "free_angle",
        180.0,
        planar.TorsionalSpringDamper("part", "ground", "rod", stiffness=1.0, free_angle=180.0),
    ),
    "Bushing": (
        "free_angle",
        15.0,
        planar.Bushing("part", "ground", "rod", stiffness=np.ones(3), point=(0.0, 0.0), free_angle=15.0),
    ),
    "a law": ("friction.friction_angle", 30.0, on_ground(friction_angle=30.0)),
    "a user's part": ("beyond", 20.0, Catch("part", "rod", beyond=20.0)),
}


@pytest.mark.slow(but=("Stop", "JointDriver", "Motor"))
@pytest.mark.parametrize("name", DEGREES)
def test_degrees_are_warned_of(name):
    field, value, part = DEGREES[name]
    scene = of(part)
    text = rf"'part', {field}: the angle {value:g} rad is more than a full turn; .*np.deg2rad\({value:g}\)"
    with pytest.warns(UserWarning, match=text) as caught:
        scene.compile()
    assert len(caught) == 1 and caught[0].filename == __file__


@pytest.mark.slow
def test_degrees_in_space_and_in_frames_are_warned_of():
    spring = mb.JointSpring("spring", "pin.angle", stiffness=1.0, free=0.1, middle=90.0)
    with pytest.warns(UserWarning, match="'spring', middle: the angle 90 rad"):
        of(spring, spatial).compile()
    with pytest.warns(UserWarning, match="'seen', angle: the angle 45 rad"):
        of(frames=[planar.Frame("seen", "rod", angle=45.0)]).compile()


# Numbers that look like degrees and are not angles, and angles of several turns.
RIGHT = {
    "a length": along(mb.Stop, "rail.displacement", lower=-30.0, upper=30.0),
    "a speed": along(mb.JointDriver, value=0.0, rate=30.0),
    "a command of speed": along(mb.Motor, mode="speed", command=30.0, gain=1.0, lag=0.1),
    "a command of force": along(mb.Motor, command=30.0, lag=0.1),
    "a position": along(mb.Motor, "rail.displacement", mode="position", command=30.0, gain=1.0, lag=0.1),
    "a moment": along(mb.JointForce, force=30.0),
    "turns of a winch": along(mb.JointStop, lower=0.0, upper=40 * np.pi, stiffness=1.0),
    "a turn and a half": along(mb.JointDriver, value=3 * np.pi),
    "less than a turn": along(mb.Stop, lower=-5.0, upper=5.0),
}


@pytest.mark.slow(but=("a command of speed", "turns of a winch"))
@pytest.mark.parametrize("name", RIGHT)
def test_other_numbers_are_not_warned_of(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        of(RIGHT[name]).compile()


def test_degrees_of_a_changed_parameter_are_warned_of():
    system = of(mb.JointStop("stop", "pin.angle", lower=-1.0, upper=1.0, stiffness=1.0)).compile()
    with pytest.warns(UserWarning, match="'stop', upper: the angle 30 rad") as caught:
        mb.with_parameters(system, {"stop.upper": 30.0})
    assert caught[0].filename == __file__ and len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mb.with_parameters(system, {"stop.stiffness": 30.0, "stop.upper": 1.2})


# Parts that act on the ground alone.
ON_GROUND = {
    "PointForce": planar.PointForce("part", "ground", force=(1.0, 0.0)),
    "PointForce on a frame": planar.PointForce("part", "post", force=(1.0, 0.0)),
    "SpringDamper": planar.SpringDamper("part", "ground", "post", stiffness=1.0, point_a=(0.0, 1.0)),
    "Force": mb.Force("part", "ground", lambda x, v, t, p: x),
    "Contact": planar.Contact("part", "ground", terrain=terrain.Flat(), radius=0.1, normal=contact.Linear(1e3)),
    "RigidContact": mb.RigidContact("part", "ground", terrain=terrain.Flat(-1.0), radius=0.1),
    "Revolute": planar.Revolute("part", "ground", "post", point=(0.0, 0.0)),
    "KnifeEdge": planar.KnifeEdge("part", "ground"),
    "Rope": mb.Rope("part", [("ground", (0.0, 0.0)), ("post", (1.0, 0.0))], stiffness=10.0),
}


@pytest.mark.slow(but=("PointForce", "RigidContact"))
@pytest.mark.parametrize("name", ON_GROUND)
def test_parts_that_act_on_the_ground_alone_are_refused(name):
    with pytest.raises(ValueError, match=r"'part' acts on the ground alone, .*; name a body"):
        of(ON_GROUND[name], frames=[planar.Frame("post", "ground", position=(0.0, 0.5))]).compile()


@pytest.mark.slow
def test_a_force_of_a_body_with_a_frame_in_the_ground():
    post = planar.Frame("post", "ground", position=(0.0, 0.5))
    of(planar.SpringDamper("part", "post", "rod", stiffness=1.0), frames=[post]).compile()
