"""Parts of spatial scenes.

- Bodies: `Body`, `PointMass`; `rod`, `box`, `cylinder`, `disc` and `sphere` are inertia matrices.
- Joints: `Spherical`, `Revolute`, `Universal`, `Gimbal`, `Cylindrical`, `Prismatic`, `Screw`, `Planar`, `Fixed`,
  `Distance`, `PointOnLine`, `PointOnPlane`; `Composite` of hinges and slides in succession, without mass in between;
  `KnifeEdge`, `RollingDisc` and `RollingSphere` roll without slipping; `Driver` prescribes a motion.
- Forces: `SpringDamper`, `TorsionalSpringDamper`, `Damper`, `RotationalDamper`, `Bushing`, `Torque`, `PointForce`;
  `Friction` in joints, from the joint's actual reaction.
- Ground: `Contact` of points and balls on a terrain of `jaxmb.terrain`, with laws of `jaxmb.contact`; `Tyre`.
- Rigid contact, from `jaxmb`: `Stop` at the ends of a coordinate's range, `RigidContact` of points and balls with a
  terrain, `RigidBallContact` of two balls, `RigidPlaneContact`, `RigidBoxContact`, `Slack` in ropes and couplings;
  impacts happen at their exact times. `DryFriction` in them, and in joints, sticks exactly.
- `Frame`: a named frame fixed in a body, which parts may name in its place, and which measures as an accelerometer and
  a gyroscope there do.

Units are SI and radians; Euler parameters are scalar first, and angular velocities are in the body frame. Joints have
their own coordinates by name, `"hip.angle"` or `"slide.displacement"`, which `assemble` takes and `trajectory["hip"]`
shows with rates and accelerations. On them act, from `jaxmb`, `JointSpring`, `JointForce`, `Actuator`, `JointStop`,
`JointFriction`, `JointDriver` and `JointInertia`; on several, `JointCoupling`, `FixedTendon` along joints, through
full turns, and `Tendon` from point to point. `Motor` is a force, speed or position whose force lags, with a limit;
`Controller` a function of named measurements, with a memory. `Servo` enforces any position constraint by a control
force. `Constraint`, `VelocityConstraint`, `Force` and `NonIdeal` are functions of the user's; classes of one's own
derive from those of `jaxmb.parts`.
"""

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
