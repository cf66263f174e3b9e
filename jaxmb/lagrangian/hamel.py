"""Hamel's equations: motion in a frame, with the structure functions of its vector fields."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg.elimination import eliminate, full_pivot
from .kinematics import Parameters, QuasiVelocityFrame
from .model import AbstractEquations
from .transposition import Transposition, check_shape, share_of_suslov


class Hamel(AbstractEquations):
    """Hamel's equations in a frame `X_1, …, X_n` whose first columns are the velocities ξ = u:

    ```python
    along = lambda t, q, p: jnp.array([[jnp.cos(q[1]), 0.0], [0.0, 1.0], [jnp.sin(q[1]), 0.0]])  # Of (x, angle, y).
    frame = jaxmb.lagrangian.QuasiVelocityFrame(along, columns=2)
    common = {"kinetic": lambda t, q, v, p: 0.5 * (v[0] ** 2 + 0.1 * v[1] ** 2 + v[2] ** 2), "q": [0.0, 0.0, 0.0]}
    equations = jaxmb.lagrangian.Hamel()
    sled = jaxmb.lagrangian.LagrangianSystem(**common, kinematics=frame, equations=equations, u=[1.0, 0.5])
    ```

    ```text
    d/dt p_c − X_c[ℓ] = γ^a_c p_a − W_c·p + (Nᵀ Q)_c,    [X_b, X_c] = c^a_bc X_a
    ```

    with `ℓ(t, q, ξ) = L(t, q, N ξ + ν)`, its momenta `p_a` along all of the frame, and the transitivity coefficients
    `γ^a_c = c^a_bc ξ^b + Ψ^a W_c`, `Ψ = N⁻¹`. The drift ν counts as a further field with velocity one. With the frame
    of a base, lifted by a connection, these are the Hamel-Voronets equations.

    **Arguments:** `transposition`: the definition of the variation of a velocity: `"holder"` (W = 0), `"suslov"`
    (varied velocities stay in the frame's columns), a number between zero and one for a mixture of both, or a function
    `W(t, q, v, dq, parameters)`, shape (nq,). The equations are the same for all.

    **Reference:**

    ```bibtex
    @article{hamel1904lagrange,
      author = {Hamel, G.}, title = {Die Lagrange-Eulerschen Gleichungen der Mechanik}, journal = {Zeitschrift
      für Mathematik und Physik}, volume = {50}, pages = {1--57}, year = {1904},
    }
    ```
    """

    transposition: Transposition = eqx.field(static=True, default="holder")

    def __check_init__(self):
        share_of_suslov(self.transposition)

    def check(self, system):
        # A concrete class: only it has the columns of these equations.
        if not isinstance(system.kinematics, QuasiVelocityFrame):
            raise ValueError(
                f"Hamel's equations need kinematics=QuasiVelocityFrame(...), got {type(system.kinematics).__name__}."
            )
        frame = np.asarray(_frame_at(system.kinematics, system.guess.q, system.parameters))
        sizes = np.linalg.svd(frame, compute_uv=False)
        if not sizes[-1] > 1e-12 * sizes[0]:
            raise ValueError("The frame's columns are not independent at the guess.")
        if callable(self.transposition):
            check_shape(self.transposition, system.guess.q, system.parameters)

    def force(self, system, t, q, u):
        frame: Any = system.kinematics
        one = jnp.ones_like(t)
        columns = lambda t, q: frame.columns_of(t, q, system.parameters_at(t))
        X, v = columns(t, q), system.rates(t, q, u)
        sigma = u.size
        # [X_b, X_c] for all columns c, summed over the velocities of b with the drift: d X_c / dt − ∂v/∂q X_c.
        _, column_rates = jax.jvp(columns, (t, q), (one, v))
        turned = jax.vmap(lambda x: jax.jvp(lambda q: system.rates(t, q, u), (q,), (x,))[1], in_axes=1, out_axes=1)(X)
        inverse = inverse_of(complete(X))
        structure = inverse @ (column_rates - turned)

        ell = lambda t, q, u: system.lagrangian(t, q, system.rates(t, q, u), system.parameters_at(t))
        momenta = system.momentum(t, q, v) @ complete(X)
        W = self._transposed(system, t, q, v, X, structure, sigma)
        transitivity = structure + inverse @ W
        _, rate = jax.jvp(lambda t, q: jax.grad(ell, 2)(t, q, u), (t, q), (one, v))
        along = jax.grad(ell, 1)(t, q, u) @ X
        right = momenta @ transitivity - system.momentum(t, q, v) @ W
        return along - rate + right + system.applied_force(t, q, v) @ X

    def _transposed(self, system, t, q, v, X, structure, sigma):
        """W for displacements along each column, shape (nq, columns)."""
        share = share_of_suslov(self.transposition)
        if share is None:
            transposition: Any = self.transposition
            along = lambda x: jnp.asarray(transposition(t, q, v, x, system.parameters_at(t)))
            return jax.vmap(along, in_axes=1, out_axes=1)(X)
        outside = (jnp.arange(q.size) >= sigma)[:, None]
        return -share * (complete(X) @ jnp.where(outside, structure, jnp.zeros_like(structure)))


@eqx.filter_jit
def _frame_at(frame: QuasiVelocityFrame, q: Float[Array, "n"], parameters: Parameters) -> Float[Array, "n n"]:
    return complete(frame.columns_of(jnp.zeros((), q.dtype), q, parameters))


def complete(columns: Float[Array, "n k"]) -> Float[Array, "n n"]:
    """A frame that begins with these columns; the rest are unit vectors, chosen by full pivoting."""
    n, k = columns.shape
    if n == k:
        return columns
    rest = full_pivot(columns.T).order.columns[k:]
    return jnp.concatenate([columns, jnp.zeros((n, n - k), columns.dtype).at[rest, jnp.arange(n - k)].set(1.0)], axis=1)


def inverse_of(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse, with full pivoting."""
    n = matrix.shape[0]
    return eliminate(matrix, full_pivot(matrix).order, n).right_inverse
