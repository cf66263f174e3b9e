"""Independent rows of matrices of concrete numbers.

Pivots of a dense matrix are its largest entries. Pivots of a sparse matrix are chosen for little fill, among entries
not much smaller than the largest of their column. So the multiples of subtracted rows are not large.

Source: H. M. Markowitz, "The elimination form of the inverse and its application to linear programming", Management
Science 3(3), 1957; I. S. Duff, A. M. Erisman and J. K. Reid, "Direct Methods for Sparse Matrices", 2017, ch. 7
(threshold pivoting).
"""

import dataclasses
import heapq
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float, Int

# A pivot is at least this share of the largest entry of its column.
_THRESHOLD = 0.1
# The number of short rows among which a pivot is searched.
_SEARCHED = 4


@dataclasses.dataclass(frozen=True)
class SparsePivots:
    """The result of an elimination.

    **Fields:** `order`: the rows in the order in which they became pivots, then the dependent rows; `rank`, the number
    of pivots; `ratios`: for each row the pivot rows subtracted from it, as reduced then, and their multiples.
    """

    order: Int[np.ndarray, "m"]
    rank: int
    ratios: dict[int, list[tuple[int, float]]]

    def shares(self, row: int) -> dict[int, float]:
        """The multiples of pivot rows whose sum is this row, up to its remainder."""
        place = {pivot: k for k, pivot in enumerate(self.order[: self.rank].tolist())}
        multiples = dict(self.ratios[row])
        out: dict[int, float] = {}
        # A pivot row was reduced by multiples of earlier pivot rows: the last one comes first.
        heap = [-place[pivot] for pivot in multiples]
        heapq.heapify(heap)
        while heap:
            pivot = int(self.order[-heapq.heappop(heap)])
            out[pivot] = multiples.pop(pivot)
            for before, ratio in self.ratios[pivot]:
                if before not in multiples:
                    multiples[before] = 0.0
                    heapq.heappush(heap, -place[before])
                multiples[before] -= out[pivot] * ratio
        return out


def sparse_pivots(
    rows: Sequence[dict[int, float]], level: Sequence[int], *, zero: float, rounding: float
) -> SparsePivots:
    """Independent rows, and how the others depend on them.

    **Arguments:** `rows`: the entries of each row by column, of unit norm or zero; `level` of each row: rows of low
    levels become pivots first; `zero`: the largest remaining entry of a dependent row; `rounding`: smaller entries are
    dropped.
    """
    elimination = _Elimination(rows, rounding)
    kept: list[int] = []
    for current in sorted(set(level)):
        kept += elimination.run([r for r in range(len(rows)) if level[r] == current], zero)
    dependent = sorted(set(range(len(rows))) - set(kept))
    return SparsePivots(np.array(kept + dependent, int), len(kept), elimination.ratios)


