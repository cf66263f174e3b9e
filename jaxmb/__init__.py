"""Accurate, differentiable dynamics of constrained mechanical systems in JAX."""

from . import (
    formulations as formulations,
    manifold as manifold,
    planar as planar,
    solvers as solvers,
    spatial as spatial,
)
from ._forces import Gravity as Gravity
from ._types import State as State
from ._user import Constraint as Constraint, Force as Force, VelocityConstraint as VelocityConstraint
from .assembly import assemble as assemble
from .scene import Scene as Scene
from .system import RigidBodySystem as RigidBodySystem, parameters as parameters, with_parameters as with_parameters
from ._results import RESULTS as RESULTS
from .simulate import simulate as simulate
from .trajectory import Trajectory as Trajectory, load as load
