"""Gauss' principle of least constraint."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Coordinates, Scalar, Velocities
from ..system.equation import AbstractEquation
from ..system.instant import Instant


def gauss_function(
    system: AbstractEquation, t: Scalar, q: Coordinates, u: Velocities, udot: Float[Array, "nu"]
) -> Float[Array, ""]:
    """Gauss' function `𝒢(u̇) = (u̇ − a)ᵀ M (u̇ − a)`, `a = M⁻¹F`, of any accelerations at a state [N²/kg].

    ```python
    udot, _ = jaxmb.formulations.accelerations(system, jaxmb.formulations.Multipliers(), 0.0, state.q, state.u)
    jaxmb.formulations.gauss_function(system, 0.0, state.q, state.u, udot)
    ```

    Among the accelerations that ideal constraints allow, those with `system.acceleration_residual(t, q, u, u̇) = 0`, the
    true ones have the least; others, farther by δ, have more by `δᵀ M δ`.
    """
    at = Instant(system, t, q, u)
    deviation = udot - at.inertia.solve(at.force)
    return jnp.vdot(deviation, at.inertia.product(deviation))
