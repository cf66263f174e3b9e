"""Parts of planar scenes."""

from ..parts.contact import Contact as Contact
from ..parts.forces import Damper as Damper, PointForce as PointForce, SpringDamper as SpringDamper
from ..parts.friction import Friction as Friction
from ..parts.planar.bodies import (
    AbstractRigidBody as AbstractRigidBody,
    Body as Body,
    PointMass as PointMass,
    box as box,
    disc as disc,
    rod as rod,
)
from ..parts.planar.body_contact import DiscContact as DiscContact, PlateContact as PlateContact
from ..parts.planar.draft_gear import DraftGear as DraftGear
from ..parts.planar.drivers import Driver as Driver
from ..parts.planar.forces import (
    BumpStop as BumpStop,
    Bushing as Bushing,
    Torque as Torque,
    TorsionalSpringDamper as TorsionalSpringDamper,
)
from ..parts.planar.frames import Frame as Frame
from ..parts.planar.joints import (
    Distance as Distance,
    Fixed as Fixed,
    Gear as Gear,
    PointOnCurve as PointOnCurve,
    PointOnLine as PointOnLine,
    Prismatic as Prismatic,
    RackAndPinion as RackAndPinion,
    Revolute as Revolute,
)
from ..parts.planar.knife_edge import KnifeEdge as KnifeEdge
from ..parts.planar.track import Track as Track
from ..parts.planar.tyre import Tyre as Tyre
