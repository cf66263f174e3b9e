"""The memory of a multistep method: scaled divided differences of the derivative on a mesh of any spacing.

With the mesh `t_n > t_{n-1} > ...` and `f_j = f(t_j, y_j)`, Newton's form of the polynomial through the last `i + 1`
derivatives is

    P(t) = sum_i differences[i] * basis_i(t),    basis_i(t) = prod_{j<i} (t - t_{n-j}) / (t_n - t_{n-j-1}),

where `differences[i]` is the divided difference `f[t_n, ..., t_{n-i}]` times the spans that `basis_i` is divided by.
All entries have the units of `f`, so no step size causes overflow or underflow. Advancing by one step needs only
`basis_i` at the new mesh point, without loops over the order.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

HIGHEST_ORDER = 13
LENGTH = HIGHEST_ORDER + 1

# Gauss-Legendre on [0, 1]; seven nodes are exact up to degree 13, the highest of a basis polynomial.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(7)
NODES, WEIGHTS = (NODES + 1) / 2, WEIGHTS / 2
INDEX = np.arange(LENGTH, dtype=np.int32)


class History(eqx.Module):
    """Derivatives of all components of the state at the last mesh points.

    **Fields:**

    - `differences`: scaled divided differences of the raveled derivative, one row each; zero from row `known` on.
    - `mesh`: `t_n, t_{n-1}, ...`, latest first. Entries from `known` on are placeholders that keep the spans nonzero.
    - `known`: the number of mesh points since the start (or the last restart), at most `LENGTH`.
    """

    differences: Float[Array, "length n"]
    mesh: Float[Array, " length"]
    known: Int[Array, ""]


def start(t: Any, f: Float[Array, " n"], spacing: Any) -> History:
    """A history of one point."""
    spacing = jnp.where(spacing > 0, spacing, jnp.ones_like(spacing))
    mesh = t - spacing * INDEX.astype(jnp.result_type(t))
    differences = jnp.concatenate([f[None], jnp.zeros((LENGTH - 1, f.size), f.dtype)])
    return History(differences, mesh, jnp.asarray(1, jnp.int32))


def spans(mesh: Float[Array, " length"]) -> Float[Array, " length-1"]:
    """The divisors of the factors of the basis. If the latest point is double, its span is the next one."""
    out = mesh[0] - mesh[1:]
    return jnp.where(out > 0, out, out[1])


def basis(mesh: Float[Array, " length"], t: Float[Array, " points"]) -> Float[Array, "length points"]:
    """The Newton basis of a mesh at given times."""
    length = mesh.shape[0]
    factors = (t[None, :] - mesh[:-1, None]) / spans(mesh)[:, None]
    one = jnp.ones((), factors.dtype)
    if length % 2:
        return _products_before(factors, one)
    # By pairs of rows there is a fourth of the work.
    firsts = factors[::2]
    pairs = _products_before(firsts[:-1] * factors[1::2], one)
    return jnp.stack([pairs, pairs * firsts], axis=1).reshape(length, -1)


def _products_before(factors, one):
    """For each row, and for a row after the last, the product of all rows before it."""
    # XLA compiles a product over a mask to one kernel, a cumulative product to a dozen.
    before = np.tril(np.ones((len(factors) + 1, len(factors)), dtype=bool), -1)
    return jnp.prod(jnp.where(before[:, :, None], factors[None], one), axis=1)


def basis_means(
    mesh: Float[Array, " length"], a: Any, b: Any
) -> tuple[Float[Array, " length"], Float[Array, " length"]]:
    """`(means, values)`: the mean over `[a, b]`, and the value at `b`, of the Newton basis of a mesh."""
    dtype = mesh.dtype
    table = basis(mesh, a + (b - a) * jnp.asarray(np.append(NODES, 1.0), dtype))
    # Written as a sum of terms: in a batch, XLA's reduction over a short axis is ten times as expensive.
    means = sum(jnp.asarray(weight, dtype) * table[:, k] for k, weight in enumerate(WEIGHTS))
    return jnp.asarray(means), table[:, -1]


def sums_before(terms: Float[Array, "length n"]) -> tuple[Float[Array, "length n"], Float[Array, " n"]]:
    """For each row, the sum of all rows before it; and the sum of all rows."""
    # By pairs of rows: a fourth of the work of a product with a triangular matrix.
    pairs = terms.reshape(LENGTH // 2, 2, -1)
    sums = np.tril(np.ones((LENGTH // 2 + 1, LENGTH // 2)), -1).astype(terms.dtype) @ (pairs[:, 0] + pairs[:, 1])
    both = jnp.stack([sums[:-1], sums[:-1] + pairs[:, 0]], axis=1)
    return both.reshape(terms.shape), sums[-1]


def before_each(length: int) -> np.ndarray:
    """A square matrix that sums, for each index, over the preceding indices."""
    return np.tril(np.ones((length, length)), -1)


def step_end(mesh: Float[Array, " length"], t: Any) -> Any:
    """`t`, or a later time if the step has zero length.

    Members of a batch that finish early make and discard such steps. With zero length they would divide by zero and
    spoil reverse-mode derivatives.
    """
    latest = mesh[0]
    return jnp.where(t > latest, t, latest + spans(mesh)[0])


def advance(history: History, t: Any, z: Float[Array, " n"], partial_sums: Float[Array, "length n"]) -> History:
    """The history with one more mesh point; `partial_sums` are the polynomials of all orders, evaluated there."""
    length = history.mesh.shape[0]
    return History(
        differences=known_differences(history.known, z, partial_sums),
        mesh=jnp.concatenate([t[None], history.mesh[:-1]]),
        known=jnp.minimum(history.known + 1, length).astype(np.int32),
    )


def known_differences(
    count: Int[Array, ""], z: Float[Array, " n"], partial_sums: Float[Array, "length n"]
) -> Float[Array, "length n"]:
    """The divided differences after a step with `z` at its end, from the `count` of points before it."""
    # Rows with placeholders stay zero: they are never used but would grow without bound.
    rows = count >= np.arange(partial_sums.shape[0], dtype=np.int32)
    return jnp.where(rows[:, None], z[None] - partial_sums, jnp.zeros((), z.dtype))
