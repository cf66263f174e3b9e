"""Forces of constraints that depend on the constraints' own multipliers, such as Coulomb friction.

Such a force C changes the multipliers that it depends on: with friction the normal force is not that of the joint
without. Of the rows that C depends on, the multipliers x solve

    x = x⁰ + P C(x)

where x⁰ are the multipliers without C, and P the influence on them of a force on the velocities. Newton's method starts
from x⁰; Coulomb's law is piecewise linear where a reaction has one component, and one correction then solves it.

The solution is the only one wherever `x ↦ x⁰ + P C(x)` contracts, component by component: the spectral radius of
`|P ∂C/∂x|` is below 1. For one Coulomb law on one row this is exact: at 1, Painlevé's paradox, a solution ceases to
exist or another one appears (P. Painlevé, "Sur les lois du frottement de glissement", C. R. Acad. Sci. 121, 1895). For
several it is sufficient, and for laws that are not linear in the size of a single component it holds near the solution.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..linalg.newton import newton

_CORRECTIONS = 16


def find_multipliers(
    law: Callable[[Array], Array], influence: Float[Array, "k n"], start: Float[Array, "k"]
) -> tuple[Float[Array, "k"], Float[Array, "k k"], Bool[Array, ""]]:
    """Solve `x = start + influence law(x)`.

    **Returns:** x; the coupling `|influence ∂law/∂x|` there; and whether the equation failed to have one solution and
    no other, in which case x is `start`.
    """
    dtype = start.dtype
    value_and_slope = lambda x: (law(x), influence @ jax.jacfwd(law)(x))

    def correct(x):
        force, slope = value_and_slope(x)
        step = jnp.linalg.solve(jnp.eye(x.size, dtype=dtype) - slope, start + influence @ force - x)
        # Relative to all that adds up to a multiplier: free of units, and above rounding errors.
        size = jnp.abs(start) + jnp.abs(x) + jnp.abs(influence) @ jnp.abs(force)
        return x + step, jnp.max(jnp.where(step == 0, 0.0, jnp.abs(step) / jnp.where(size > 0, size, 1.0)))

    # Corrections shrink quadratically in the end: the next one is below rounding errors.
    tol = jnp.finfo(dtype).eps ** 0.75
    x, size = newton(correct, lambda _, size: ~(size <= tol), start, most=_CORRECTIONS, dtype=dtype)
    converged = size <= tol
    x = jnp.where(converged, x, start)
    coupling = jnp.abs(value_and_slope(x)[1])
    failed = ~(converged & contracts(coupling))
    return jnp.where(failed, start, x), coupling, failed


def contracts(coupling: Float[Array, "k k"]) -> Bool[Array, ""]:
    """Whether the spectral radius of a matrix T ≥ 0 is below 1."""
    # Only then is I − T an M-matrix: some y > 0 has (I − T) y > 0.
    one = jnp.ones(coupling.shape[0], coupling.dtype)
    return jnp.all(jnp.linalg.solve(jnp.eye(one.size, dtype=one.dtype) - coupling, one) > 0)


def coupled_most(coupling: Float[np.ndarray, "k k"]) -> Bool[np.ndarray, "k"]:
    """The rows of T ≥ 0 that its spectral radius comes from."""
    values, vectors = np.linalg.eig(coupling)
    share = np.abs(vectors[:, np.argmax(np.abs(values))])
    return share > 1e-3 * np.max(share)
