"""Forces of constraints that depend on the constraints' own multipliers, such as Coulomb friction.

Such a force C changes the multipliers that it depends on: friction changes the normal force of a joint. The multipliers
x of the rows that C depends on solve

    x = x⁰ + P C(x)

where x⁰ are the multipliers without C, and P is the influence of a force on them. Newton's method starts from x⁰;
Coulomb's law is piecewise linear for a reaction with one component, and one correction then solves it.

The solution is unique wherever `x ↦ x⁰ + P C(x)` contracts, component by component: the spectral radius of `|P ∂C/∂x|`
is below 1. For one Coulomb law on one row this is exact. At 1, Painlevé's paradox, a solution ceases to exist or
another one appears (P. Painlevé, "Sur les lois du frottement de glissement", C. R. Acad. Sci. 121, 1895). For several
rows it is sufficient, and for laws that are not linear in the size of a single component it holds near the solution. A
contact's component cannot change its sign, and may weaken itself without limit: there the diagonal keeps its sign.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..linalg.elimination import gauss_jordan
from ..linalg.newton import newton

_CORRECTIONS = 16
# The first omitted correction is at most about this many rounding errors, as the last two corrections show.
_ROUNDING = 64
# At most this many rows are eliminated without a loop.
_FEW = 2


def find_multipliers(
    law: Callable[[Array], Array],
    influence: Float[Array, "k n"],
    start: Float[Array, "k"],
    pushes: Bool[np.ndarray, "k"],
) -> tuple[Float[Array, "k"], Float[Array, "k k"], Bool[Array, ""]]:
    """Solve `x = start + influence law(x)`.

    **Arguments:** `pushes`: components that cannot change their sign.

    **Returns:** x; the coupling `|influence ∂law/∂x|` there, with its sign on the diagonal for components that push;
    and whether the equation failed to have exactly one solution, in which case x is `start`.
    """
    one, sizes = jnp.eye(start.size, dtype=start.dtype), (jnp.abs(start), jnp.abs(influence))

    def correct(carry):
        x, _, before = carry
        force, push = jax.linearize(law, x)
        by_each = jax.vmap(push)(one)
        # As sums: for small matrices a library call takes longer than all the rest.
        slope = jnp.sum(influence[:, None] * by_each[None], axis=2)
        step = solve_coupled(one - slope, start + influence @ force - x)
        # Relative to the summands of a multiplier: free of units, and above rounding errors. Forces of several
        # multipliers may cancel.
        force = jnp.maximum(jnp.abs(force), jnp.abs(x) @ jnp.abs(by_each))
        size = sizes[0] + jnp.abs(x) + sizes[1] @ force
        size = jnp.max(jnp.abs(step) / jnp.where(size > 0, size, 1.0))
        # Corrections shrink quadratically, so the size of the next one is known.
        shrinks = jnp.where(before > 0, size / before, 1.0)
        return (x + step, slope, size), size * shrinks**2

    far = lambda _, ahead: ~(ahead <= _ROUNDING * jnp.finfo(start.dtype).eps)
    first = start, jnp.zeros_like(one), jnp.zeros((), start.dtype)
    (x, slope, _), ahead = newton(correct, far, first, most=_CORRECTIONS, dtype=start.dtype)
    coupling = jnp.where(np.diag(pushes), slope, jnp.abs(slope))
    failed = far(x, ahead) | ~contracts(coupling)
    return jnp.where(failed, start, x), coupling, failed


def contracts(coupling: Float[Array, "k k"]) -> Bool[Array, ""]:
    """Whether the spectral radius of a matrix T ≥ 0 is below 1; its diagonal may be negative."""
    # Only then is I − T an M-matrix: some y > 0 has (I − T) y > 0.
    n = coupling.shape[0]
    y = solve_coupled(jnp.eye(n, dtype=coupling.dtype) - coupling, jnp.ones(n, coupling.dtype))
    return jnp.all((y > 0) & jnp.isfinite(y))


def solve_coupled(matrix: Float[Array, "k k"], b: Float[Array, "k"]) -> Float[Array, "k"]:
    """Solve with `1 − P ∂C/∂x`: if the coupling contracts, pivots need no search."""
    if b.size > _FEW:
        return gauss_jordan(matrix, b.size) @ b
    # The inverse, so that the solution stays a linear function of b.
    both, rows = jnp.concatenate([matrix, jnp.eye(b.size, dtype=b.dtype)], axis=1), np.arange(b.size)
    for k in rows:
        row = both[k] / both[k, k]
        both = jnp.where((rows == k)[:, None], row[None], both - both[:, k, None] * row[None])
    return both[:, b.size :] @ b


def coupled_most(coupling: Float[np.ndarray, "k k"]) -> Bool[np.ndarray, "k"]:
    """The rows of T ≥ 0 that determine its spectral radius."""
    values, vectors = np.linalg.eig(coupling)
    share = np.abs(vectors[:, np.argmax(np.abs(values))])
    return share > 1e-3 * np.max(share)
