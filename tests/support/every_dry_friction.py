"""Dry friction in every kind of joint and contact that has some, in small scenes whose contacts may be closed."""

import numpy as np

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import terrain

_MOVING_3D = {"velocity": (0.5, 0.2, -0.7), "angular_velocity": (0.6, -0.3, 0.2)}


def _body_2d(name, x=0.4, y=0.9, spin=0.6):
    return planar.Body(
        name, mass=1.5, inertia=0.2, position=(x, y), angle=0.2, velocity=(0.5, -0.7), angular_velocity=spin
    )


def _body_3d(name, x=0.4, z=0.9, **moving):
    moving = _MOVING_3D | moving
    return spatial.Body(name, mass=1.5, inertia=(0.2, 0.25, 0.3), position=(x, 0.1, z), **moving)


def _rub(**options):
    return mb.DryFriction("rub", "joint", coefficient=0.3, **options)


_AXIS = tuple(np.array([1.0, 2.0]) / np.sqrt(5))
# Scenes of bodies and joints, and the friction.
FRICTIONS = {
    "slide": (
        [_body_2d("a")],
        [planar.Prismatic("joint", "ground", "a", axis=_AXIS, point_a=(0.0, 0.1), point_b=(0.2, 0.0))],
        _rub(),
    ),
    "pin": (
        [_body_2d("a"), _body_2d("b", x=1.2, spin=-0.4)],
        [planar.Revolute("joint", "a", "b", point=(0.8, 0.8))],
        _rub(radius=0.1, static_coefficient=0.5),
    ),
    "spatial slide": (
        [_body_3d("a"), _body_3d("b", x=1.2)],
        [spatial.Prismatic("joint", "a", "b", point=(0.8, 0.1, 0.9), axis=(0.6, 0.0, 0.8))],
        _rub(),
    ),
    "hinge": (
        [_body_3d("a")],
        [spatial.Revolute("joint", "ground", "a", point=(0.0, 0.1, 0.5), axis=(0.0, 1.0, 0.0))],
        _rub(radius=0.05),
    ),
    "sleeve": (
        [_body_3d("a"), _body_3d("b", x=1.2, velocity=(0.1, 0.4, 0.3), angular_velocity=(-0.4, 0.2, 0.5))],
        [spatial.Cylindrical("joint", "a", "b", point=(0.8, 0.1, 0.9), axis=(0.6, 0.0, 0.8))],
        _rub(radius=0.05, static_coefficient=0.5),
    ),
    "face": (
        [_body_3d("a")],
        [spatial.Planar("joint", "ground", "a", point=(0.0, 0.1, 0.5), axis=(0.0, 0.6, 0.8))],
        _rub(speed=(0.3, -0.2)),
    ),
    "one angle of a cardan joint": (
        [_body_3d("a"), _body_3d("b", x=1.2, velocity=(0.1, 0.4, 0.3), angular_velocity=(-0.4, 0.2, 0.5))],
        [
            spatial.Universal(
                "joint", "a", "b", point=(0.8, 0.1, 0.9), axis_a_W=(1.0, 0.0, 0.0), axis_b_W=(0.0, 1.0, 0.0)
            )
        ],
        mb.DryFriction("rub", "joint.angle_a", coefficient=0.3, radius=0.05),
    ),
    "brake on a pin": (
        [_body_2d("a"), _body_2d("b", x=1.2, spin=-0.4)],
        [planar.Revolute("joint", "a", "b", point=(0.8, 0.8))],
        mb.JointFriction("rub", "joint.angle", force=0.3, static_force=0.5, exact=True),
    ),
    "seal of a sleeve": (
        [_body_3d("a")],
        [spatial.Cylindrical("joint", "ground", "a", point=(0.0, 0.1, 0.5), axis=(0.6, 0.0, 0.8))],
        mb.JointFriction("rub", "joint.displacement", force=0.3, exact=True),
    ),
    "disc on a belt": (
        [_body_2d("a")],
        [mb.RigidContact("joint", "a", terrain=terrain.Bump(start=0.0, length=2.0, peak=0.2), radius=0.1)],
        _rub(speed=0.4),
    ),
    "disc on a slope": (
        [_body_2d("a")],
        [mb.RigidContact("joint", "a", terrain=terrain.Bump(start=0.0, length=2.0, peak=0.2), radius=0.1)],
        _rub(),
    ),
    "point on a plane that moves": (
        [_body_2d("a", y=0.0), _body_2d("b")],
        [mb.RigidPlaneContact("joint", "a", "b", normal=(0.0, 1.0), point_b=(0.1, -0.3))],
        _rub(),
    ),
    "disc on a corner": (
        [_body_2d("a", y=0.0), _body_2d("b")],
        [mb.RigidBoxContact("joint", "a", "b", size=(0.4, 1.0), radius=0.2)],
        _rub(),
    ),
    "two discs": (
        [_body_2d("a", y=0.0), _body_2d("b")],
        [mb.RigidBallContact("joint", "a", "b", radius_a=0.2, radius_b=0.4)],
        _rub(static_coefficient=0.4),
    ),
    "ball on a slope": (
        [_body_3d("a")],
        [mb.RigidContact("joint", "a", terrain=terrain.Bump(start=0.0, length=2.0, peak=0.2), radius=0.1)],
        _rub(),
    ),
    "ball on a plane that moves": (
        [_body_3d("a", z=0.0), _body_3d("b")],
        [mb.RigidPlaneContact("joint", "a", "b", normal=(0.0, 0.6, 0.8), point_b=(0.1, 0.0, -0.3), radius=0.2)],
        _rub(static_coefficient=0.4),
    ),
    "ball on an edge": (
        [_body_3d("a", z=0.0), _body_3d("b", x=0.7)],
        [mb.RigidBoxContact("joint", "a", "b", size=(0.4, 2.0, 1.0), radius=0.2)],
        _rub(),
    ),
    "two balls": (
        [_body_3d("a", z=0.0), _body_3d("b", x=0.6)],
        [mb.RigidBallContact("joint", "a", "b", radius_a=0.2, radius_b=0.4)],
        _rub(),
    ),
}


def friction_scene(name):
    """A scene of the table, with gravity."""
    bodies, joints, friction = FRICTIONS[name]
    down = (0.0, -9.81) if bodies[0].dimension == 2 else (0.0, 0.0, -9.81)
    return mb.Scene(bodies, joints=joints, forces=[friction, mb.Gravity(down)]).compile()
