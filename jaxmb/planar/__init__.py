# ruff: noqa: I001
"""Parts of planar scenes: bodies, joints, forces, ground and contact.

Units are SI and radians; y is up by convention. Joints have coordinates by name, `"hip.angle"` or
`"slide.displacement"`, which `assemble` takes and `trajectory["hip"]` shows with rates and accelerations. Parts of
`jaxmb` act on these coordinates: `JointSpring` and `Motor` on one, `Tendon` on several, among others. Further parts are
`RigidContact` and other unilateral constraints, `DryFriction`, `Servo`, `Controller`, and parts with functions of the
user, such as `Force`. `jaxmb help` lists them. Parts may name a `Frame`, fixed in a body, in place of the body. New
classes derive from the classes of `jaxmb.parts`.
"""

from .._moved import tell_of_moved as _tell_of_moved

## Bodies
from ..parts.planar.bodies import Body as Body, PointMass as PointMass, AbstractRigidBody as AbstractRigidBody
from ..parts.planar.bodies import rod as rod, box as box, disc as disc
from ..parts.planar.frames import Frame as Frame
from ..parts.planar.elastic import ElasticBody as ElasticBody, ElasticBar as ElasticBar
from ..parts.elastic import ModalFrame as ModalFrame, BarFrame as BarFrame

## Joints
from ..parts.planar.joints import (
    Revolute as Revolute,
    Prismatic as Prismatic,
    Fixed as Fixed,
    PointOnLine as PointOnLine,
    PointOnCurve as PointOnCurve,
    Gear as Gear,
    RackAndPinion as RackAndPinion,
)
from ..parts.distance import Distance as Distance
from ..parts.beam import InextensibleBeam as InextensibleBeam
from ..parts.knife_edge import KnifeEdge as KnifeEdge
from ..parts.drivers import Driver as Driver

## Forces
from ..parts.forces import SpringDamper as SpringDamper, Damper as Damper, PointForce as PointForce
from ..parts.forces import RotationalDamper as RotationalDamper, Torque as Torque
from ..parts.planar.torsion import TorsionalSpringDamper as TorsionalSpringDamper
from ..parts.bushing import Bushing as Bushing
from ..parts.beam import Beam as Beam
from ..parts.beam_chain import beam_chain as beam_chain, BeamChain as BeamChain
from ..parts.cylinder import Cylinder as Cylinder
from ..parts.planar.draft_gear import DraftGear as DraftGear
from ..parts.friction import Friction as Friction

## Ground and contact
from ..parts.contact import Contact as Contact
from ..parts.tyre import Tyre as Tyre
from ..parts.planar.track import Track as Track
from ..parts.planar.body_contact import PlateContact as PlateContact, DiscContact as DiscContact

_tell_of_moved(__name__, BumpStop="jaxmb.JointStop(..., exponent=3.0) on the angle of a joint")
