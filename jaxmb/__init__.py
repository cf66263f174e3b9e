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
from .parts.servo import Servo as Servo
from .scene import Scene as Scene
from .simulate import simulate as simulate
from .states.assembly import assemble as assemble
from .states.equilibrium import equilibrium as equilibrium
from .studies.experiment import Experiment as Experiment
from .studies.identification import Identification as Identification
from .studies.identify import identify as identify
from .studies.measurements import Measurements as Measurements, read_measurements as read_measurements
from .studies.sensors import Sensor as Sensor
from .system import RigidBodySystem as RigidBodySystem, parameters as parameters, with_parameters as with_parameters
from .trajectory import Trajectory as Trajectory, load as load
