"""Elimination of the dependent accelerations: the reduced equations of coordinate partitioning."""

from collections.abc import Callable
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..linalg.elimination import Factor, gauss_jordan, positive_solver
from ..linalg.inertia import AbstractInertia
from .formulation import AbstractFormulation


class Partitioned(AbstractFormulation):
    """Reduced equations in the independent accelerations, `(EᵀME) u̇_i = Eᵀ(F − M c)`, `u̇ = E u̇_i + c`.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, formulation=jaxmb.formulations.Partitioned())
    ```

    E spans the null space of A and c is the particular solution of `A c = γ`, both from the factor of the chart.
    It is the default with `Partition`, and the cheapest formulation if a chart is made anyway and the degrees of
    freedom are few. If a light body moves by itself on heavy ones, its accelerations lose as many digits as the ratio
    of the masses has; `Multipliers` keeps these digits.

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

    def prepared(self, inertia, jacobian):
        null_space = jacobian.dense().pivoted.null_space
        reduced = null_space.T @ inertia.product(null_space)
        return ReducedPartitioned(gauss_jordan(reduced, reduced.shape[0]))

    def solve(self, inertia, force, jacobian, gamma):
        factor = jacobian.dense().pivoted
        reduced = positive_solver(factor.null_space.T @ inertia.product(factor.null_space))
        return _solve(inertia, force, factor, gamma, reduced)


class ReducedPartitioned(AbstractFormulation):
    """`Partitioned` with a known `inverse` of `EᵀME`."""

    inverse: Float[Array, "f f"]
    partitions: ClassVar[bool] = True
    inverts_mass: ClassVar[bool] = False

    def solve(self, inertia, force, jacobian, gamma):
        solve = lambda load: _summed(self.inverse, load)
        return _solve(inertia, force, jacobian.dense().pivoted, gamma, solve, _summed)


def reduced_accelerations(
    inertia: AbstractInertia,
    force: Float[Array, "nu"],
    factor: Factor,
    gamma: Float[Array, "m"],
    solve: Callable[[Float[Array, "f"]], Float[Array, "f"]],
    product: Callable[[Array, Array], Array] = jnp.matmul,
) -> Float[Array, "nu"]:
    """The accelerations by the `factor` of A; `solve` applies `(EᵀME)⁻¹` to the reduced load."""
    particular = product(factor.right_inverse, gamma)
    load = product(factor.null_space.T, force - inertia.product(particular))
    return particular + product(factor.null_space, solve(load))


def _solve(inertia, force, factor, gamma, solve, product=jnp.matmul):
    udot = reduced_accelerations(inertia, force, factor, gamma, solve, product)
    return udot, product(factor.right_inverse.T, inertia.product(udot) - force)


def _summed(matrix, x):
    """A product as sums: for small matrices, a library call takes longer than all the rest."""
    return jnp.sum(matrix * x[None], axis=1)
