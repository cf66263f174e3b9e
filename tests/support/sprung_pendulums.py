"""Pendulums on a spring, each with names of parameters, what is fixed at the start, and a coordinate."""

import diffrax
import optimistix as optx

import jaxmb as mb
from jaxmb import planar

SPRING = planar.SpringDamper(
    "spring",
    "ground",
    "rod",
    stiffness=30.0,
    damping=0.3,
    free_length=0.5,
    point_a=(0.4, 1.0),
    point_b=(0.2, 0.1),
)
GRAVITY = mb.Gravity((0.0, -9.81))


def rod(name="rod", position=(0.5, 0.0)):
    return planar.Body(name, mass=1.5, inertia=0.2, position=position, velocity=(1.0, 0.0))


def pendulum(*joints):
    """A rod on a pin, with its rate at the start."""
    pin = planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    system = mb.Scene([rod()], joints=[pin, *joints], forces=[SPRING, GRAVITY]).compile()
    return system, ["rod.mass", "rod.inertia", "pin.point_b", "spring.stiffness"], {"rod.angle": 0.0}, "rod.angle"


def double_pendulum():
    joints = [
        planar.Revolute("pin", "ground", "rod", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
        planar.Revolute("knee", "rod", "shank", point_a=(0.5, 0.0), point_b=(-0.5, 0.0)),
    ]
    bodies = [rod(), rod("shank", (1.5, 0.0))]
    system = mb.Scene(bodies, joints=joints, forces=[SPRING, GRAVITY]).compile()
    fix = {"rod.angle": 0.0, "shank.angle": 0.0}
    return system, ["rod.mass", "shank.inertia", "knee.point_a", "spring.stiffness"], fix, "rod.angle"


# The rod is at this angle.
HANGING = diffrax.Event(lambda t, y, args, **kwargs: y.q[2] + 0.3, optx.Newton(rtol=1e-13, atol=1e-13))
