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
- `Hamel`, `Voronets`: equations of motion with structure functions or curvature, for any transpositional relation.

Any of `jaxmb.formulations` computes the accelerations: `Partitioned`, `Multipliers`, `NullSpace`, `Poincare`, or
`UdwadiaKalaba` in three forms. They agree to 1e-10 on every mechanism of the library, also with redundant joints.
"""

from .._moved import tell_of_moved as _tell_of_moved
from .constraints import (
    AccelerationConstraint as AccelerationConstraint,
    Holonomic as Holonomic,
    Nonholonomic as Nonholonomic,
    Pfaffian as Pfaffian,
    ServoConstraint as ServoConstraint,
)
from .hamel import Hamel as Hamel
from .kinematics import Connection as Connection, QuasiVelocityFrame as QuasiVelocityFrame
from .nonideal import CoulombFriction as CoulombFriction, NonIdealForce as NonIdealForce, Viscous as Viscous
from .quasi import QuasiVelocities as QuasiVelocities
from .system import LagrangianSystem as LagrangianSystem
from .voronets import Voronets as Voronets

_tell_of_moved(
    __name__,
    pivoted_frame="QuasiVelocityFrame(columns, …), whose columns you choose",
    structure_functions="part of jaxmb.lagrangian.Hamel",
    kinetostatic_forces="the multipliers of Nonholonomic, in trajectory.constraint_forces",
)
