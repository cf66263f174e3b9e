"""The default policy of a simulation, and the policy of systems without constraints."""

from typing import ClassVar

import diffrax

from ..formulations import AbstractFormulation
from ..solvers import AbstractMultistep
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .implied import check_watched, violated
from .manifold import AbstractManifold, VectorField
from .orthogonal_projection import project_normalized
from .partition import Partition
from .projection import Projection


class Unconstrained(AbstractManifold):
    """Integrate all coordinates, and constraints on the level of accelerations only.

    This is the policy of systems without constraints. With constraints it is for comparison only: the integration
    drifts off them by its error, and saved states are the nearest states on them. Euler parameters are normalised where
    they are used, so their length does not matter.
    """

    restores: ClassVar[bool] = False
    takes_impulses: ClassVar[bool] = False

    def prepare(self, system, formulation, solver, accuracy):
        check_watched(system, "Unconstrained")
        return diffrax.ODETerm(VectorField(system, formulation)), solver

    def correction(self, interpolated):
        # Steps do not end on the constraints, and Euler parameters are not of unit length.
        return project_normalized

    def violated(self, system, t, y, accuracy):
        return violated(Instant.of(system, t, y), accuracy.rtol, project=True)


# Defaults, made once: their construction takes as long as the rest of a call.
_UNCONSTRAINED, _PROJECTION, _PARTITION = Unconstrained(), Projection(), Partition()


def default_manifold(
    system: AbstractEquation, solver: diffrax.AbstractSolver, formulation: AbstractFormulation | None
) -> AbstractManifold:
    """The policy for a system, a solver, and a formulation if one is given."""
    implicit = isinstance(solver, AbstractMultistep) and solver.solves_implicitly
    if system.acceleration_rows == 0:
        return _PROJECTION if implicit and system.implicit_in_blocks else _UNCONSTRAINED
    if not isinstance(solver, AbstractMultistep):
        return _PROJECTION
    # Block elimination serves multipliers only: it does not select independent columns.
    multipliers = formulation is None or formulation.takes_blocks
    in_blocks = system.implicit_in_blocks if implicit else system.elimination is not None
    return _PROJECTION if in_blocks and multipliers else _PARTITION
