"""The equations of motion as they are, without a projection on constraints."""

import diffrax
import equinox as eqx

from .._types import State
from ..formulations import AbstractFormulation, accelerations
from ..system import AbstractSystem
from .manifold import AbstractManifold


class Unconstrained(AbstractManifold):
    """Integrate all coordinates without a projection on the constraints.

    The policy of systems without constraints. Where there are constraints, the state drifts off them by the error of
    integration, which is for comparison only. Euler parameters are normalised where they are used, so their length does
    not matter.
    """

    def prepare(self, system, formulation, solver, rtol):
        return diffrax.ODETerm(VectorField(system, formulation)), solver


class VectorField(eqx.Module):
    """`(q, u) ↦ (K(t, q, u), u̇)` with the accelerations of a formulation."""

    system: AbstractSystem
    formulation: AbstractFormulation

    def __call__(self, t, y, args):
        del args
        q = self.system.normalize(y.q)
        udot, _ = accelerations(self.system, self.formulation, t, q, y.u)
        return State(self.system.rates(t, q, y.u), udot)
