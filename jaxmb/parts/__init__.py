"""The parts of a scene: base classes and field declarations, also for user-defined parts.

```python
from jaxmb import parts

class Maxwell(parts.AbstractPointPair, parts.AbstractDynamicForce):
    stiffness: parts.Number = parts.parameter(unit="N/m", sign="positive")
    damping: parts.Number = parts.parameter(unit="N s/m", sign="positive")
    tension: parts.Number = parts.internal_state(unit="N")

    def wrenches(self, space, poses, velocities, t):
        d = parts.separation(space, self, poses)
        return parts.force_pair(space, self, poses, -self.tension * d / jaxmb.rotations.norm(d))

    def state_rates(self, space, poses, velocities, t):
        d, rate = parts.separation(space, self, poses), parts.separation_rate(space, self, poses, velocities)
        return {"tension": self.stiffness * (d @ rate / jaxmb.rotations.norm(d) - self.tension / self.damping)}

tie = Maxwell("tie", "ground", "bar", stiffness=100.0, damping=20.0, point_a=(0.0, 1.0))
system = jaxmb.Scene([bar], joints=[pin], forces=[tie]).compile()
```

Where points, axes and joints of a part are inputs, `separation_rate`, and `rate_of` for other functions of the part and
the poses, contain their rates; those of other numbers where the class names them, `moving = ("length",)`.

A part is a class derived from one of the base classes. Helpers declare the meaning of its fields (`point()`, `axis()`,
`length()`, `parameter()`, …), annotated with `Number`, `Numbers` (by name) or `Names`; its kernel is a pure function of
the poses of its bodies. For examples of a joint, a force and a contact law see `notebooks/05_extending.ipynb`.
"""

from .base import (
    AbstractActor as AbstractActor,
    AbstractAxisJoint as AbstractAxisJoint,
    AbstractBody as AbstractBody,
    AbstractCompound as AbstractCompound,
    AbstractConstraint as AbstractConstraint,
    AbstractDynamicForce as AbstractDynamicForce,
    AbstractForce as AbstractForce,
    AbstractInertialConstraint as AbstractInertialConstraint,
    AbstractJoint as AbstractJoint,
    AbstractLaw as AbstractLaw,
    AbstractLink as AbstractLink,
    AbstractNonIdeal as AbstractNonIdeal,
    AbstractPair as AbstractPair,
    AbstractPart as AbstractPart,
    AbstractPlanarPart as AbstractPlanarPart,
    AbstractPointPair as AbstractPointPair,
    AbstractPotentialForce as AbstractPotentialForce,
    AbstractSpatialPart as AbstractSpatialPart,
    AbstractTendon as AbstractTendon,
    AbstractVelocityConstraint as AbstractVelocityConstraint,
)
from .contact import (
    AbstractContact as AbstractContact,
    AbstractFrictionLaw as AbstractFrictionLaw,
    AbstractNormalLaw as AbstractNormalLaw,
)
from .dry_friction import AbstractDryFriction as AbstractDryFriction
from .elements import (
    apart as apart,
    coincident as coincident,
    in_planes as in_planes,
    perpendicular as perpendicular,
)
from .fields import (
    Module as Module,
    Names as Names,
    Number as Number,
    Numbers as Numbers,
    attitude as attitude,
    axis as axis,
    body_name as body_name,
    body_names as body_names,
    choice as choice,
    function as function,
    guess as guess,
    internal_state as internal_state,
    law as law,
    length as length,
    module as module,
    name as name,
    names as names,
    numbers as numbers,
    parameter as parameter,
    point as point,
)
from .space import (
    AbstractSpace as AbstractSpace,
    force_pair as force_pair,
    rate_of as rate_of,
    separation as separation,
    separation_rate as separation_rate,
)
from .terrain import AbstractTerrain as AbstractTerrain
from .unilateral import (
    AbstractGeometricContact as AbstractGeometricContact,
    AbstractRigidContact as AbstractRigidContact,
    AbstractUnilateralConstraint as AbstractUnilateralConstraint,
)
