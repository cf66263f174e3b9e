"""Lagrange multipliers first: the equations of all accelerations with the constraint forces."""

from typing import ClassVar

from ..linalg.elimination import solve_positive
from .formulation import AbstractFormulation


class Multipliers(AbstractFormulation):
    """`(A M⁻¹ Aᵀ) λ = γ − A M⁻¹ F` on the independent rows, then `u̇ = M⁻¹ (F + Aᵀ λ)`.

    Needs a mass matrix that is cheap to solve with; cheapest where constraints are few and degrees of freedom many.
    """

    partitions: ClassVar[bool] = False
    inverts_mass: ClassVar[bool] = True

    def solve(self, inertia, force, jacobian, gamma, factor):
        A = jacobian[factor.rows]
        free = inertia.solve(force)
        kept = solve_positive(A @ inertia.solve(A.T), gamma[factor.rows] - A @ free)
        return free + inertia.solve(A.T @ kept), factor.spread(kept)
