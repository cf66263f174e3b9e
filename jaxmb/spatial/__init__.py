"""Parts of spatial scenes."""

from .._forces import Damper as Damper, PointForce as PointForce, SpringDamper as SpringDamper
from .._friction import Friction as Friction
from ..contact import Contact as Contact
from .bodies import (
    Body as Body,
    PointMass as PointMass,
    box as box,
    cylinder as cylinder,
    disc as disc,
    rod as rod,
    sphere as sphere,
)
from .drivers import Driver as Driver
from .forces import Bushing as Bushing, Torque as Torque, TorsionalSpringDamper as TorsionalSpringDamper
from .joints import (
    Cylindrical as Cylindrical,
    Distance as Distance,
    Fixed as Fixed,
    Planar as Planar,
    PointOnLine as PointOnLine,
    PointOnPlane as PointOnPlane,
    Prismatic as Prismatic,
    Revolute as Revolute,
    Screw as Screw,
    Spherical as Spherical,
    Universal as Universal,
)
from .nonholonomic import KnifeEdge as KnifeEdge, RollingDisk as RollingDisk, RollingSphere as RollingSphere
