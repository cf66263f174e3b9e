"""Formulations of the equations of constrained motion."""

from ._base import AbstractFormulation as AbstractFormulation
from ._base import accelerations as accelerations
from ._base import linearize as linearize
from .multipliers import Multipliers as Multipliers
from .partitioned import Partitioned as Partitioned