class _Elimination:
    """The remaining `rows`, by column; for each of the `columns` the remaining rows with an entry in it; and for each
    row the `ratios`, the subtracted multiples of others.
    """

    def __init__(self, rows, rounding):
        self.rounding = rounding
        self.rows = {r: dict(entries) for r, entries in enumerate(rows)}
        self.columns: dict[int, set[int]] = {}
        self.ratios: dict[int, list[tuple[int, float]]] = {r: [] for r in self.rows}
        for r, entries in self.rows.items():
            for c in entries:
                self.columns.setdefault(c, set()).add(r)

    def run(self, candidates, zero):
        """Eliminate with pivots in the `candidates` while any of their entries exceeds `zero`; returns pivot rows."""
        heap = [(len(self.rows[r]), r) for r in candidates if self._largest(r) > zero]
        heapq.heapify(heap)
        allowed, kept = set(candidates), []
        while heap:
            pivot = self._choose(heap, zero)
            if pivot is None:
                break
            row, column = pivot
            kept.append(row)
            for changed in self._eliminate(row, column):
                if changed in allowed:
                    heapq.heappush(heap, (len(self.rows[changed]), changed))
        return kept

    def _largest(self, r):
        return max(map(abs, self.rows[r].values()), default=0.0)

    def _choose(self, heap, zero):
        """The pivot of the least Markowitz cost in a few short rows; if none is large enough, the entry with the
        largest share of its column. All rows but the pivot's go back to the heap.
        """
        best, largest, searched, seen = None, (0.0, 0, 0), [], set()
        while heap and not (best and len(searched) >= _SEARCHED):
            count, r = heapq.heappop(heap)
            # Entries of the heap from before a change are out of date.
            if r in seen or r not in self.rows or count != len(self.rows[r]) or self._largest(r) <= zero:
                continue
            seen.add(r)
            searched.append((count, r))
            for c, value in self.rows[r].items():
                if abs(value) <= zero:
                    continue
                rows_of_column = self.columns[c]
                cost = (count - 1) * (len(rows_of_column) - 1)
                if best is not None and cost >= best[0]:
                    continue
                share = abs(value) / max(abs(self.rows[k][c]) for k in rows_of_column)
                largest = max(largest, (share, r, c))
                if share >= _THRESHOLD:
                    best = cost, r, c
        if not searched:
            return None
        _, row, column = best or largest
        for item in searched:
            if item[1] != row:
                heapq.heappush(heap, item)
        return row, column

    def _eliminate(self, row, column):
        """Subtract multiples of a row from the others with an entry in the column; returns the changed rows."""
        pivot = self.rows.pop(row)
        for c in pivot:
            self.columns[c].discard(row)
        changed = self.columns.pop(column)
        value = pivot.pop(column)
        for r in changed:
            entries = self.rows[r]
            ratio = entries.pop(column) / value
            self.ratios[r].append((row, ratio))
            for c, entry in pivot.items():
                new = entries.get(c, 0.0) - ratio * entry
                if abs(new) > self.rounding:
                    entries[c] = new
                    self.columns[c].add(r)
                elif c in entries:
                    del entries[c]
                    self.columns[c].discard(r)
        return changed


def least_size(sizes: Float[np.ndarray, "*sets rows"]) -> Float[np.ndarray, "*sets 1"]:
    """The norm below which a row counts as zero, for each set of rows."""
    info = np.finfo(sizes.dtype)
    return np.maximum(info.eps**0.75 * np.max(sizes, axis=-1, initial=0.0, keepdims=True), info.tiny)


def dense_pivots(
    A: Float[np.ndarray, "m n"], level: Int[np.ndarray, "m"], zero: float
) -> tuple[Int[np.ndarray, "m"], int]:
    """Rows in the order of full pivoting, independent ones first, and the number of independent rows.

    Rows of low levels become pivots first. An equilibrated pivot below eps to the power `zero` counts as zero.
    """
    m, n = A.shape
    eps = float(np.finfo(A.dtype).eps)
    size = np.linalg.norm(A, axis=1)
    work = A / np.maximum(size, least_size(size))[:, None]
    is_left = np.ones(m, bool)
    kept = []
    for current in np.unique(level):
        while n and len(kept) < min(m, n):
            sizes = np.where((is_left & (level == current))[:, None], np.abs(work), 0.0)
            r, c = np.unravel_index(np.argmax(sizes), sizes.shape)
            if not sizes[r, c] > eps**zero:
                break
            is_left[r] = False
            kept.append(int(r))
            ratio = np.where(is_left, work[:, c] / work[r, c], 0.0)
            work = work - ratio[:, None] * work[r]
    return np.array([*kept, *np.flatnonzero(is_left)], int), len(kept)


def independent_in_order(jacobian: Float[np.ndarray, "m n"], order: Iterable[int]) -> Int[np.ndarray, "r"]:
    """Rows that do not depend on the rows before them, in an order."""
    kept, basis = [], np.zeros((0, jacobian.shape[1]), jacobian.dtype)
    for k in order:
        remainder = jacobian[k] - basis.T @ (basis @ jacobian[k])
        if np.linalg.norm(remainder) > np.finfo(jacobian.dtype).eps ** 0.5 * np.linalg.norm(jacobian[k]):
            kept, basis = [*kept, k], np.vstack([basis, remainder / np.linalg.norm(remainder)])
    return np.array(kept, int)
