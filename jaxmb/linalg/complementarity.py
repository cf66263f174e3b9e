"""Linear complementarity problems: `W x + b ≥ 0`, `x ≥ 0`, and for each component one of the two is zero.

Source: R. W. Cottle, J.-S. Pang and R. E. Stone, "The Linear Complementarity Problem", SIAM, 2009, §4.4 (Lemke's
method).
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .elimination import solve

# Entries of a column below this multiple of its largest one are rounding errors, not pivots.
PIVOT = 1e-9
# Right-hand sides are displaced by this multiple of their largest entry, differently in each row: with equal right-hand
# sides the method could cycle.
_APART = 1e-10
# The lower bound in the linear program of `largest_least`: its components are above -1.
_BOUND = 2.0


def positive_components(W: Float[Array, "k k"], b: Float[Array, "k"]) -> tuple[Bool[Array, "k"], Bool[Array, ""]]:
    """Which components of the solution are nonzero, and whether there is a solution; without derivative.

    The columns of W of these components are independent, also for a singular W. For a positive semidefinite W there is
    a solution if any x ≥ 0 has `W x + b ≥ 0`; for others the method may end without one.
    """
    W, b = lax.stop_gradient((W, b))
    scale = scale_of(W)
    return lemke(W / scale[:, None] / scale[None, :], b / scale)


def scale_of(W: Float[Array, "k k"]) -> Float[Array, "k"]:
    """The units of the components in which the diagonal of W is one."""
    return jnp.sqrt(jnp.maximum(jnp.diag(W), jnp.finfo(W.dtype).tiny))


def lemke(W: Float[Array, "k k"], b: Float[Array, "k"]) -> tuple[Bool[Array, "k"], Bool[Array, ""]]:
    """As `positive_components`, for any W in units in which its entries are of the size of one."""
    k, dtype = b.size, b.dtype
    right = b + _APART * jnp.max(jnp.abs(b), initial=0.0) * jnp.asarray(np.arange(1, k + 1) / k, dtype)
    # Columns: w, x, the artificial variable, the right-hand side; `basis`: the variable of each row.
    table = jnp.concatenate([jnp.eye(k, dtype=dtype), -W, -jnp.ones((k, 1), dtype), right[:, None]], axis=1)

    def proceed(carry):
        _, _, leaving, solvable, count = carry
        return (leaving != 2 * k) & solvable & (count < 20 + 10 * k)

    def advance(carry):
        table, basis, leaving, _, count = carry
        # At first the artificial variable enters, for the row that is furthest from a solution.
        is_first = count == 0
        entering = jnp.where(is_first, 2 * k, jnp.where(leaving < k, leaving + k, leaving - k))
        column, right = table[:, entering], table[:, -1]
        least = PIVOT * jnp.max(jnp.abs(column), initial=0.0)
        ratio = jnp.where(column > least, right / jnp.where(column > least, column, 1.0), jnp.inf)
        ratio = jnp.where(is_first, right, ratio)
        # Among equal ratios the artificial variable leaves.
        tied = (basis == 2 * k) & (ratio <= jnp.min(ratio) * (1 + 1e-12) + jnp.finfo(dtype).tiny)
        row = jnp.where(jnp.any(tied), jnp.argmax(tied), jnp.argmin(ratio))
        solvable = jnp.isfinite(ratio[row])
        leaves, changes = np.arange(k) == row, solvable & (np.arange(k) == row)
        pivot = table[row] / table[row, entering]
        table = jnp.where(leaves[:, None], 0.0, table) + jnp.where(leaves, 1.0, -column)[:, None] * pivot[None, :]
        leaving = jnp.where(solvable, basis[row], leaving)
        return table, jnp.where(changes, entering, basis), leaving, solvable, count + 1

    # A solution without forces needs no step.
    leaving = jnp.where(jnp.min(right) >= 0, 2 * k, -1)
    first = table, jnp.arange(k), leaving, jnp.array(True), jnp.array(0)
    _, basis, leaving, solvable, _ = lax.while_loop(proceed, advance, first)
    positive = jnp.any(basis[None, :] == np.arange(k, 2 * k)[:, None], axis=1)
    return positive, solvable & (leaving == 2 * k)


def largest_least(
    x: Float[Array, "k"], instead: Float[Array, "k k"], given: Bool[Array, "k"], free: Bool[Array, "k"]
) -> Float[Array, ""]:
    """The largest s for which some choice of the `free` components leaves all components at least s; at most 1.

    By a linear program, and differentiable. Components are in units in which they are of the size of one, or smaller.

    **Arguments:** `x`: the `given` components while the free ones are zero; `instead`: the change of each given
    component (row) by a unit of each free one (column).
    """
    k, one = x.size, jnp.ones(1, x.dtype)
    # Unknown are what free components have above s, and s above a lower bound of it.
    instead = jnp.where(given[:, None] & free[None, :], instead, 0.0)
    less = jnp.where(given, 1 - jnp.sum(instead, axis=1), 0.0)
    A = jnp.concatenate([-instead, less[:, None]], axis=1)
    A = jnp.concatenate([A, jnp.pad(one, (k, 0))[None]])
    most = jnp.concatenate([jnp.where(given, x + _BOUND * less, 1.0), (1 + _BOUND) * one])
    prices = jnp.concatenate([jnp.where(free, 0.0, 1.0), -one])
    none = jnp.zeros_like(A)
    matrix = jnp.concatenate([jnp.concatenate([none, A.T], axis=1), jnp.concatenate([-A, none], axis=1)])
    right = jnp.concatenate([prices, most])
    positive, solvable = lemke(*lax.stop_gradient((matrix, right)))
    least = solved_components(matrix, right, positive)[k] - _BOUND
    return jnp.where(solvable, least, jnp.min(jnp.where(given, x, 1.0)))


def least_norm(x: Float[Array, "k"], instead: Float[Array, "k k"], free: Bool[Array, "k"]) -> Float[Array, "k"]:
    """The components ≥ 0 with the least sum of squares, over all choices of the `free` components; differentiable.

    **Arguments:** `x` with all free components at zero; `instead`: see `largest_least`, zero for other pairs.
    """
    choices = jnp.where(free[None, :], instead + jnp.eye(x.size, dtype=x.dtype), 0.0)
    gram = choices.T @ choices + jnp.diag(jnp.where(free, 0.0, 1.0))
    along = choices @ solve(gram, choices.T)
    least = x - along @ x
    # Components that would be negative are raised to zero.
    moves = lax.stop_gradient(jnp.diag(along)) > PIVOT
    along = jnp.where(moves[:, None] & moves[None, :], along, jnp.eye(x.size, dtype=x.dtype))
    raised, _ = positive_components(along, jnp.where(moves, least, 1.0))
    return jnp.maximum(least + jnp.where(moves[:, None], along, 0.0) @ solved_components(along, least, raised), 0.0)


def independent_components(W: Float[Array, "k k"], among: Bool[Array, "k"]) -> Bool[Array, "k"]:
    """A largest set `among` components with independent columns; for a semidefinite W, without derivative."""
    W, among = lax.stop_gradient((W, among))
    scale = scale_of(W)

    def advance(_, carry):
        # The Cholesky factorisation with pivots: the next component is furthest from the span of the previous ones.
        reduced, chosen, candidates = carry
        distances = jnp.where(candidates, jnp.diag(reduced), 0.0)
        k = jnp.argmax(distances)
        is_next, pivot = np.arange(among.size) == k, distances[k]
        is_pivot = pivot > PIVOT
        reduced = reduced - reduced[:, k, None] * (reduced[k] / jnp.where(is_pivot, pivot, jnp.inf))[None, :]
        return reduced, chosen | (is_next & is_pivot), candidates & ~is_next

    first = W / scale[:, None] / scale[None, :], jnp.zeros_like(among), among
    return lax.fori_loop(0, among.size, advance, first)[1]


def reduced(W: Float[Array, "k k"], given: Bool[Array, "k"]) -> Float[Array, "k k"]:
    """W after the elimination of `given` components, whose columns are independent: the others with these at zero."""
    columns = jnp.where(given[:, None], W, 0.0)
    matrix = jnp.where(given[:, None] & given[None, :], W, jnp.eye(given.size, dtype=W.dtype))
    return W - columns.T @ solve(matrix, columns)


def solved_components(W: Float[Array, "k k"], b: Float[Array, "k"], positive: Bool[Array, "k"]) -> Float[Array, "k"]:
    """x with `W x + b = 0` in these components and zero in the others; differentiable."""
    both = positive[:, None] & positive[None, :]
    matrix = jnp.where(both, W, jnp.eye(b.size, dtype=b.dtype))
    return solve(matrix, jnp.where(positive, -b, 0.0))
