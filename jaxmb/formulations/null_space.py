"""Projection of the equations on the null space of the constraints."""

from typing import ClassVar

from ..linalg.elimination import solve_positive
from ..linalg.orthogonal import orthogonal_basis
from .formulation import AbstractFormulation


class NullSpace(AbstractFormulation):
    """Maggi's equations in an orthonormal basis Z of the null space of A: `(ZᵀMZ) ẏ = Zᵀ(F − M c)`, `u̇ = Z ẏ + c`.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, formulation=jaxmb.formulations.NullSpace())
    ```

    c is the shortest solution of `A c = γ`; Z and c come from an orthogonal factorisation of Aᵀ. No coordinate is
    preferred over others, so no chart can become singular, and no pivots are searched if no row is redundant. The mass
    matrix may be singular, as long as every velocity without mass is constrained.

    **Reference:**

    ```bibtex
    @article{kim1986qr,
      author = {Kim, S. S. and Vanderploeg, M. J.}, title = {{QR} Decomposition for State Space Representation of
      Constrained Mechanical Dynamic Systems}, journal = {Journal of Mechanisms, Transmissions, and Automation in
      Design}, volume = {108}, number = {2}, pages = {183--188}, year = {1986},
    }
    ```
    """

    partitions: ClassVar[bool] = False
    inverts_mass: ClassVar[bool] = False

    def solve(self, inertia, force, jacobian, gamma):
        jacobian = jacobian.dense()
        basis = orthogonal_basis(jacobian.independent.T)
        Z, solution = basis.complement, basis.pseudoinverse
        particular = solution.T @ jacobian.gather_rows(gamma)
        reduced = Z.T @ inertia.product(Z)
        udot = particular + Z @ solve_positive(reduced, Z.T @ (force - inertia.product(particular)))
        return udot, jacobian.scatter_rows(solution @ (inertia.product(udot) - force))
