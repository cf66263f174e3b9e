"""Constrained Poincaré equations: quasi-accelerations in a frame where mass is the identity."""

from typing import ClassVar

from ..linalg.orthogonal import orthogonal_basis
from .formulation import AbstractFormulation


class Poincare(AbstractFormulation):
    r"""Gauss' principle in the quasi-accelerations `ṡ = Lᵀ u̇` of a mass-orthonormal frame, `M = L Lᵀ`.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, formulation=jaxmb.formulations.Poincare())
    ```

    There Gauss' function is a squared distance, `𝒢 = |ṡ − L⁻¹F|²`, and the constraints are `B ṡ = γ` with `B = A L⁻ᵀ`.
    An orthogonal factorisation of Bᵀ gives a frame adapted to the rows of B. The constraints give the components of ṡ
    along the rows; the components across are those of L⁻¹F. No equation remains to be solved. The multipliers belong to
    the ideal constraint force `S = Aᵀ λ = L (ṡ − L⁻¹F)`.

    The condition of B counts once, whereas in `A M⁻¹ Aᵀ` it is squared. Large forces that the constraints balance are
    not subtracted from each other.

    **Reference:**

    ```bibtex
    @article{udwadia2007explicit,
      author = {Udwadia, Firdaus E. and Phohomsiri, Phailaung}, title = {Explicit Poincar\'e Equations of Motion for
      General Constrained Systems. {Part I}. Analytical Results}, journal = {Proceedings of the Royal Society A},
      volume = {463}, number = {2082}, pages = {1421--1434}, year = {2007},
    }
    ```
    """

    partitions: ClassVar[bool] = False
    inverts_mass: ClassVar[bool] = True

    def solve(self, inertia, force, jacobian, gamma):
        jacobian, root = jacobian.dense(), inertia.root()
        free = root.solve(force)
        basis = orthogonal_basis(root.solve(jacobian.independent.T))
        bound = basis.inverse.T @ jacobian.gather_rows(gamma)
        sdot = basis.range @ bound + basis.complement @ (basis.complement.T @ free)
        multipliers = basis.inverse @ (bound - basis.range.T @ free)
        return root.transpose().solve(sdot), jacobian.scatter_rows(multipliers)
