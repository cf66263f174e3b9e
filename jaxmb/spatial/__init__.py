"""Parts of spatial scenes; `jaxmb help spatial` lists them, and the parts of both spaces stand in `jaxmb`.

Units are SI and radians; Euler parameters are scalar first, and angular velocities are in the body frame. Joints have
their own coordinates by name, `"hip.angle"` or `"slide.displacement"`, which `assemble` takes and `trajectory["hip"]`
shows with rates and accelerations. Forces, stops, motors, tendons and couplings of `jaxmb` act on them. Parts may name
a `Frame`, fixed in a body, in place of the body. Classes of your own derive from those of `jaxmb.parts`.
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
from ..parts.spatial.point_joints import PointOnLine as PointOnLine, PointOnPlane as PointOnPlane
from ..parts.spatial.rolling import RollingDisc as RollingDisc, RollingSphere as RollingSphere
from ..parts.tyre import Tyre as Tyre

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """The error for an unknown name, or for one of the last release."""
        now = {"TorsionalSpringDamper": "jaxmb.JointSpring on the angle of a joint"}.get(name)
        text = (
            f"module {__name__!r} has no attribute {name!r}" if now is None else f"jaxmb.spatial.{name} is {now} now."
        )
        raise AttributeError(text, name=name)
