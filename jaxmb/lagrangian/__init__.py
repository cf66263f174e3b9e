"""Systems from a Lagrangian, in any generalized coordinates and velocities."""

from .constraints import (
    AbstractCoordinateConstraint as AbstractCoordinateConstraint,
    AccelerationConstraint as AccelerationConstraint,
    Holonomic as Holonomic,
    Nonholonomic as Nonholonomic,
    Pfaffian as Pfaffian,
    ServoConstraint as ServoConstraint,
)
from .hamel import Hamel as Hamel, pivoted_frame as pivoted_frame, structure_functions as structure_functions
from .kinematics import (
    AbstractKinematics as AbstractKinematics,
    Connection as Connection,
    QuasiVelocityFrame as QuasiVelocityFrame,
    Rates as Rates,
)
from .model import AbstractEquations as AbstractEquations, Projected as Projected
from .nonideal import (
    AbstractNonIdealForce as AbstractNonIdealForce,
    CoulombFriction as CoulombFriction,
    NonIdealForce as NonIdealForce,
    Viscous as Viscous,
)
from .quasi import (
    QuasiVelocities as QuasiVelocities,
    kinetostatic_forces as kinetostatic_forces,
)
from .system import LagrangianSystem as LagrangianSystem
from .voronets import Voronets as Voronets
