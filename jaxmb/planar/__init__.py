"""Parts of planar scenes.

- Bodies: `Body`, `PointMass`; `rod`, `box` and `disc` are moments of inertia.
- Joints: `Revolute`, `Prismatic`, `Fixed`, `Distance`, `PointOnLine`, `PointOnCurve`, `Gear`, `RackAndPinion`;
  `KnifeEdge` rolls without slipping; `Driver` prescribes a motion.
- Forces: `SpringDamper`, `TorsionalSpringDamper`, `Damper`, `Bushing`, `Torque`, `PointForce`, `BumpStop`,
  `DraftGear`; `Friction` in joints, from the joint's actual reaction.
- Ground and contact: `Contact` of points and wheels on a terrain of `jaxmb.terrain`, with laws of `jaxmb.contact`;
  `Tyre` with slip and relaxation; `Track` around wheels; `PlateContact` of a disc on plates or a closed chain of them,
  `DiscContact` of a disc on discs.
- Rigid contact, from `jaxmb`: `Stop` at the ends of a coordinate's range, `RigidContact` of points and discs with a
  terrain, `RigidBallContact` of two discs, `RigidPlaneContact`, `RigidBoxContact`, `Slack` in ropes and couplings;
  impacts happen at their exact times. `DryFriction` in them, and in joints, sticks exactly.
- `Frame`: a named frame fixed in a body, which parts may name in its place, and which measures as an accelerometer and
  a gyroscope there do.

Units are SI and radians; y is up by convention. Joints have their own coordinates by name, `"hip.angle"` or
`"slide.displacement"`, which `assemble` takes and `trajectory["hip"]` shows with rates and accelerations. On them act,
from `jaxmb`, `JointSpring`, `JointForce`, `Actuator`, `JointStop`, `JointFriction`, `JointDriver` and `JointInertia`;
on several, `JointCoupling`, `FixedTendon` along joints, through full turns, and `Tendon` from point to point. `Motor`
is a force, speed or position whose force lags, with a limit; `Controller` a function of named measurements, with a
memory. `Servo` enforces any position constraint by a control force. `Constraint`, `VelocityConstraint`, `Force` and
`NonIdeal` are functions of the user's; classes of one's own derive from those of `jaxmb.parts`.
"""

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
