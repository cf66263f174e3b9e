"""Multistep methods as diffrax solvers, with variable order and step, on vector fields and on manifolds."""

from . import stability as stability
from .adams import Adams as Adams, AdamsState as AdamsState
from .controller import (
    AbstractControllerState as AbstractControllerState,
    ControllerState as ControllerState,
    MultistepController as MultistepController,
    intended_step as intended_step,
)
from .evaluation import (
    Evaluation as Evaluation,
    evaluate as evaluate,
    next_chart as next_chart,
    project_near as project_near,
    ravel as ravel,
    unravel_like as unravel_like,
)
from .events import (
    NO_STATE as NO_STATE,
    cond_of_jumps as cond_of_jumps,
    crossing as crossing,
    events_found as events_found,
)
from .hermite import Hermite as Hermite, HermiteState as HermiteState
from .manifold_term import (
    AbstractFieldJacobian as AbstractFieldJacobian,
    AbstractGuards as AbstractGuards,
    AbstractManifoldTerm as AbstractManifoldTerm,
    AbstractResolvent as AbstractResolvent,
    ManifoldEvaluation as ManifoldEvaluation,
)
from .mesh import MeshAdjoint as MeshAdjoint
from .multistep import (
    AbstractAttempt as AbstractAttempt,
    AbstractMultistep as AbstractMultistep,
    AbstractMultistepState as AbstractMultistepState,
    tolerances_of as tolerances_of,
)
from .one_step import with_counted as with_counted, with_tangents as with_tangents
from .order import StepEstimate as StepEstimate, choose_order as choose_order
from .scales import Block as Block, RunningScales as RunningScales
from .tangent import Tangent as Tangent, TangentControl as TangentControl
from .times import twice_differentiable as twice_differentiable
from .tolerances import Tolerances as Tolerances
