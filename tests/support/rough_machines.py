"""Machines whose joints are not all ideal, by friction and by servos."""

import functools

import jax.numpy as jnp
import numpy as np

import jaxmb as mb
from jaxmb import planar, spatial

GRAVITY = mb.Gravity((0.0, -9.81))


def sine(t, p):
    return p["amplitude"] * jnp.sin(t)


@functools.cache
def sledge():
    """A block on an inclined rail with friction, starting uphill."""
    slope = (np.cos(0.3), np.sin(0.3))
    block = planar.Body("block", mass=2.0, inertia=1.0, position=(0.0, 0.0), velocity=(3 * slope[0], 3 * slope[1]))
    rail = planar.Prismatic("rail", "ground", "block", point=(0.0, 0.0), axis=slope)
    rub = planar.Friction("rub", "rail", coefficient=0.2)
    return mb.Scene([block], joints=[rail], forces=[GRAVITY, rub]).compile()


@functools.cache
def pendulum():
    """A pendulum whose pin rubs."""
    arm = planar.Body("arm", mass=1.5, inertia=0.1, position=(0.5, 0.0))
    pin = planar.Revolute("pin", "ground", "arm", point=(0.0, 0.0))
    rub = planar.Friction("rub", "pin", coefficient=0.3, radius=0.05)
    return mb.Scene([arm], joints=[pin], forces=[GRAVITY, rub]).compile()


@functools.cache
def manipulator():
    """A double pendulum with joint friction and a servo that moves its tip along a line."""
    bodies = [
        planar.Body("upper", mass=2.0, inertia=0.2, position=(0.4, 0.3), angle=0.6),
        planar.Body("lower", mass=1.0, inertia=0.1, position=(1.1, 0.3), angle=-0.7),
    ]
    joints = [
        planar.Revolute("shoulder", "ground", "upper", point_a=(0.0, 0.0), point_b=(-0.5, 0.0)),
        planar.Revolute("elbow", "upper", "lower", point_a=(0.5, 0.0), point_b=(-0.4, 0.0)),
        mb.Servo(
            planar.Driver("tip", "ground", "lower", quantity="y", motion=sine, parameters={"amplitude": 0.2}),
            damping=6.0,
            stiffness=9.0,
        ),
    ]
    rub = planar.Friction("rub", "elbow", coefficient=0.2, radius=0.1)
    return mb.Scene(bodies, joints=joints, forces=[GRAVITY, rub]).compile()


@functools.cache
def carriage():
    """A body in space on a rail with friction, with an arm that a servo swings."""
    bodies = [
        spatial.Body("carriage", mass=3.0, inertia=(0.3, 0.2, 0.4), position=(0.1, 0.0, 0.0)),
        spatial.Body("arm", mass=1.0, inertia=(0.02, 0.2, 0.2), position=(0.5, 0.0, 0.0)),
    ]
    joints = [
        spatial.Prismatic("rail", "ground", "carriage", point=(0.1, 0.0, 0.0), axis=(1.0, 0.0, 0.0)),
        spatial.Revolute("hinge", "carriage", "arm", point=(0.1, 0.0, 0.0), axis=(0.0, 1.0, 0.0)),
        mb.Servo(
            mb.Constraint(
                "swing",
                "arm",
                lambda p, t, own: p[0, 3:4] * 2 * p[0, 5] - own["target"],
                parameters={"target": 0.1},
                rheonomic=False,
            ),
            damping=2.0,
            stiffness=1.0,
        ),
    ]
    forces = [
        mb.Gravity((0.0, 0.0, -9.81)),
        spatial.Friction("rub", "rail", coefficient=0.1),
        spatial.Friction("pin", "hinge", coefficient=0.2, radius=0.03),
    ]
    return mb.Scene(bodies, joints=joints, forces=forces).compile()


SCENES = {"sledge": sledge, "pendulum": pendulum, "manipulator": manipulator, "carriage": carriage}
