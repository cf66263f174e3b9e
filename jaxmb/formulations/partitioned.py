"""Elimination of the dependent accelerations: the reduced equations of coordinate partitioning."""

from typing import ClassVar

from ..linalg.elimination import solve_positive
from .formulation import AbstractFormulation


class Partitioned(AbstractFormulation):
    """Reduced equations in the independent accelerations, `(EᵀME) u̇_i = Eᵀ(F − M c)`, `u̇ = E u̇_i + c`.

    E spans the null space of A and c is the particular solution of `A c = γ`, both from the factor of the chart.
    Cheapest where a chart is made anyway and the degrees of freedom are few; the default with `Partition`. Where a
    light body moves by itself on heavy ones, its accelerations lose as many digits as the ratio of the masses has;
    `Multipliers` keeps them.

    **Reference:**

    ```bibtex
    @article{wehage1982generalized,
      author = {Wehage, R. A. and Haug, E. J.}, title = {Generalized Coordinate Partitioning for Dimension
      Reduction in Analysis of Constrained Dynamic Systems}, journal = {Journal of Mechanical Design}, volume =
      {104}, number = {1}, pages = {247--255}, year = {1982},
    }
    ```
    """

    partitions: ClassVar[bool] = True
    inverts_mass: ClassVar[bool] = False

    def solve(self, inertia, force, jacobian, gamma):
        factor = jacobian.dense().pivoted
        particular = factor.right_inverse @ gamma
        reduced = factor.null_space.T @ inertia.product(factor.null_space)
        independent = solve_positive(reduced, factor.null_space.T @ (force - inertia.product(particular)))
        udot = particular + factor.null_space @ independent
        return udot, factor.right_inverse.T @ (inertia.product(udot) - force)
