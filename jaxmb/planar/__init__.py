"""Parts of planar scenes; `jaxmb help planar` lists them, and the parts of both spaces stand in `jaxmb`.

Units are SI and radians; y is up by convention. Joints have their own coordinates by name, `"hip.angle"` or
`"slide.displacement"`, which `assemble` takes and `trajectory["hip"]` shows with rates and accelerations. Forces,
stops, motors, tendons and couplings of `jaxmb` act on them. Parts may name a `Frame`, fixed in a body, in place of the
body. Classes of your own derive from those of `jaxmb.parts`.
"""

from typing import TYPE_CHECKING

from ..parts.bushing import Bushing as Bushing
from ..parts.contact import Contact as Contact
from ..parts.distance import Distance as Distance
from ..parts.drivers import Driver as Driver
from ..parts.forces import (
    Damper as Damper,
    PointForce as PointForce,
    RotationalDamper as RotationalDamper,
    SpringDamper as SpringDamper,
    Torque as Torque,
)
from ..parts.friction import Friction as Friction
from ..parts.knife_edge import KnifeEdge as KnifeEdge
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
from ..parts.planar.frames import Frame as Frame
from ..parts.planar.joints import (
    Fixed as Fixed,
    Gear as Gear,
    PointOnCurve as PointOnCurve,
    PointOnLine as PointOnLine,
    Prismatic as Prismatic,
    RackAndPinion as RackAndPinion,
    Revolute as Revolute,
)
from ..parts.planar.torsion import TorsionalSpringDamper as TorsionalSpringDamper
from ..parts.planar.track import Track as Track
from ..parts.tyre import Tyre as Tyre

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """The error for an unknown name, or for one of the last release."""
        now = {"BumpStop": "jaxmb.JointStop(..., exponent=3.0) on the angle of a joint"}.get(name)
        text = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(f"jaxmb.planar.{name} is {now} now." if now else text, name=name)
