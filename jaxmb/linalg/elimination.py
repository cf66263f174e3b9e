"""Gaussian elimination with full pivoting inside `lax`: which columns depend on which, and the influence matrix.

A constraint Jacobian `A` (m × n) of rank r has r dependent and n − r independent columns, `A_d δx_d + A_i δx_i = 0`. So
`δx_d = H δx_i` with the influence matrix `H = −A_d⁻¹ A_i`. Full pivoting chooses the split for which H stays of order
one. The other m − r rows are implied.

Searching for pivots is the expensive part, so it is done only when a chart is made (`full_pivot`); at every other state
the same split is used without search (`eliminate`). Pivots are integers without a derivative; values have one.

Source: R. A. Wehage and E. J. Haug, "Generalized Coordinate Partitioning for Dimension Reduction in Analysis of
Constrained Dynamic Systems", J. Mech. Design 104(1), 1982.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .._compat import custom_vmap, sequential_vmap
from .pushed import filled

# The largest number of rows for each way of sweeping; see jaxmb.linalg for the measurement.
_ROTATING_SIZE = 18
_LOOP_SIZE = 40


class PivotOrder(eqx.Module):
    """An order of elimination: two permutations and their inverses, packed in one array of integers.

    **Fields:** `packed`; `m`, `n`: the matrix's shape, static. `rows` has pivot rows first and implied rows last,
    `columns` dependent columns first and independent ones last; `row_place` and `column_place` are their inverses.
    """

    packed: Int[Array, "both"]
    m: int = eqx.field(static=True)
    n: int = eqx.field(static=True)

    @property
    def rows(self) -> Int[Array, "m"]:
        return self.packed[: self.m]

    @property
    def columns(self) -> Int[Array, "n"]:
        return self.packed[self.m : self.m + self.n]

    @property
    def row_place(self) -> Int[Array, "m"]:
        return self.packed[self.m + self.n : 2 * self.m + self.n]

    @property
    def column_place(self) -> Int[Array, "n"]:
        return self.packed[2 * self.m + self.n :]


class PivotSearch(eqx.Module):
    """Result of `full_pivot`; integers and sizes, without derivatives.

    **Fields:** `rank`; `order` of elimination; `smallest` and `largest` pivot of the equilibrated matrix.
    """

    rank: Int[Array, ""]
    order: PivotOrder
    smallest: Float[Array, ""]
    largest: Float[Array, ""]


class Factor(eqx.Module):
    """The solved form of `A δx = −residual` in a given split, in matrices of full size.

    **Fields:** `right_inverse` (n × m): `δx = −right_inverse @ residual` makes `A δx = −residual` while the independent
    columns keep their values; the columns of implied rows are zero. `null_space` (n × (n − r)): `δx = null_space @
    δx_i` spans the null space of A, with the identity on the independent rows and the influence matrix H on the
    dependent ones. `rows` (r,): the independent rows; None in tangents.
    """

    right_inverse: Float[Array, "n m"]
    null_space: Float[Array, "n f"]
    rows: Int[Array, "r"] | None

    def for_matrix(self, matrix: Float[Array, "m n"]) -> "Factor":
        """The same numbers, with the derivatives of the factor of this `matrix`, which has the same value."""
        return _for_matrix(self, matrix)


@eqx.filter_custom_jvp
def _for_matrix(factor, matrix):
    del matrix
    return factor


@_for_matrix.def_jvp
def _for_matrix_jvp(primals, tangents):
    factor, change = _for_matrix(*primals), filled(primals[1], tangents[1])
    pushed = factor.right_inverse @ change
    return factor, Factor(-(pushed @ factor.right_inverse), -(pushed @ factor.null_space), None)


# A program has several searches and eliminations, and traces each once.
@functools.partial(jax.jit, static_argnames="tol")
def full_pivot(
    A: Float[Array, "m n"],
    *,
    scale: Float[Array, "n"] | None = None,
    level: Int[Array, "m"] | None = None,
    tol: float | None = None,
) -> PivotSearch:
    """Eliminate with full pivoting.

    **Arguments:**

    - `A`: the matrix, m × n, any shape and rank.
    - `scale`: size of a typical change of each column's coordinate (a length for translations, 1 for angles), shape
        (n,); the matrix is equilibrated with it, and its rows brought to unit norm, before pivots are compared.
    - `level`: rows of level 0 are eliminated before rows of higher levels, shape (m,). This nests the dependent columns
        of nonholonomic rows in the independent columns of the holonomic ones.
    - `tol`: an equilibrated pivot below this is zero. Default √eps: implied rows give 1e-16, others at least 1e-4.
    """
    m, n = A.shape
    A = lax.stop_gradient(A)
    eps = jnp.finfo(A.dtype).eps
    zero = float(eps) ** 0.5 if tol is None else tol
    work = A if scale is None else A * scale[None, :]
    size = jnp.sqrt(jnp.sum(work * work, axis=1))
    # A row of rounding errors must not be scaled up to unit norm.
    work = (
        work / jnp.maximum(jnp.maximum(size, eps**0.75 * jnp.max(size, initial=0.0)), jnp.finfo(A.dtype).tiny)[:, None]
    )
    unused = jnp.iinfo(jnp.int32).max
    rows, columns = jnp.arange(m), jnp.arange(n)

    # The matrix is transposed: XLA then finds the largest entry of each row four times as fast, and the largest of
    # these faster than the largest of a matrix.
    def step(k, carry):
        work, row_order, column_order, smallest, largest, rank = carry
        size = jnp.abs(work)
        open_row = row_order == unused
        open_ = open_row[None, :] & (column_order == unused)[:, None] & (size > zero)
        candidates = jnp.where(open_, size, 0.0)
        if level is not None:
            first = jnp.where((level == 0)[None, :], candidates, 0.0)
            candidates = jnp.where(jnp.any(first > 0), first, candidates)
        of_rows = jnp.max(candidates, axis=0)
        r = jnp.argmax(of_rows)
        c = jnp.argmax(candidates[:, r])
        is_row, is_column = rows == r, columns == c
        pivot = of_rows[r]
        has_pivot = pivot > 0
        ratio = jnp.where(open_row & ~is_row & has_pivot, work[c] / jnp.where(has_pivot, work[c, r], 1.0), 0.0)
        work = work - ratio[None, :] * work[:, r][:, None]
        row_order = jnp.where(is_row & has_pivot, k, row_order)
        column_order = jnp.where(is_column & has_pivot, k, column_order)
        smallest = jnp.where(has_pivot, jnp.minimum(smallest, pivot), smallest)
        return work, row_order, column_order, smallest, jnp.maximum(largest, pivot), rank + has_pivot.astype(rank.dtype)

    start = (
        work.T,
        jnp.full(m, unused, jnp.int32),
        jnp.full(n, unused, jnp.int32),
        jnp.array(jnp.inf, A.dtype),
        jnp.array(0.0, A.dtype),
        jnp.array(0),
    )
    _, row_order, column_order, smallest, largest, rank = start if m == 0 else lax.fori_loop(0, min(m, n), step, start)
    row_place, column_place = _places(row_order), _places(column_order)
    packed = jnp.concatenate([_inverse(row_place), _inverse(column_place), row_place, column_place])
    return PivotSearch(rank, PivotOrder(packed, m, n), smallest, largest)


def _places(keys: Int[Array, "n"]) -> Int[Array, "n"]:
    """The places of numbers in ascending order; equal numbers keep their order."""
    index = np.arange(keys.size, dtype=np.int32)
    before = (keys[None, :] < keys[:, None]) | ((keys[None, :] == keys[:, None]) & (index[None, :] < index[:, None]))
    return jnp.sum(before, axis=1, dtype=np.int32)


def _inverse(permutation: Int[Array, "n"]) -> Int[Array, "n"]:
    index = np.arange(permutation.size, dtype=np.int32)
    return jnp.sum(jnp.where(permutation[None, :] == index[:, None], index[None, :], 0), axis=1, dtype=np.int32)


@functools.partial(jax.jit, static_argnames="rank")
def eliminate(A: Float[Array, "m n"], order: PivotOrder, rank: int) -> Factor:
    """Eliminate in the order of a chart, without search; differentiable in `A`.

    **Arguments:** `A`: the matrix; `order` from `PivotSearch`; `rank` of the matrix, static.
    """
    m, n = A.shape
    rows = order.rows[:rank]
    row, column = order.row_place[None, :], order.column_place[:, None]
    free = np.arange(rank, n, dtype=np.int32)[None, :]
    identity = (column == free).astype(A.dtype)
    if rank == 0:
        return Factor(jnp.zeros((n, m), A.dtype), identity, rows)
    # Each gather by pairs of indices is one kernel, in the layout that the next operation needs. The first is in
    # bounds; the others clip the indices of independent columns, whose values are unused.
    swept = gauss_jordan(_gather(A, rows[:, None], order.columns[None, :], "promise_in_bounds"), rank)
    dependent = column < rank
    right_inverse = jnp.where(dependent & (row < rank), _gather(swept, column, row, "clip"), 0.0)
    null_space = jnp.where(dependent, -_gather(swept, column, free, "clip"), identity)
    return Factor(right_inverse, null_space, rows)


def _gather(A, row, column, mode):
    return A.at[row, column].get(mode=mode, wrap_negative_indices=False)


@jax.custom_jvp
def _sweep(B: Float[Array, "r n"]) -> Float[Array, "r n"]:
    if B.shape[0] > _LOOP_SIZE:
        return _sweep_blocked(B)
    return (_sweep_in_place if B.shape[0] > _ROTATING_SIZE else _sweep_rotating)(B)


@custom_vmap
def _sweep_rotating(B):
    return _rotate(B)


@_sweep_rotating.def_vmap
def _sweep_rotating_batch(size, batched, B):
    # With the batch along the last axis, every operation is one long vector operation instead of many short loops.
    del size
    if not batched[0]:
        return _rotate(B), False
    return jnp.moveaxis(_rotate(jnp.moveaxis(B, 0, -1)), -1, 0), True


def _rotate(B):
    r = B.shape[0]

    def step(_, B):
        # The pivot is always in the corner; then its row moves to the bottom, and its column to the end of the square.
        row = B[0] / B[:1, 0]
        row = jnp.concatenate([row[1:r], 1 / B[0, :1], row[r:]])
        rest = jnp.concatenate([B[1:, 1:r], jnp.zeros_like(B[1:, :1]), B[1:, r:]], axis=1)
        return jnp.concatenate([rest - B[1:, :1] * row[None], row[None]])

    return lax.fori_loop(0, r, step, B)


def _sweep_in_place(B):
    r, n = B.shape
    i = jnp.arange(r)[:, None]
    j = jnp.arange(n)[None, :]

    def step(k, B):
        row = jnp.where(j[0] == k, 1.0, B[k]) / B[k, k]
        return jnp.where(i == k, row[None, :], jnp.where(j == k, 0.0, B) - B[:, k][:, None] * row[None, :])

    return lax.fori_loop(0, r, step, B)


# The members of a batch are eliminated one after the other: XLA's batched LAPACK kernels have deadlocked in loops
# (jaxlib 0.10.2, two cores, 64 matrices of 35 rows).
@sequential_vmap
def _sweep_blocked(B):
    r = B.shape[0]
    inverse = jnp.linalg.inv(B[:, :r])
    return jnp.concatenate([inverse, inverse @ B[:, r:]], axis=1)


@_sweep.defjvp
def _sweep_jvp(primals, tangents):
    (B,), (dB,) = primals, tangents
    r = B.shape[0]
    swept = _sweep(B)
    inverse = swept[:, :r]
    dinverse = -inverse @ dB[:, :r] @ inverse
    if B.shape[1] == r:
        # Empty arrays are avoided: jaxlib 0.10.2 loses its LAPACK calls in programs with products of empty arrays.
        return swept, dinverse
    return swept, jnp.concatenate([dinverse, inverse @ (dB[:, r:] - dB[:, :r] @ swept[:, r:])], axis=1)


def gauss_jordan(B: Float[Array, "r n"], r: int) -> Float[Array, "r n"]:
    """`[B_d⁻¹, B_d⁻¹ B_i]` for `B = [B_d, B_i]`, whose first r columns are eliminated on the diagonal, in place."""
    if r == 0:
        return B
    assert B.shape[0] == r
    return _sweep(B)


def positive_solver(M: Float[Array, "n n"]) -> Callable[[Float[Array, "n *k"]], Float[Array, "n *k"]]:
    """`b -> M⁻¹ b` for a symmetric positive definite matrix or a root of one: diagonal pivots need no search."""
    n = M.shape[0]
    if n == 1:
        return lambda b: b / M[0, 0]
    inverse = gauss_jordan(M, n)
    return lambda b: inverse @ b


def solve_positive(M: Float[Array, "n n"], b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """`M⁻¹ b`, as by `positive_solver`."""
    return positive_solver(M)(b)


def solve(A: Float[Array, "n n"], b: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """`A⁻¹ b` for any regular matrix.

    Up to forty rows no library is called, since XLA would leave its loop over steps for the call. One correction makes
    the residual as small as by elimination, up to a condition number of 1e10.
    """
    n = A.shape[0]
    if n == 0:
        return b
    if n == 1:
        return b / A[0, 0]
    if n > _LOOP_SIZE:
        return jnp.linalg.solve(A, b)
    inverse = _inverse_of(A)
    x = inverse @ b
    return x + inverse @ (b - A @ x)


@jax.custom_jvp
def _inverse_of(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse, by elimination with the largest pivot of each column."""
    n = A.shape[0]
    index = np.arange(n, dtype=np.int32)

    def step(k, carry):
        work, place = carry
        here = index == lax.argmax(jnp.where(place < 0, jnp.abs(work[:, k]), -1.0), 0, np.int32)
        row = jnp.sum(jnp.where(here[:, None], work, 0.0), axis=0)
        row = row / row[k]
        work = jnp.where(here[:, None], row[None, :], work - work[:, k][:, None] * row[None, :])
        return work, jnp.where(here, jnp.asarray(k, np.int32), place)

    start = jnp.concatenate([A, jnp.eye(n, dtype=A.dtype)], axis=1), jnp.full(n, -1, jnp.int32)
    work, place = lax.fori_loop(0, n, step, start)
    return (place[None, :] == index[:, None]).astype(A.dtype) @ work[:, n:]


@_inverse_of.defjvp
def _inverse_of_jvp(primals, tangents):
    (A,), (dA,) = primals, tangents
    inverse = _inverse_of(A)
    return inverse, -inverse @ dA @ inverse


@jax.custom_jvp
def cholesky(M: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A root L of a symmetric positive definite matrix, `M = L Lᵀ`, lower triangular.

    `L U` with an orthogonal U is another root. The derivatives belong to a root that follows M without staying
    triangular; they are right, to every order, for results that do not depend on the choice of the root.
    """
    n = M.shape[0]
    rows = jnp.arange(n)

    def add_column(k, root):
        column = M[k] - root @ root[k]
        return root.at[:, k].set(jnp.where(rows < k, 0.0, column) / jnp.sqrt(column[k]))

    return lax.fori_loop(0, n, add_column, jnp.zeros_like(M))


@cholesky.defjvp
def _cholesky_jvp(primals, tangents):
    (M,), (dM,) = primals, tangents
    root = cholesky(M)
    return root, 0.5 * dM @ gauss_jordan(root, M.shape[0]).T
