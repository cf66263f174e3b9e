# ruff: noqa: I001
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

Points, axes and numbers of joints may be inputs: `separation_rate`, and `rate_of` for other functions of the part and
the poses, then include their rates. A class declares further such numbers, `moving = ("length",)`.

A part is a class derived from one of the base classes. Helpers declare the meaning of its fields (`point()`, `axis()`,
`length()`, `parameter()`, …), annotated with `Number`, `Numbers` (by name) or `Names`; its kernel is a pure function of
the poses of its bodies. For examples of a joint, a force and a contact law see `notebooks/05_extending.ipynb`.
"""

from .._moved import tell_of_moved as _tell_of_moved

## Base classes
from .base import (
    AbstractPart as AbstractPart,
    AbstractPlanarPart as AbstractPlanarPart,
    AbstractSpatialPart as AbstractSpatialPart,
    AbstractLink as AbstractLink,
    AbstractPair as AbstractPair,
    AbstractPointPair as AbstractPointPair,
    AbstractAxisJoint as AbstractAxisJoint,
    AbstractBody as AbstractBody,
    AbstractFlexibleBody as AbstractFlexibleBody,
    ScalarCoordinate as ScalarCoordinate,
    AbstractConstraint as AbstractConstraint,
    AbstractVelocityConstraint as AbstractVelocityConstraint,
    AbstractJoint as AbstractJoint,
    AbstractCompound as AbstractCompound,
    AbstractForce as AbstractForce,
    AbstractPotentialForce as AbstractPotentialForce,
    AbstractDynamicForce as AbstractDynamicForce,
    AbstractDynamicPart as AbstractDynamicPart,
    AbstractNonIdeal as AbstractNonIdeal,
    AbstractTendon as AbstractTendon,
)
from .frames import AbstractFixedFrame as AbstractFixedFrame, AbstractFlexibleFrame as AbstractFlexibleFrame
from .unilateral import (
    AbstractRigidContact as AbstractRigidContact,
    AbstractGeometricContact as AbstractGeometricContact,
    AbstractSurfaceContact as AbstractSurfaceContact,
)
from .contact_laws import (
    AbstractImpactLaw as AbstractImpactLaw,
    AbstractSlipLaw as AbstractSlipLaw,
    Newton as Newton,
    Poisson as Poisson,
    Coulomb as Coulomb,
)
from .contact import AbstractNormalLaw as AbstractNormalLaw, AbstractFrictionLaw as AbstractFrictionLaw
from .terrain import AbstractTerrain as AbstractTerrain

## Fields
from .fields import (
    Number as Number,
    Numbers as Numbers,
    Names as Names,
    Module as Module,
    name as name,
    names as names,
    body_name as body_name,
    body_names as body_names,
    point as point,
    axis as axis,
    attitude as attitude,
    length as length,
    parameter as parameter,
    numbers as numbers,
    function as function,
    module as module,
    choice as choice,
    law as law,
    guess as guess,
    internal_state as internal_state,
)

## Kernels
from .space import (
    AbstractSpace as AbstractSpace,
    separation as separation,
    separation_rate as separation_rate,
    rate_of as rate_of,
    force_pair as force_pair,
)
from .elements import coincident as coincident, in_planes as in_planes, perpendicular as perpendicular, apart as apart

_tell_of_moved(__name__)
