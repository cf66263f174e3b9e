"""The policy of a simulation that names none."""

import diffrax

from ..formulations import AbstractFormulation
from ..solvers import AbstractMultistep
from ..system import AbstractSystem
from ..system.chain import is_long
from .block_projection import BlockProjection
from .free import Free
from .manifold import AbstractManifold
from .partition import Partition
from .projection import Projection


def default_manifold(
    system: AbstractSystem, solver: diffrax.AbstractSolver, formulation: AbstractFormulation | None
) -> AbstractManifold:
    """The policy that suits a system, a solver, and a formulation if one is given."""
    if system.acceleration_rows == 0:
        return Free()
    if not isinstance(solver, AbstractMultistep):
        return Projection()
    in_blocks = is_long(system) if formulation is None else not formulation.assembles
    return BlockProjection() if in_blocks and not solver.solves_implicitly else Partition()
