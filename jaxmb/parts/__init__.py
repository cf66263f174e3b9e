"""The parts of a scene: base classes and field declarations, also for user-defined parts.

A part is a class derived from one of the base classes. Helpers declare the meaning of its fields (`point()`, `axis()`,
`length()`, `parameter()`, …), annotated with `Number`, `Numbers` (by name) or `Names`; its kernel is a pure function of
the poses of its bodies. For examples of a joint, a force and a contact law see `notebooks/05_extending.ipynb`.
"""

from .base import (
    AbstractActor as AbstractActor,
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
    separation as separation,
    separation_rate as separation_rate,
)
from .terrain import AbstractTerrain as AbstractTerrain
from .unilateral import (
    AbstractGeometricContact as AbstractGeometricContact,
    AbstractRigidContact as AbstractRigidContact,
    AbstractUnilateralConstraint as AbstractUnilateralConstraint,
)
