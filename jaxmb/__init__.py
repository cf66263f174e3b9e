"""Accurate, differentiable dynamics of constrained mechanical systems in JAX."""

from . import (
    formulations as formulations,
)
from . import (
    manifold as manifold,
)
from . import (
    mechanisms as mechanisms,
)
from . import (
    planar as planar,
)
from . import (
    report as report,
)
from . import (
    solvers as solvers,
)
from . import (
    spatial as spatial,
)
from . import (
    viz as viz,
)
from ._forces import Gravity as Gravity
from ._results import RESULTS as RESULTS
from ._types import State as State
from ._user import Constraint as Constraint
from ._user import Force as Force
from ._user import VelocityConstraint as VelocityConstraint
from .assembly import assemble as assemble
from .identify import Identification as Identification
from .identify import identify as identify
from .scene import Scene as Scene
from .simulate import simulate as simulate
from .system import RigidBodySystem as RigidBodySystem
from .system import parameters as parameters
from .system import with_parameters as with_parameters
from .trajectory import Trajectory as Trajectory
from .trajectory import load as load
