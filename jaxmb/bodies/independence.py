"""The independent rows of the constraints, by biconnected components of the joint graph.

The rows of a joint depend on the relative motion of its bodies only. So the rank of all rows is the sum of the ranks of
the biconnected components, each with one body held. An implied row is implied by rows of its component. A part that
binds a body to the world has the ground among its bodies.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..linalg.graphs import components
from ..linalg.independent_rows import SparsePivots, dense_pivots, least_size, sparse_pivots
from .layout import Layout

# An equilibrated pivot below this power of eps is zero: implied rows give 1e-16, the smallest true pivots 1e-4.
_ZERO = 0.5
# Largest number of rows of a dense component: it takes 0.1 s, and the time grows with the cube.
_DENSE = 300
# Smallest share of a row that counts in an implied row, both of unit norm.
_NEGLIGIBLE = 1e-6


class JointRows(NamedTuple):
    """A constraint of one kernel: its bodies, the index of its `first` row in A, and its count of `rows`."""

    bodies: tuple[int, ...]
    first: int
    rows: int

    @property
    def numbers(self) -> Int[np.ndarray, "rows"]:
        """The indices of its rows in A."""
        return np.arange(self.first, self.first + self.rows)


class Subset(NamedTuple):
    """A group of rows of A that depend only on each other, in columns that determine their rank.

    **Fields:** indices of the `parts`; `rows` and `columns` of A; `kept`: independent rows, low levels first;
    `dropped`: the remaining rows; `is_sparse`: whether the rows are too many for dense matrices; `shares` of kept rows
    in dropped rows.
    """

    parts: tuple[int, ...]
    rows: Int[np.ndarray, "m"]
    columns: Int[np.ndarray, "n"]
    kept: Int[np.ndarray, "r"]
    dropped: Int[np.ndarray, "d"]
    is_sparse: bool
    shares: tuple["Share", ...]


class Share(NamedTuple):
    """A `row` that is the sum of `multiples` of the rows `by`."""

    row: int
    by: Int[np.ndarray, "k"]
    multiples: Float[np.ndarray, "k"]


class JointBlocks(NamedTuple):
    """The rows of the constraints as blocks of joints on bodies.

    **Fields:** the `parts` and their `blocks`; the `layout` of the bodies; the `scale` of the columns.
    """

    parts: Sequence[JointRows]
    blocks: Sequence[Float[np.ndarray, "rows k v"]]
    layout: Layout
    scale: Float[np.ndarray, "nu"]

    def dense(self, numbers: Sequence[int], columns: Int[np.ndarray, "n"]) -> Float[np.ndarray, "m n"]:
        """The rows of the parts with indices `numbers`, in some `columns`, as a dense matrix."""
        out = np.zeros((sum(self.parts[p].rows for p in numbers), columns.size), self.scale.dtype)
        row = 0
        for p in numbers:
            for k, body in enumerate(self.parts[p].bodies):
                index = self.layout.velocity_index[body]
                place = np.minimum(np.searchsorted(columns, index), columns.size - 1) if columns.size else index
                present = (columns[place] == index) if columns.size else np.zeros(index.size, bool)
                out[row : row + self.parts[p].rows, place[present]] += self.blocks[p][:, k, present]
            row += self.parts[p].rows
        return out

    def subsets(self, level: Int[np.ndarray, "rows"], absolute: frozenset[int], dense: int = _DENSE) -> list[Subset]:
        """The rows of each component, with a choice of independent rows.

        **Arguments:** `level` of each row: rows of low levels are kept first; `absolute`: parts that bind bodies to the
        world; `dense`: components of more rows than this are eliminated as sparse matrices.
        """
        ground = self.layout.ground
        vertices = [{*part.bodies, *([ground] if p in absolute else ())} for p, part in enumerate(self.parts)]
        biconnected = components(vertices, ground)
        alone = {component.joints[0]: component.top for component in biconnected if len(component.joints) == 1}
        regular = self._regular_parts(alone)
        out = []
        for component in biconnected:
            bodies = sorted({body for p in component.joints for body in vertices[p]} - {component.top, ground})
            columns = self.layout.velocity_index[bodies].ravel() if bodies else np.zeros(0, int)
            columns = np.sort(columns[columns < self.layout.nu])
            rows = np.concatenate([self.parts[p].numbers for p in component.joints])
            numbers, shares, is_sparse = component.joints, (), rows.size > dense
            if len(numbers) == 1 and numbers[0] in regular:
                order, rank = np.argsort(level[rows], kind="stable"), rows.size
            elif is_sparse:
                pivots, sizes = self.eliminate(numbers, columns, level[rows], _ZERO)
                order, rank = pivots.order, pivots.rank
                shares = tuple(_sparse_share(pivots, sizes, rows, r) for r in order[rank:].tolist())
            else:
                whole = self.dense(numbers, columns)
                order, rank = dense_pivots(whole * self.scale[columns], level[rows], _ZERO)
                shares = _dense_shares(whole, rows, order[:rank], order[rank:]) if rank < rows.size else ()
            out.append(Subset(numbers, rows, columns, rows[order[:rank]], rows[order[rank:]], is_sparse, shares))
        return out

    def eliminate(
        self, numbers: Sequence[int], columns: Int[np.ndarray, "n"], level: Int[np.ndarray, "m"], zero: float
    ) -> tuple[SparsePivots, Float[np.ndarray, "m"]]:
        """Independent rows of some parts in some columns, without a dense matrix; and the norms of the rows.

        Sparsity decides the pivots; a pivot below this power `zero` of eps counts as zero.
        """
        rows: list[dict[int, float]] = []
        wanted, scales = set(columns.tolist()), self.scale.tolist()
        for p in numbers:
            index = self.layout.velocity_index[list(self.parts[p].bodies)].ravel().tolist()
            for row in self.blocks[p].reshape(self.parts[p].rows, -1).tolist():
                entries: dict[int, float] = {}
                for c, value in zip(index, row, strict=True):
                    if value and c in wanted:
                        entries[c] = entries.get(c, 0.0) + value * scales[c]
                rows.append(entries)
        eps = float(np.finfo(self.scale.dtype).eps)
        sizes = np.array([math.sqrt(sum(x * x for x in entries.values())) for entries in rows], self.scale.dtype)
        sizes = np.maximum(sizes, least_size(sizes))
        unit = [{c: x / size for c, x in entries.items()} for entries, size in zip(rows, sizes.tolist(), strict=True)]
        return sparse_pivots(unit, level.tolist(), zero=eps**zero, rounding=4 * eps), sizes

    def absolute_parts(self, motions: Float[np.ndarray, "d b v"]) -> frozenset[int]:
        """Parts that bind bodies to the world: rows of one body, and rows that change as all bodies move as one.

        **Arguments:** `motions`: velocities in motions of all bodies as one, zeros for scalar coordinates and ground.
        """
        ground = motions.shape[1] - 1
        out = set()
        for numbers, bodies, blocks in self._alike(range(len(self.parts))):
            change = np.einsum("prkv,dpkv->prd", blocks, motions[:, bodies])
            size = np.einsum("prkv,dpkv->prd", np.abs(blocks), np.abs(motions[:, bodies]))
            moved = np.abs(change) > np.finfo(change.dtype).eps ** 0.75 * (size + 1e-300)
            bound = np.any(moved, axis=(1, 2)) | (bodies.shape[1] == 1)
            out.update(numbers[bound & ~np.any(bodies == ground, axis=1)].tolist())
        return frozenset(out)

    def _alike(self, numbers):
        """For each shape of blocks the parts' indices, bodies (parts, k), and blocks (parts, rows, k, v)."""
        groups: dict[tuple[int, ...], list[int]] = {}
        for p in numbers:
            groups.setdefault(self.blocks[p].shape, []).append(p)
        for members in groups.values():
            yield (
                np.array(members),
                np.array([self.parts[p].bodies for p in members]),
                np.stack([self.blocks[p] for p in members]),
            )

    def _regular_parts(self, held):
        """Parts whose rows are all independent while one body is held: `dense_pivots` of many matrices at once.

        **Arguments:** `held`: the held body of each part, by the part's index.
        """
        out = set()
        of_bodies = np.append(self.scale, 0.0)[np.minimum(self.layout.velocity_index, self.layout.nu)]
        of_bodies[self.layout.ground] = 0.0
        for numbers, bodies, blocks in self._alike(held):
            top = np.array([held[p] for p in numbers])
            free = np.where((bodies == top[:, None])[:, :, None], 0.0, of_bodies[bodies])
            work = (blocks * free[:, None]).reshape(*blocks.shape[:2], -1)
            size = np.linalg.norm(work, axis=2)
            work = work / np.maximum(size, least_size(size))[:, :, None]
            number, rows = np.arange(len(work)), work.shape[1]
            independent = np.full(len(work), rows <= work.shape[2])
            for _ in range(rows):
                pivot = np.argmax(np.abs(work).reshape(len(work), -1), axis=1)
                r, c = np.divmod(pivot, work.shape[2])
                value, row = work[number, r, c], work[number, r]
                independent &= np.abs(value) > np.finfo(work.dtype).eps ** _ZERO
                ratio = work[number, :, c] / np.where(independent, value, 1.0)[:, None]
                work = work - ratio[:, :, None] * row[:, None]
                work[number, r] = 0.0
            out.update(numbers[independent].tolist())
        return out


def _dense_shares(whole, rows, kept, dropped):
    kept_sizes, dropped_sizes = (np.linalg.norm(whole[numbers], axis=1) for numbers in (kept, dropped))
    unit = np.linalg.lstsq(
        (whole[kept] / kept_sizes[:, None]).T, (whole[dropped] / dropped_sizes[:, None]).T, rcond=None
    )[0].T
    implying = [np.flatnonzero(np.abs(share) > _NEGLIGIBLE) for share in unit]
    return tuple(
        Share(int(rows[r]), rows[kept[by]], share[by] * size / kept_sizes[by])
        for r, by, share, size in zip(dropped, implying, unit, dropped_sizes, strict=True)
    )


def _sparse_share(pivots, sizes, rows, r):
    shares = {k: x for k, x in pivots.shares(r).items() if abs(x) > _NEGLIGIBLE}
    by = np.array(list(shares), int)
    return Share(int(rows[r]), rows[by], np.array(list(shares.values())) * sizes[r] / sizes[by])
