"""Accurate, differentiable dynamics of constrained mechanical systems in JAX."""

from . import (
    formulations as formulations,
    importers as importers,
    lagrangian as lagrangian,
    manifold as manifold,
    mechanisms as mechanisms,
    parts as parts,
    planar as planar,
    report as report,
    solvers as solvers,
    spatial as spatial,
    viz as viz,
)
from ._results import RESULTS as RESULTS
from ._types import State as State
from ._version import __version__ as __version__
from .bodies import RigidBodySystem as RigidBodySystem
from .bodies.scene import Scene as Scene
from .linalg import rotations as rotations
from .parts import contact as contact, shapes as shapes, terrain as terrain
from .parts.actuators import Actuator as Actuator, Motor as Motor
from .parts.combinations import (
    FixedTendon as FixedTendon,
    JointCoupling as JointCoupling,
    JointInertia as JointInertia,
    Tendon as Tendon,
)
from .parts.controller import Controller as Controller
from .parts.coordinate_parts import (
    JointDriver as JointDriver,
    JointForce as JointForce,
    JointFriction as JointFriction,
    JointSpring as JointSpring,
    JointStop as JointStop,
)
from .parts.forces import Gravity as Gravity
from .parts.functions import (
    Constraint as Constraint,
    Force as Force,
    NonIdeal as NonIdeal,
    VelocityConstraint as VelocityConstraint,
)
from .parts.names import UnknownNameError as UnknownNameError
from .parts.series import Series as Series
from .parts.servo import Servo as Servo
from .simulate import simulate as simulate
from .states.assembly import assemble as assemble
from .states.equilibrium import equilibrium as equilibrium
from .states.gap import assembly_gap as assembly_gap
from .studies.identify import (
    Experiment as Experiment,
    Identification as Identification,
    Measurements as Measurements,
    Sensor as Sensor,
    identify as identify,
    read_measurements as read_measurements,
)
from .studies.linear import (
    Floquet as Floquet,
    Linearisation as Linearisation,
    RootLocus as RootLocus,
    floquet as floquet,
    linearise as linearise,
    root_locus as root_locus,
    steady_motion as steady_motion,
)
from .studies.optimise import Optimum as Optimum, optimise as optimise, robust as robust
from .studies.sweep import cases as cases, load_sweep as load_sweep, sweep as sweep
from .system import (
    Variable as Variable,
    design as design,
    parameters as parameters,
    with_inputs as with_inputs,
    with_parameters as with_parameters,
)
from .trajectory import Trajectory as Trajectory, load as load
