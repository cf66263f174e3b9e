"""Parts of spatial scenes."""

from ..parts.contact import Contact as Contact
from ..parts.forces import Damper as Damper, PointForce as PointForce, SpringDamper as SpringDamper
from ..parts.friction import Friction as Friction
from ..parts.spatial.bodies import (
    AbstractRigidBody as AbstractRigidBody,
    Body as Body,
    PointMass as PointMass,
    box as box,
    cylinder as cylinder,
    disc as disc,
    rod as rod,
    sphere as sphere,
)
from ..parts.spatial.composite import Composite as Composite
from ..parts.spatial.drivers import Driver as Driver
from ..parts.spatial.forces import (
    Bushing as Bushing,
    RotationalDamper as RotationalDamper,
    Torque as Torque,
    TorsionalSpringDamper as TorsionalSpringDamper,
)
from ..parts.spatial.frames import Frame as Frame
from ..parts.spatial.joints import (
    Cylindrical as Cylindrical,
    Fixed as Fixed,
    Gimbal as Gimbal,
    Planar as Planar,
    Prismatic as Prismatic,
    Revolute as Revolute,
    Screw as Screw,
    Spherical as Spherical,
    Universal as Universal,
)
from ..parts.spatial.point_joints import Distance as Distance, PointOnLine as PointOnLine, PointOnPlane as PointOnPlane
from ..parts.spatial.rolling import KnifeEdge as KnifeEdge, RollingDisc as RollingDisc, RollingSphere as RollingSphere
from ..parts.spatial.tyre import Tyre as Tyre
