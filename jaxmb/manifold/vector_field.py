"""The equations of motion as a vector field."""

import equinox as eqx

from .._types import State
from ..formulations import AbstractFormulation, accelerations
from ..system import AbstractEquation


class VectorField(eqx.Module):
    """`(q, u) ↦ (K(t, q, u), u̇)` with the accelerations of a formulation."""

    system: AbstractEquation
    formulation: AbstractFormulation

    def __call__(self, t, y, args):
        del args
        q = self.system.normalize(y.q)
        udot, _ = accelerations(self.system, self.formulation, t, q, y.u)
        return State(self.system.rates(t, q, y.u), udot)
