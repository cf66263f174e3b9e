"""Formulations of the equations of constrained motion."""

from .formulation import (
    AbstractFormulation as AbstractFormulation,
    pivoted_jacobian as pivoted_jacobian,
)
from .gauss import gauss_function as gauss_function
from .laws import accelerations as accelerations
from .multipliers import Multipliers as Multipliers
from .null_space import NullSpace as NullSpace
from .partitioned import Partitioned as Partitioned
from .poincare import Poincare as Poincare
from .udwadia_kalaba import UdwadiaKalaba as UdwadiaKalaba
