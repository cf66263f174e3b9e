"""Systems from a Lagrangian, in any generalized coordinates and velocities.

Assembly, simulation, identification and derivatives work as with scenes of bodies.

- `LagrangianSystem(lagrangian, q=, parameters=)`: the Lagrangian, or `kinetic=` and `potential=`; `force=` for forces
  without a potential.
- `Holonomic`, `Pfaffian`, `Nonholonomic`, `AccelerationConstraint`: constraints at any level, also nonlinear in
  velocities; rows may be redundant.
- `ServoConstraint`: a desired motion as a constraint; its constraint force is the exact control force.
- `CoulombFriction`, `Viscous`, `NonIdealForce`: non-ideal constraint forces, which do virtual work.
- `QuasiVelocityFrame`, `Connection`, `QuasiVelocities`: velocities other than coordinate rates: a frame, a connection
  of base and fibre, nonlinear quasi-velocities.
- `pivoted_frame`: a frame of the directions that Pfaffian constraints allow, without singularities near a position.
- `kinetostatic_forces`: the forces that hold dependent quasi-velocities at zero.
- `Hamel`, `Voronets`, `structure_functions`: equations of motion with structure functions or curvature, for any
  transpositional relation.

Accelerations are computed by any of `jaxmb.formulations`: `Partitioned`, `Multipliers`, `NullSpace`, `Poincare`, or
`UdwadiaKalaba` in three forms. They agree to 1e-10 on every mechanism of the library, with and without redundant
joints. `gauss_function` is what the true accelerations make least.
"""

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
