"""Accurate, differentiable dynamics of constrained mechanical systems in JAX."""

from . import (
    formulations as formulations,
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
from .linalg import rotations as rotations
from .parts import contact as contact, terrain as terrain
from .parts.forces import Gravity as Gravity
from .parts.functions import (
    Constraint as Constraint,
    Force as Force,
    NonIdeal as NonIdeal,
    VelocityConstraint as VelocityConstraint,
)
from .parts.joint_parts import JointDriver as JointDriver, JointForce as JointForce, JointSpring as JointSpring
from .parts.series import Series as Series
from .parts.servo import Servo as Servo
from .scene import Scene as Scene
from .simulate import simulate as simulate
from .states.assembly import assemble as assemble
from .states.equilibrium import equilibrium as equilibrium
from .states.gap import assembly_gap as assembly_gap
from .studies import cases as cases
from .studies.experiment import Experiment as Experiment
from .studies.floquet import Floquet as Floquet, floquet as floquet
from .studies.identification import Identification as Identification
from .studies.identify import identify as identify
from .studies.linearisation import Linearisation as Linearisation
from .studies.linearise import linearise as linearise
from .studies.measurements import Measurements as Measurements, read_measurements as read_measurements
from .studies.optimise import Optimum as Optimum, optimise as optimise
from .studies.robust import robust as robust
from .studies.root_locus import RootLocus as RootLocus, root_locus as root_locus
from .studies.sensors import Sensor as Sensor
from .studies.steady import steady_motion as steady_motion
from .studies.sweep import load_sweep as load_sweep, sweep as sweep
from .system import (
    RigidBodySystem as RigidBodySystem,
    Variable as Variable,
    design as design,
    parameters as parameters,
    with_inputs as with_inputs,
    with_parameters as with_parameters,
)
from .trajectory import Trajectory as Trajectory, load as load
