"""Accurate, differentiable dynamics of constrained mechanical systems in JAX."""

from . import (
    contact as contact,
    formulations as formulations,
    lagrangian as lagrangian,
    manifold as manifold,
    mechanisms as mechanisms,
    planar as planar,
    report as report,
    solvers as solvers,
    spatial as spatial,
    terrain as terrain,
    viz as viz,
)
from ._forces import Gravity as Gravity
from ._results import RESULTS as RESULTS
from ._servo import Servo as Servo
from ._types import State as State
from ._user import (
    Constraint as Constraint,
    Force as Force,
    NonIdeal as NonIdeal,
    VelocityConstraint as VelocityConstraint,
)
from .assembly import assemble as assemble
from .identify import Identification as Identification, identify as identify
from .scene import Scene as Scene
from .simulate import simulate as simulate
from .statics import equilibrium as equilibrium
from .system import RigidBodySystem as RigidBodySystem, parameters as parameters, with_parameters as with_parameters
from .trajectory import Trajectory as Trajectory, load as load
