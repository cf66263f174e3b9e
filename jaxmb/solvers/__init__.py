"""Multistep methods as diffrax solvers, with variable order and step, on vector fields and on manifolds."""

from ._base import AbstractManifoldTerm as AbstractManifoldTerm, ManifoldEvaluation as ManifoldEvaluation
from .adams import Adams as Adams, AdamsState as AdamsState
from .controller import MultistepController as MultistepController
