"""The policy of a simulation that names none."""

import diffrax

from ..formulations import AbstractFormulation
from ..solvers import AbstractMultistep
from ..system import AbstractEquation
from .manifold import AbstractManifold
from .partition import Partition
from .projection import Projection
from .unconstrained import Unconstrained


def default_manifold(
    system: AbstractEquation, solver: diffrax.AbstractSolver, formulation: AbstractFormulation | None
) -> AbstractManifold:
    """The policy that suits a system, a solver, and a formulation if one is given."""
    implicit = isinstance(solver, AbstractMultistep) and solver.solves_implicitly
    if system.acceleration_rows == 0:
        return Projection() if implicit and system.implicit_in_blocks else Unconstrained()
    if not isinstance(solver, AbstractMultistep):
        return Projection()
    # Block elimination serves multipliers only: it singles out no independent columns.
    in_blocks = system.elimination is not None and (formulation is None or formulation.takes_blocks)
    return Projection() if in_blocks and (system.implicit_in_blocks or not implicit) else Partition()
