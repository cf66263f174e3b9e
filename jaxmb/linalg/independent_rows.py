"""Independent rows of matrices of concrete numbers.

Pivots of a dense matrix are its largest entries. Those of a sparse one are chosen for few new entries, among entries
that are not much smaller than the largest of their column, so that no multiple of a row that is subtracted from another
one is large.

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
# Number of short rows among which the pivot is looked for.
_SEARCHED = 4


@dataclasses.dataclass(frozen=True)
class SparsePivots:
    """The result of an elimination.

    **Fields:** `order`: the rows in the order in which they became pivots, then those that depend on them; `rank`, the
    number of the first; `ratios`: for each row the multiples of pivots, as these were then, that were subtracted.
    """

    order: Int[np.ndarray, "m"]
    rank: int
    ratios: dict[int, list[tuple[int, float]]]

    def shares(self, row: int) -> dict[int, float]:
        """The multiples of rows that became pivots whose sum is this one, up to what was left of it."""
        place = {pivot: k for k, pivot in enumerate(self.order[: self.rank].tolist())}
        own = dict(self.ratios[row])
        out: dict[int, float] = {}
        # A pivot was a row less multiples of those before it: the last one first.
        heap = [-place[pivot] for pivot in own]
        heapq.heapify(heap)
        while heap:
            pivot = int(self.order[-heapq.heappop(heap)])
            out[pivot] = own.pop(pivot)
            for before, ratio in self.ratios[pivot]:
                if before not in own:
                    own[before] = 0.0
                    heapq.heappush(heap, -place[before])
                own[before] -= out[pivot] * ratio
        return out


def sparse_pivots(
    rows: Sequence[dict[int, float]], level: Sequence[int], *, zero: float, rounding: float
) -> SparsePivots:
    """Independent rows, and how the others depend on them.

    **Arguments:** `rows`: the entries of each by column, of unit norm or zero; `level` of each: rows of low levels
    become pivots first; `zero`: the largest entry that may be left of a row that depends on others; `rounding`: entries
    below this are dropped.
    """
    elimination = _Elimination(rows, rounding)
    kept: list[int] = []
    for own in sorted(set(level)):
        kept += elimination.run([r for r in range(len(rows)) if level[r] == own], zero)
    others = sorted(set(range(len(rows))) - set(kept))
    return SparsePivots(np.array(kept + others, int), len(kept), elimination.ratios)


class _Elimination:
    """Rows that are left, by column; for each column those of the rows that have an entry in it; and for each row the
    multiples of others that were subtracted.
    """

    def __init__(self, rows, rounding):
        self.rounding = rounding
        self.rows = {r: dict(own) for r, own in enumerate(rows)}
        self.columns: dict[int, set[int]] = {}
        self.ratios: dict[int, list[tuple[int, float]]] = {r: [] for r in self.rows}
        for r, own in self.rows.items():
            for c in own:
                self.columns.setdefault(c, set()).add(r)

    def run(self, candidates, zero):
        """Eliminate with pivots in some rows while any of their entries exceeds `zero`; the rows of the pivots."""
        heap = [(len(self.rows[r]), r) for r in candidates if self._largest(r) > zero]
        heapq.heapify(heap)
        own, kept = set(candidates), []
        while heap:
            pivot = self._choose(heap, zero)
            if pivot is None:
                break
            row, column = pivot
            kept.append(row)
            for changed in self._eliminate(row, column):
                if changed in own:
                    heapq.heappush(heap, (len(self.rows[changed]), changed))
        return kept

    def _largest(self, r):
        return max(map(abs, self.rows[r].values()), default=0.0)

    def _choose(self, heap, zero):
        """The pivot of the least Markowitz cost in a few short rows, or that of the largest share of its column where
        none is large enough; all but its row go back to the heap.
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
                others = self.columns[c]
                cost = (count - 1) * (len(others) - 1)
                if best is not None and cost >= best[0]:
                    continue
                share = abs(value) / max(abs(self.rows[k][c]) for k in others)
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
        """Subtract multiples of a row from the others that have an entry in the column; the rows that changed."""
        pivot = self.rows.pop(row)
        for c in pivot:
            self.columns[c].discard(row)
        changed = self.columns.pop(column)
        value = pivot.pop(column)
        for r in changed:
            own = self.rows[r]
            ratio = own.pop(column) / value
            self.ratios[r].append((row, ratio))
            for c, entry in pivot.items():
                new = own.get(c, 0.0) - ratio * entry
                if abs(new) > self.rounding:
                    own[c] = new
                    self.columns[c].add(r)
                elif c in own:
                    del own[c]
                    self.columns[c].discard(r)
        return changed


def least_size(sizes: Float[np.ndarray, "*sets rows"]) -> Float[np.ndarray, "*sets 1"]:
    """The norm of a row that counts as zero, for each set of rows."""
    info = np.finfo(sizes.dtype)
    return np.maximum(info.eps**0.75 * np.max(sizes, axis=-1, initial=0.0, keepdims=True), info.tiny)


def dense_pivots(
    A: Float[np.ndarray, "m n"], level: Int[np.ndarray, "m"], zero: float
) -> tuple[Int[np.ndarray, "m"], int]:
    """Rows in the order of full pivoting, independent ones first, and their number; rows of low levels become pivots
    first, and an equilibrated pivot below this power `zero` of eps is none.
    """
    m, n = A.shape
    eps = float(np.finfo(A.dtype).eps)
    size = np.linalg.norm(A, axis=1)
    work = A / np.maximum(size, least_size(size))[:, None]
    left = np.ones(m, bool)
    kept = []
    for own in np.unique(level):
        while n and len(kept) < min(m, n):
            sizes = np.where((left & (level == own))[:, None], np.abs(work), 0.0)
            r, c = np.unravel_index(np.argmax(sizes), sizes.shape)
            if not sizes[r, c] > eps**zero:
                break
            left[r] = False
            kept.append(int(r))
            ratio = np.where(left, work[:, c] / work[r, c], 0.0)
            work = work - ratio[:, None] * work[r]
    return np.array([*kept, *np.flatnonzero(left)], int), len(kept)


def independent_in_order(jacobian: Float[np.ndarray, "m n"], order: Iterable[int]) -> Int[np.ndarray, "r"]:
    """Rows that do not depend on those before them, in an order."""
    kept, basis = [], np.zeros((0, jacobian.shape[1]), jacobian.dtype)
    for k in order:
        own = jacobian[k] - basis.T @ (basis @ jacobian[k])
        if np.linalg.norm(own) > np.finfo(jacobian.dtype).eps ** 0.5 * np.linalg.norm(jacobian[k]):
            kept, basis = [*kept, k], np.vstack([basis, own / np.linalg.norm(own)])
    return np.array(kept, int)
