"""Which rows of the constraints are independent, part by part of the joint graph.

The rows of a joint depend on the relative motion of its bodies only. So the rank of all rows is the sum of the ranks of
the biconnected components of the joint graph, each with one of its bodies held, and rows that others imply are implied
by rows of their own component. A part that binds a body to the world has the ground among its bodies.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..linalg.sparse_pivots import pivot_rows
from ..system.block_cut_tree import components
from ..system.layout import Layout

# An equilibrated pivot below this power of eps is zero: implied rows give 1e-16, the nearest of true ranks 1e-4.
_ZERO = 0.5
# A dense component of so many rows takes 0.1 s, and the time grows with the cube.
_DENSE = 300


class Part(NamedTuple):
    """A constraint of one kernel: its bodies, and the first and the number of its rows among all."""

    bodies: tuple[int, ...]
    first: int
    rows: int


class Subset(NamedTuple):
    """Rows of A that depend on each other only, in columns that determine their rank.

    **Fields:** `parts`: their numbers; `rows` and `columns` of A; `kept`: those of the rows that are independent, of
    low levels first; `dropped`: the others.
    """

    parts: tuple[int, ...]
    rows: Int[np.ndarray, "m"]
    columns: Int[np.ndarray, "n"]
    kept: Int[np.ndarray, "r"]
    dropped: Int[np.ndarray, "d"]


def matrix(
    parts: Sequence[Part],
    blocks: Sequence[Float[np.ndarray, "rows k v"]],
    layout: Layout,
    own: Sequence[int],
    columns: Int[np.ndarray, "n"],
) -> Float[np.ndarray, "m n"]:
    """Rows of some parts in some columns, from the blocks of all parts."""
    out = np.zeros((sum(parts[p].rows for p in own), columns.size), blocks[0].dtype if blocks else float)
    row = 0
    for p in own:
        for k, body in enumerate(parts[p].bodies):
            index = layout.velocity_index[body]
            place = np.minimum(np.searchsorted(columns, index), columns.size - 1) if columns.size else index
            here = (columns[place] == index) if columns.size else np.zeros(index.size, bool)
            out[row : row + parts[p].rows, place[here]] += blocks[p][:, k, here]
        row += parts[p].rows
    return out


def subsets(
    parts: Sequence[Part],
    blocks: Sequence[Float[np.ndarray, "rows k v"]],
    layout: Layout,
    scale: Float[np.ndarray, "nu"],
    level: Int[np.ndarray, "rows"],
    absolute: frozenset[int],
    dense: int = _DENSE,
) -> list[Subset]:
    """The rows of each component, and which of them are independent.

    **Arguments:** `blocks` of the parts; `scale` of the columns; `level` of each row: rows of low levels are kept
    first; `absolute`: parts that do not depend on relative motions alone; `dense`: components of more rows than this
        are eliminated as sparse matrices.
    """
    ground = layout.bodies
    vertices = [{*part.bodies, *([ground] if p in absolute else ())} for p, part in enumerate(parts)]
    out = []
    for component in components(vertices, ground):
        bodies = sorted({body for p in component.joints for body in vertices[p]} - {component.top, ground})
        columns = layout.velocity_index[bodies].ravel() if bodies else np.zeros(0, int)
        columns = np.sort(columns[columns < layout.nu])
        rows = np.concatenate([np.arange(parts[p].first, parts[p].first + parts[p].rows) for p in component.joints])
        if rows.size > dense:
            order, rank = _sparse_pivot_rows(
                parts, blocks, layout, component.joints, set(columns.tolist()), scale, level[rows]
            )
        else:
            own = matrix(parts, blocks, layout, component.joints, columns) * scale[columns]
            order, rank = _pivot_rows(own, level[rows])
        out.append(Subset(component.joints, rows, columns, rows[order[:rank]], rows[order[rank:]]))
    return out


def absolute_parts(
    parts: Sequence[Part], blocks: Sequence[Float[np.ndarray, "rows k v"]], motions: Float[np.ndarray, "d b v"]
) -> frozenset[int]:
    """Parts whose rows change in motions of all bodies as one, and those of a single body, which are bound to the
    world.

    **Arguments:** `motions`: velocities of all bodies, and zeros of the ground, in some motions as one.
    """
    ground = motions.shape[1] - 1
    out = set()
    for p, part in enumerate(parts):
        if ground in part.bodies:
            continue
        change = np.einsum("rkv,dkv->rd", blocks[p], motions[:, list(part.bodies)])
        size = np.einsum("rkv,dkv->rd", np.abs(blocks[p]), np.abs(motions[:, list(part.bodies)]))
        if len(part.bodies) == 1 or np.any(np.abs(change) > np.finfo(change.dtype).eps ** 0.75 * (size + 1e-300)):
            out.add(p)
    return frozenset(out)


def _pivot_rows(A, level):
    """Rows in the order of full pivoting, independent ones first, and their number."""
    m, n = A.shape
    eps = float(np.finfo(A.dtype).eps)
    size = np.linalg.norm(A, axis=1)
    floor = max(eps**0.75 * np.max(size, initial=0.0), float(np.finfo(A.dtype).tiny))
    work = A / np.maximum(size, floor)[:, None]
    left = np.ones(m, bool)
    kept = []
    for own in np.unique(level):
        while n and len(kept) < min(m, n):
            sizes = np.where((left & (level == own))[:, None], np.abs(work), 0.0)
            r, c = np.unravel_index(np.argmax(sizes), sizes.shape)
            if not sizes[r, c] > eps**_ZERO:
                break
            left[r] = False
            kept.append(int(r))
            ratio = np.where(left, work[:, c] / work[r, c], 0.0)
            work = work - ratio[:, None] * work[r]
    return np.array([*kept, *np.flatnonzero(left)], int), len(kept)


def _sparse_pivot_rows(parts, blocks, layout, own, columns, scale, level):
    """`_pivot_rows` of some parts in some columns, without a dense matrix; pivots follow from sparsity."""
    rows: list[dict[int, float]] = []
    for p in own:
        index = layout.velocity_index[list(parts[p].bodies)].ravel()
        values = blocks[p].reshape(parts[p].rows, -1)
        for row in values:
            entries: dict[int, float] = {}
            for c, value in zip(index.tolist(), row.tolist(), strict=True):
                if value and c in columns:
                    entries[c] = entries.get(c, 0.0) + value * float(scale[c])
            rows.append(entries)
    eps = float(np.finfo(scale.dtype).eps)
    sizes = [math.sqrt(sum(x * x for x in entries.values())) for entries in rows]
    floor = max(eps**0.75 * max(sizes, default=0.0), float(np.finfo(scale.dtype).tiny))
    unit = [{c: x / max(size, floor) for c, x in entries.items()} for entries, size in zip(rows, sizes, strict=True)]
    return pivot_rows(unit, level.tolist(), zero=eps**_ZERO, rounding=4 * eps)
