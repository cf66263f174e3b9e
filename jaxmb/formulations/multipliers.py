"""Lagrange multipliers first: the equations of all accelerations with the constraint forces."""

from typing import ClassVar

from ..linalg.jacobian import MassProjector
from .formulation import AbstractFormulation


class Multipliers(AbstractFormulation):
    """`(A M⁻¹ Aᵀ) λ = γ − A M⁻¹ F` on the independent rows, then `u̇ = M⁻¹ (F + Aᵀ λ)`.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, formulation=jaxmb.formulations.Multipliers())
    ```

    It needs a mass matrix that is cheap to solve with, and is cheapest for few constraints and many degrees of freedom.
    The elimination follows the graph of joints: for chains, trees and local loops time and memory are proportional to
    the number of joints. Solutions are refined until they satisfy the constraint rows to rounding errors. So all digits
    are right even with light bodies between or at the ends of heavy ones, for ratios of masses up to 1e8 and more.
    """

    partitions: ClassVar[bool] = False
    inverts_mass: ClassVar[bool] = True
    takes_blocks: ClassVar[bool] = True

    def prepared(self, inertia, jacobian):
        return FactoredMultipliers(jacobian.projector(inertia))

    def solve(self, inertia, force, jacobian, gamma):
        return self.prepared(inertia, jacobian).solve(inertia, force, jacobian, gamma)


class FactoredMultipliers(AbstractFormulation):
    """`Multipliers` with a known `projector`, which has a factor of `A M⁻¹ Aᵀ`."""

    projector: MassProjector
    partitions: ClassVar[bool] = False
    inverts_mass: ClassVar[bool] = True
    takes_blocks: ClassVar[bool] = True

    def solve(self, inertia, force, jacobian, gamma):
        del inertia, jacobian
        return self.projector.solve(force, gamma)
