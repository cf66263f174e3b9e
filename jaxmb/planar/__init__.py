"""Parts of planar scenes."""

from .._forces import Damper as Damper, PointForce as PointForce, SpringDamper as SpringDamper
from .._friction import Friction as Friction
from ..contact import Contact as Contact
from .bodies import Body as Body, PointMass as PointMass, box as box, disc as disc, rod as rod
from .couplers import DraftGear as DraftGear
from .drivers import Driver as Driver
from .forces import (
    BumpStop as BumpStop,
    Bushing as Bushing,
    Torque as Torque,
    TorsionalSpringDamper as TorsionalSpringDamper,
)
from .joints import (
    Distance as Distance,
    Fixed as Fixed,
    Gear as Gear,
    PointOnCurve as PointOnCurve,
    PointOnLine as PointOnLine,
    Prismatic as Prismatic,
    RackAndPinion as RackAndPinion,
    Revolute as Revolute,
)
from .nonholonomic import KnifeEdge as KnifeEdge
from .track import Track as Track
