"""Multistep methods as diffrax solvers, with variable order and step, on vector fields and on manifolds."""

from .._moved import tell_of_moved as _tell_of_moved
from . import stability as stability
from .adams import Adams as Adams
from .controller import MultistepController as MultistepController
from .evaluation import (
    evaluate as evaluate,
    next_chart as next_chart,
    project_near as project_near,
    ravel as ravel,
    unravel_like as unravel_like,
)
from .hermite import Hermite as Hermite
from .mesh import MeshAdjoint as MeshAdjoint
from .multistep import (
    AbstractAttempt as AbstractAttempt,
    AbstractMultistep as AbstractMultistep,
    AbstractMultistepState as AbstractMultistepState,
    tolerances_of as tolerances_of,
)
from .order import choose_order as choose_order
from .tolerances import Tolerances as Tolerances

_tell_of_moved(__name__)
