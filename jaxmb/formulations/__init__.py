"""Formulations of the equations of constrained motion."""

from .block_multipliers import BlockMultipliers as BlockMultipliers
from .formulation import (
    AbstractFormulation as AbstractFormulation,
    accelerations as accelerations,
    linearize as linearize,
)
from .gauss import gauss_function as gauss_function
from .multipliers import Multipliers as Multipliers
from .null_space import NullSpace as NullSpace
from .partitioned import Partitioned as Partitioned
from .poincare import Poincare as Poincare
from .udwadia_kalaba import UdwadiaKalaba as UdwadiaKalaba
