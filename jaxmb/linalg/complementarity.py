"""Linear complementarity problems: `W x + b ≥ 0`, `x ≥ 0`, of which one is zero for each component.

Source: R. W. Cottle, J.-S. Pang and R. E. Stone, "The Linear Complementarity Problem", SIAM, 2009, §4.4 (Lemke's
method).
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

# Entries of a column below this multiple of its largest one are rounding errors, and no pivots.
_PIVOT = 1e-9
# Right-hand sides are displaced by this multiple of their largest entry, differently in each row, since equal ones
# could make the method return to where it was.
_APART = 1e-10


def positive_components(W: Float[Array, "k k"], b: Float[Array, "k"]) -> tuple[Bool[Array, "k"], Bool[Array, ""]]:
    """Which components of the solution are not zero, and whether there is a solution; without derivative.

    The columns of W of these components are independent, also where W is singular. For a positive semidefinite W there
    is a solution if any x ≥ 0 has `W x + b ≥ 0`; for others the method may end without one.
    """
    W, b = lax.stop_gradient((W, b))
    k, dtype = b.size, b.dtype
    scale = jnp.sqrt(jnp.maximum(jnp.diag(W), jnp.finfo(dtype).tiny))
    W, b = W / scale[:, None] / scale[None, :], b / scale
    right = b + _APART * jnp.max(jnp.abs(b), initial=0.0) * jnp.asarray(np.arange(1, k + 1) / k, dtype)
    # Columns: w, x, the artificial variable, the right-hand side; `basis`: the variable of each row.
    table = jnp.concatenate([jnp.eye(k, dtype=dtype), -W, -jnp.ones((k, 1), dtype), right[:, None]], axis=1)

    def pivoted(table, basis, row, column):
        own = table[row] / table[row, column]
        table = table - table[:, column][:, None] * own[None, :]
        return table.at[row].set(own), basis.at[row].set(column), basis[row]

    def proceed(carry):
        _, _, left, solvable, count = carry
        return (left != 2 * k) & solvable & (count < 20 + 10 * k)

    def advance(carry):
        table, basis, left, _, count = carry
        entering = jnp.where(left < k, left + k, left - k)
        column, right = table[:, entering], table[:, -1]
        least = _PIVOT * jnp.max(jnp.abs(column), initial=0.0)
        ratio = jnp.where(column > least, right / jnp.where(column > least, column, 1.0), jnp.inf)
        # Of equal ratios the artificial variable leaves.
        tied = (basis == 2 * k) & (ratio <= jnp.min(ratio) * (1 + 1e-12) + jnp.finfo(dtype).tiny)
        row = jnp.where(jnp.any(tied), jnp.argmax(tied), jnp.argmin(ratio))
        solvable = jnp.isfinite(ratio[row])
        new = pivoted(table, basis, row, entering)
        kept = lambda new, old: jnp.where(solvable, new, old)
        return kept(new[0], table), kept(new[1], basis), kept(new[2], left), solvable, count + 1

    basis, row = jnp.arange(k), jnp.argmin(right)
    nothing = right[row] >= 0
    started = pivoted(table, basis, row, 2 * k)
    table, basis, left = (
        jnp.where(nothing, old, new) for new, old in zip(started, (table, basis, jnp.asarray(2 * k)), strict=True)
    )
    _, basis, left, solvable, _ = lax.while_loop(proceed, advance, (table, basis, left, jnp.array(True), jnp.array(0)))
    found = jnp.zeros(2 * k + 1, bool).at[basis].set(True)[k : 2 * k]
    return found, solvable & (left == 2 * k)


def solved_components(W: Float[Array, "k k"], b: Float[Array, "k"], positive: Bool[Array, "k"]) -> Float[Array, "k"]:
    """x with `W x + b = 0` in these components and zero in the others; differentiable."""
    both = positive[:, None] & positive[None, :]
    matrix = jnp.where(both, W, jnp.eye(b.size, dtype=b.dtype))
    return jnp.linalg.solve(matrix, jnp.where(positive, -b, 0.0))
