"""Multistep methods as diffrax solvers, with variable order and step, on vector fields and on manifolds."""

from . import stability as stability
from ._multistep import AbstractMultistep as AbstractMultistep
from .adams import Adams as Adams, AdamsState as AdamsState
from .controller import ControllerState as ControllerState, MultistepController as MultistepController
from .hermite import Hermite as Hermite, HermiteState as HermiteState
from .manifold_term import (
    AbstractFieldJacobian as AbstractFieldJacobian,
    AbstractManifoldTerm as AbstractManifoldTerm,
    AbstractResolvent as AbstractResolvent,
    ManifoldEvaluation as ManifoldEvaluation,
)
