"""Elimination of the dependent accelerations: the reduced equations of coordinate partitioning."""

from typing import ClassVar

from ..linalg.elimination import solve_positive
from .formulation import AbstractFormulation


class Partitioned(AbstractFormulation):
    """Reduced equations in the independent accelerations, `(EᵀME) u̇_i = Eᵀ(F − M c)`, `u̇ = E u̇_i + c`.

    E spans the null space of A and c is the particular solution of `A c = γ`, both from the factor of the chart.
    Cheapest where a chart is made anyway and the degrees of freedom are few; the default with `Partition`. (A
    Bricard linkage, 30 velocities and 29 independent rows, one evaluation with its factor: 15 µs, and 24 with a
    derivative; the others take from 15 to 83, and 25 to 124.)

    ??? cite "Reference"
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
