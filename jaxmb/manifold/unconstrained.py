"""No constraints at all: the plain equations of motion."""

from typing import ClassVar

import diffrax

from .manifold import AbstractManifold, VectorField
from .orthogonal_projection import project_normalized


class Unconstrained(AbstractManifold):
    """Integrate all coordinates, and constraints on the level of accelerations only.

    The policy of systems without constraints. With constraints the state drifts off them by the error of integration;
    that is for comparison only. Euler parameters are normalised where they are used, so their length does not matter.
    """

    restores: ClassVar[bool] = False
    takes_impulses: ClassVar[bool] = False

    def prepare(self, system, formulation, solver, rtol):
        return diffrax.ODETerm(VectorField(system, formulation)), solver

    def correction(self, interpolated):
        # No step ends on the constraints, and Euler parameters are not of unit length.
        return project_normalized
