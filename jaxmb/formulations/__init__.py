"""Formulations of the equations of constrained motion."""

from .._moved import tell_of_moved as _tell_of_moved
from .formulation import AbstractFormulation as AbstractFormulation
from .laws import accelerations as accelerations
from .multipliers import Multipliers as Multipliers
from .null_space import NullSpace as NullSpace
from .partitioned import Partitioned as Partitioned
from .poincare import Poincare as Poincare
from .udwadia_kalaba import UdwadiaKalaba as UdwadiaKalaba

_tell_of_moved(__name__, gauss_function="(u̇ − a)ᵀ M (u̇ − a) with a = M⁻¹F, of system.inertia and system.force")
