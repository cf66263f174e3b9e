"""Formulations of the equations of constrained motion."""

from ._base import AbstractFormulation as AbstractFormulation, accelerations as accelerations, linearize as linearize
from .multipliers import Multipliers as Multipliers
from .partitioned import Partitioned as Partitioned
