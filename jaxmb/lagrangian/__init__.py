"""Systems from a Lagrangian, in coordinates and velocities of the user's choice."""

from .constraints import (
    AccelerationConstraint as AccelerationConstraint,
    Holonomic as Holonomic,
    Nonholonomic as Nonholonomic,
    Pfaffian as Pfaffian,
    Servo as Servo,
)
from .equations import AbstractEquations as AbstractEquations, Projected as Projected
from .hamel import Hamel as Hamel, pivoted_frame as pivoted_frame, structure_functions as structure_functions
from .kinematics import (
    AbstractKinematics as AbstractKinematics,
    Connection as Connection,
    Frame as Frame,
    Rates as Rates,
)
from .nonideal import (
    AbstractNonIdeal as AbstractNonIdeal,
    Friction as Friction,
    NonIdeal as NonIdeal,
    Viscous as Viscous,
)
from .quasi import (
    QuasiVelocities as QuasiVelocities,
    johnsen_hamel_residual as johnsen_hamel_residual,
    kinetostatic_forces as kinetostatic_forces,
)
from .system import LagrangianSystem as LagrangianSystem
from .voronets import Voronets as Voronets
