# ruff: noqa: I001
"""Parts of spatial scenes: bodies, joints, forces, ground and contact.

Units are SI and radians; Euler parameters are scalar first, and angular velocities are in the body frame. Joints have
coordinates by name, `"hip.angle"` or `"slide.displacement"`, which `assemble` takes and `trajectory["hip"]` shows with
rates and accelerations. Parts of `jaxmb` act on these coordinates: `JointSpring` and `Motor` on one, `Tendon` on
several, among others. Further parts are `RigidContact` and other unilateral constraints, `DryFriction`, `Servo`,
`Controller`, and parts with functions of the user, such as `Force`. `jaxmb help` lists them. Parts may name a `Frame`,
fixed in a body, in place of the body. New classes derive from the classes of `jaxmb.parts`.
"""

from .._moved import tell_of_moved as _tell_of_moved

## Bodies
from ..parts.spatial.bodies import (
    Body as Body,
    PointMass as PointMass,
    AbstractRigidBody as AbstractRigidBody,
    rod as rod,
    box as box,
    cylinder as cylinder,
    disc as disc,
    sphere as sphere,
)
from ..parts.spatial.frames import Frame as Frame
from ..parts.spatial.elastic import ElasticBody as ElasticBody, ElasticBar as ElasticBar
from ..parts.elastic import ModalFrame as ModalFrame, BarFrame as BarFrame

## Joints
from ..parts.spatial.joints import (
    Spherical as Spherical,
    Revolute as Revolute,
    Universal as Universal,
    Gimbal as Gimbal,
    Cylindrical as Cylindrical,
    Prismatic as Prismatic,
    Screw as Screw,
    Planar as Planar,
    Fixed as Fixed,
)
from ..parts.distance import Distance as Distance
from ..parts.beam import InextensibleBeam as InextensibleBeam
from ..parts.spatial.point_joints import PointOnLine as PointOnLine, PointOnPlane as PointOnPlane
from ..parts.spatial.composite import Composite as Composite
from ..parts.knife_edge import KnifeEdge as KnifeEdge
from ..parts.spatial.rolling import RollingDisc as RollingDisc, RollingSphere as RollingSphere
from ..parts.drivers import Driver as Driver

## Forces
from ..parts.forces import SpringDamper as SpringDamper, Damper as Damper, PointForce as PointForce
from ..parts.forces import RotationalDamper as RotationalDamper, Torque as Torque
from ..parts.bushing import Bushing as Bushing
from ..parts.beam import Beam as Beam
from ..parts.beam_chain import beam_chain as beam_chain, BeamChain as BeamChain
from ..parts.cylinder import Cylinder as Cylinder
from ..parts.friction import Friction as Friction

## Ground and contact
from ..parts.contact import Contact as Contact
from ..parts.tyre import Tyre as Tyre
from ..parts.magic_formula_tyre import MagicFormulaTyre as MagicFormulaTyre

_tell_of_moved(__name__, TorsionalSpringDamper="jaxmb.JointSpring on the angle of a joint")
