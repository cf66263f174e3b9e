"""Parts of planar scenes."""

from .._forces import Damper as Damper
from .._forces import PointForce as PointForce
from .._forces import SpringDamper as SpringDamper
from .bodies import Body as Body
from .bodies import PointMass as PointMass
from .bodies import box as box
from .bodies import disc as disc
from .bodies import rod as rod
from .drivers import Driver as Driver
from .forces import Bushing as Bushing
from .forces import Torque as Torque
from .forces import TorsionalSpringDamper as TorsionalSpringDamper
from .joints import (
    Distance as Distance,
)
from .joints import (
    Fixed as Fixed,
)
from .joints import (
    Gear as Gear,
)
from .joints import (
    PointOnCurve as PointOnCurve,
)
from .joints import (
    PointOnLine as PointOnLine,
)
from .joints import (
    Prismatic as Prismatic,
)
from .joints import (
    RackAndPinion as RackAndPinion,
)
from .joints import (
    Revolute as Revolute,
)
from .nonholonomic import KnifeEdge as KnifeEdge
