"""Explicit accelerations of Udwadia and Kalaba, in generalized inverses."""

from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp

from ..linalg.orthogonal import orthogonal_basis
from .formulation import AbstractFormulation

Method = Literal["moore_penrose", "inverses", "singular_mass"]


class UdwadiaKalaba(AbstractFormulation):
    """Accelerations in closed form, without multipliers; the multipliers follow from the accelerations.

    ```python
    method = jaxmb.formulations.UdwadiaKalaba("inverses")
    motion = jaxmb.simulate(system, state, t1=1.0, formulation=method)
    ```

    **Arguments:** `method`: one of these forms, with `a = M⁻¹F` and a root L of the mass matrix, `M = L Lᵀ`, in place
    of its square root:

    - `"moore_penrose"`: `u̇ = a + L⁻ᵀ B⁺ (γ − A a)`, `B = A L⁻ᵀ`. The best known form.
    - `"inverses"`: `u̇ = A⁻γ + (I − A⁻A) G⁻ Lᵀ(a − A⁻γ)`, `G = Lᵀ(I − A⁻A)`, with any `A⁻` that solves consistent
        equations (a {1}-inverse) and any `G⁻` that solves least squares (a {1,3}-inverse). A⁻ follows from the chart;
        for G⁻, `(I − A⁻A) G⁻ = E (LᵀE)⁺` in the chart's basis E of the null space.
    - `"singular_mass"`: `u̇ = [(I − A⁺A) M; A]⁺ [F; γ]`. M may be singular as long as every velocity without mass is
        constrained, `rank [M; A] = n`.

    Ranks are structural: pseudo-inverses are taken of independent rows, from factors of fixed rank, so that derivatives
    exist.

    **Reference:**

    ```bibtex
    @article{udwadia1992new,
      author = {Udwadia, Firdaus E. and Kalaba, Robert E.}, title = {A New Perspective on Constrained Motion},
      journal = {Proceedings of the Royal Society A}, volume = {439}, number = {1906}, pages = {407--410}, year =
      {1992},
    }

    @article{kalaba1993equations,
      author = {Kalaba, R. E. and Udwadia, F. E.}, title = {Equations of Motion for Nonholonomic, Constrained
      Dynamical Systems via {Gauss's} Principle}, journal = {Journal of Applied Mechanics}, volume = {60}, number =
      {3}, pages = {662--668}, year = {1993},
    }

    @article{udwadia2006explicit,
      author = {Udwadia, Firdaus E. and Phohomsiri, Phailaung}, title = {Explicit Equations of Motion for
      Constrained Mechanical Systems with Singular Mass Matrices and Applications to Multi-Body Dynamics}, journal =
      {Proceedings of the Royal Society A}, volume = {462}, number = {2071}, pages = {2097--2117}, year = {2006},
    }
    ```
    """

    method: Method = eqx.field(static=True, default="moore_penrose")

    def __check_init__(self):
        if self.method not in get_args(Method):
            raise ValueError(f"UdwadiaKalaba: method must be one of {get_args(Method)}, got {self.method!r}.")

    @property
    def partitions(self) -> bool:
        return self.method == "inverses"

    @property
    def inverts_mass(self) -> bool:
        return self.method != "singular_mass"

    def solve(self, inertia, force, jacobian, gamma):
        return _FORMS[self.method](inertia, force, jacobian.dense(), gamma)


def _moore_penrose(inertia, force, jacobian, gamma):
    A, root = jacobian.independent, inertia.root()
    back = root.transpose()
    free = back.solve(root.solve(force))
    pseudoinverse = orthogonal_basis(root.solve(A.T)).pseudoinverse.T
    sdot = pseudoinverse @ (jacobian.gather_rows(gamma) - A @ free)
    return free + back.solve(sdot), jacobian.scatter_rows(pseudoinverse.T @ sdot)


def _inverses(inertia, force, jacobian, gamma):
    factor, root = jacobian.pivoted, inertia.root()
    particular = factor.right_inverse @ gamma
    ahead = root.solve(force) - root.transpose().product(particular)
    independent = orthogonal_basis(root.transpose().product(factor.null_space)).pseudoinverse @ ahead
    udot = particular + factor.null_space @ independent
    return udot, factor.right_inverse.T @ (inertia.product(udot) - force)


def _singular_mass(inertia, force, jacobian, gamma):
    A = jacobian.independent
    rows = orthogonal_basis(A.T)
    project = lambda x: x - rows.range @ (rows.range.T @ x)
    mass = project(inertia.product(jnp.eye(A.shape[1], dtype=A.dtype)))
    stacked = orthogonal_basis(jnp.concatenate([mass, A])).pseudoinverse
    # With a projected F, least squares have nothing to balance, and lose no digits.
    udot = stacked @ jnp.concatenate([project(force), jacobian.gather_rows(gamma)])
    return udot, jacobian.scatter_rows(rows.pseudoinverse @ (inertia.product(udot) - force))


_FORMS = {"moore_penrose": _moore_penrose, "inverses": _inverses, "singular_mass": _singular_mass}
