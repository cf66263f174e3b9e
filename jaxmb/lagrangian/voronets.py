"""Voronets' equations: constraints eliminated with the curvature of a connection."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .kinematics import Connection
from .model import AbstractEquations
from .transposition import Transposition, check_shape, share_of_suslov


class Voronets(AbstractEquations):
    """Voronets' equations in the rates of the base coordinates r, with `ṡ = −A ṙ − a` and `L_c(t, q, ṙ) = L(t, q, q̇)`:

    ```python
    slope = lambda t, q, p: jnp.array([[-jnp.tan(q[2]), 0.0]])  # ẏ = tan(angle) ẋ, of (x, y, angle).
    blade = jaxmb.lagrangian.Connection(base=(0, 2), fibre=(1,), matrix=slope)
    common = {"kinetic": lambda t, q, v, p: 0.5 * (v[0] ** 2 + v[1] ** 2 + 0.1 * v[2] ** 2), "q": [0.0, 0.0, 0.0]}
    equations = jaxmb.lagrangian.Voronets()
    sled = jaxmb.lagrangian.LagrangianSystem(**common, kinematics=blade, equations=equations, u=[1.0, 0.5])
    ```

    ```text
    d/dt ∂L_c/∂ṙ^α − ∂L_c/∂r^α + A^a_α ∂L_c/∂s^a = p_b (W^b_α − B^b_α) − p_b W^b_α + Q_α − A^a_α Q_a
    ```

    `B_α = B_αβ ṙ^β + B_α0` is the curvature of the connection, with time as a further base coordinate. Constraining L
    first and forgetting B is the classical mistake.

    **Arguments:** `transposition`: as in `Hamel`; with `"suslov"`, W = B, varied velocities satisfy the constraints.

    **Reference:**

    ```bibtex
    @article{voronets1901,
      author = {Voronets, P. V.}, title = {On the Equations of Motion for Nonholonomic Systems}, journal =
      {Matematicheskii Sbornik}, volume = {22}, number = {4}, year = {1901},
    }
    ```
    """

    transposition: Transposition = eqx.field(static=True, default="suslov")

    def __check_init__(self):
        share_of_suslov(self.transposition)

    def check(self, system):
        # A concrete class: only it has a base, a fibre and the curvature of these equations.
        if not isinstance(system.kinematics, Connection):
            raise ValueError(
                f"Voronets' equations need kinematics=Connection(...), got {type(system.kinematics).__name__}."
            )
        if callable(self.transposition):
            check_shape(self.transposition, system.guess.q, system.parameters)

    def force(self, system, t, q, u):
        connection: Any = system.kinematics
        fibre = jnp.array(connection.fibre)
        one, v = jnp.ones_like(t), system.rates(t, q, u)
        # Columns along the base: displacements with δs = −A δr.
        A = lambda t, q: jnp.asarray(connection.matrix(t, q, system.parameters_at(t)))
        columns = jax.jacfwd(lambda u: system.rates(t, q, u))(u)
        along = lambda fn: jax.vmap(lambda x: jax.jvp(fn, (q,), (x,))[1], in_axes=1, out_axes=1)(columns)
        # B_αβ ṙ^β + B_α0 = d A_α / dt along the motion less the change of ṡ, as a function of q alone, along column α.
        _, matrix_rate = jax.jvp(A, (t, q), (one, v))
        curvature = matrix_rate + along(lambda q: system.rates(t, q, u)[fibre])

        at = system.parameters_at
        constrained = lambda t, q, u: system.lagrangian(t, q, system.rates(t, q, u), at(t))
        _, rate = jax.jvp(lambda t, q: jax.grad(constrained, 2)(t, q, u), (t, q), (one, v))
        momentum = system.momentum(t, q, v)
        curvature = jnp.zeros_like(columns).at[fibre].set(curvature)
        share = share_of_suslov(self.transposition)
        if share is None:
            transposition: Any = self.transposition
            W = jax.vmap(lambda x: jnp.asarray(transposition(t, q, v, x, at(t))), in_axes=1, out_axes=1)(columns)
        else:
            W = share * curvature
        right = momentum @ (W - curvature) - momentum @ W
        return jax.grad(constrained, 1)(t, q, u) @ columns - rate + right + system.applied_force(t, q, v) @ columns
