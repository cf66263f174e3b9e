"""No constraints at all: the plain equations of motion."""

from typing import ClassVar

import diffrax

from .manifold import AbstractManifold, all_rows_formulation
from .orthogonal_projection import project_normalized
from .vector_field import VectorField


class Unconstrained(AbstractManifold):
    """Integrate all coordinates, and constraints on the level of accelerations only.

    The policy of systems without constraints. With constraints the state drifts off them by the error of integration;
    that is for comparison only. Euler parameters are normalised where they are used, so their length does not matter.
    """

    restores: ClassVar[bool] = False
    takes_impulses: ClassVar[bool] = False

    def prepare(self, system, formulation, solver, rtol):
        return diffrax.ODETerm(VectorField(system, formulation)), solver

    def default_formulation(self, system):
        return all_rows_formulation(system)

    def correction(self, interpolated):
        # No step ends on the constraints, and Euler parameters are not of unit length.
        return project_normalized

    def statistics(self, solver_state):
        return {}

    def diagnose(self, system, t, y, solver_state, result, failed):
        return result
