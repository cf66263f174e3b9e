# ruff: noqa: I001
"""Parts of spatial scenes: bodies, joints, forces, ground and contact.

Units are SI and radians; Euler parameters are scalar first, and angular velocities are in the body frame. Joints have
their own coordinates by name, `"hip.angle"` or `"slide.displacement"`, which `assemble` takes and `trajectory["hip"]`
shows with rates and accelerations. Parts of `jaxmb` act on them, such as `JointSpring` and `Motor` on one coordinate,
`Tendon` on several. So do `RigidContact` and other unilateral constraints, `DryFriction`, `Servo`, `Controller`, and
`Force` and other functions of the user's. `jaxmb help` lists them. Classes of one's own derive from those of
`jaxmb.parts`.
"""

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
from ..parts.spatial.point_joints import Distance as Distance, PointOnLine as PointOnLine, PointOnPlane as PointOnPlane
from ..parts.spatial.composite import Composite as Composite
from ..parts.spatial.rolling import KnifeEdge as KnifeEdge, RollingDisc as RollingDisc, RollingSphere as RollingSphere
from ..parts.spatial.drivers import Driver as Driver

## Forces
from ..parts.forces import SpringDamper as SpringDamper, Damper as Damper, PointForce as PointForce
from ..parts.spatial.forces import (
    TorsionalSpringDamper as TorsionalSpringDamper,
    RotationalDamper as RotationalDamper,
    Bushing as Bushing,
    Torque as Torque,
)
from ..parts.friction import Friction as Friction

## Ground and contact
from ..parts.contact import Contact as Contact
from ..parts.spatial.tyre import Tyre as Tyre
