"""Transpositional relations: the definition of the variation of a velocity.

Virtual displacements δq always satisfy the constraints. The variation of velocities may be defined freely,

    δ(q̇) − d(δq)/dt = W(t, q; q̇, δq),

bilinear in the last two, if the principle compensates for it: `∫ (δ_W L − p · W + Q · δq) dt = 0`. With Hölder's
choice, W = 0, varied motions violate the constraints; with Suslov's they satisfy them. All choices give the equations
of Lagrange and d'Alembert. Without the term p · W, the different equations of a variational problem with constraints
(vakonomic) would result.

Source: J. Papastavridis, Analytical Mechanics, World Scientific, 2014, §3.8; A. M. Bloch, Nonholonomic Mechanics and
Control, Springer, 2015.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .kinematics import Parameters

# A name; a number between Hölder's choice, zero, and Suslov's, one; or `W(t, q, v, dq, parameters)`, shape (nq,).
Transposition = str | float | Callable[..., Array]


def check_shape(transposition: Callable[..., Array], q: Array, parameters: Parameters) -> None:
    """Raise a `ValueError` unless a function returns a variation of all rates."""
    shape = jax.eval_shape(lambda: jnp.asarray(transposition(jnp.zeros((), q.dtype), q, q, q, parameters))).shape
    if shape != q.shape:
        raise ValueError(f"The transposition W(t, q, v, dq, parameters) must have shape {q.shape}, got {shape}.")


def share_of_suslov(transposition: Transposition) -> float | None:
    """The share of Suslov's choice in a transposition, None for a function.

    **Raises:** `ValueError` for other words.
    """
    if callable(transposition):
        return None
    if isinstance(transposition, str):
        if transposition not in ("holder", "suslov"):
            raise ValueError(
                f"A transposition is 'holder', 'suslov', a number between them or a function; got {transposition!r}."
            )
        return float(transposition == "suslov")
    return float(transposition)
