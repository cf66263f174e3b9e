"""Lagrange multipliers of a chain of joints, eliminated joint by joint."""

from typing import Any, ClassVar

from .formulation import AbstractFormulation


class BlockMultipliers(AbstractFormulation):
    """`(A M⁻¹ Aᵀ) λ = γ − A M⁻¹ F` by block elimination along the chain, then `u̇ = M⁻¹ (F + Aᵀ λ)`.

    For scenes whose joints form a chain, or several; time and memory grow in proportion to their number. No joint may
    be redundant, and no body have more than two joints.
    """

    partitions: ClassVar[bool] = False
    inverts_mass: ClassVar[bool] = True
    assembles: ClassVar[bool] = False

    def solve(self, inertia, force, jacobian: Any, gamma, factor):
        del factor
        free = inertia.solve(force)
        unbalance = jacobian.blocks(gamma - jacobian.product(free))
        multipliers = jacobian.ravel(jacobian.gram(inertia).factor().solve(unbalance))
        return free + inertia.solve(jacobian.transpose_product(multipliers)), multipliers
