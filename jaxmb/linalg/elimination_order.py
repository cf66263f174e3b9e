"""The order of elimination of the nodes of a symmetric block-sparse matrix: graph arithmetic on integers.

Nodes that are not neighbours are eliminated together. Each level takes nodes of low degree. So a chain of n nodes needs
about log₂ n levels (cyclic reduction), and a tree loses its leaves and its paths at once. A level is cut into steps of
a fixed number of lanes. So one loop executes all steps of a stage, and the size of a program does not depend on the
number of nodes. The last nodes, when few are left or most are neighbours, are eliminated together as one dense matrix.

Sources: J. W. H. Liu, "The role of elimination trees in sparse factorization", SIAM J. Matrix Anal. Appl. 11(1), 1990
(fill); M. Luby, SIAM J. Comput. 15(4), 1986 (independent sets).
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from .digest import digest

_CAPS = (2, 3, 4, 6, 8, 12)
# Costs in µs on one core of 2 GHz: of one step of the loop, and of one multiplication in a lane.
_STEP = 1.2
_FLOP = 0.0006
# Costs of a dense matrix: each column is a step of its elimination.
_DENSE_STEP = 0.15
_DENSE_FLOP = 0.0003
# The largest number of nodes of the dense matrix.
_LARGEST_REST = 400
# An order of more levels than this is executed in one stage, and avoided if all bounds on the degree are tried.
_MOST_LEVELS = 128
_LANES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)


@dataclasses.dataclass(frozen=True)
class Stage:
    """Steps of elimination that one loop executes; each takes w nodes (lanes) that are not neighbours of each other.

    Padding lanes have the index of the node after the last. With n blocks, padding blocks have the index n, of a zero
    block; padding diagonal blocks have the index n + 1, of an identity.

    **Fields:** `nodes` (steps, w): the nodes; `later` (steps, w, d): their neighbours that are eliminated later, in
    order of elimination; `diagonal` (steps, w) and `columns` (steps, w, d): places of the nodes' blocks; `targets`
    (steps, w, d (d + 1) / 2): places of the blocks that a node changes, by pairs of later neighbours, the later first.
    """

    nodes: np.ndarray
    later: np.ndarray
    diagonal: np.ndarray
    columns: np.ndarray
    targets: np.ndarray


@dataclasses.dataclass(frozen=True)
class NodeOrder:
    """An order of elimination of a symmetric matrix of blocks; static, compared by its `key`.

    **Fields:**

    - `nodes`: their number; `size` of their blocks; `levels`: the number of sets of nodes that are eliminated one after
        the other, before the rest.
    - `blocks`: the number of stored blocks, original ones and fill, in the lower triangle with respect to the order;
        the diagonal blocks come first, in the order of the nodes.
    - `row`, `column` (blocks,): the nodes of each stored block; the row is the later of the two.
    - `stages`: the steps.
    - `rest`: the nodes that are eliminated last, as one dense matrix; `rest_blocks` (rest, rest): places of its blocks;
        a block above the diagonal has the place of the transposed block.
    """

    key: Any
    nodes: int = dataclasses.field(compare=False)
    size: int = dataclasses.field(compare=False)
    blocks: int = dataclasses.field(compare=False)
    row: np.ndarray = dataclasses.field(compare=False)
    column: np.ndarray = dataclasses.field(compare=False)
    stages: tuple[Stage, ...] = dataclasses.field(compare=False)
    rest: np.ndarray = dataclasses.field(compare=False)
    rest_blocks: np.ndarray = dataclasses.field(compare=False)
    levels: int = dataclasses.field(compare=False)
    cost: float = dataclasses.field(compare=False)

    @property
    def factor_flops(self) -> float:
        """Floating point operations of a Cholesky factor."""
        later = np.bincount(self.column[self.row != self.column], minlength=self.nodes)
        return float(np.sum(later**2 + later + 1 / 3)) * self.size**3


def order_nodes(
    neighbours: Sequence[Iterable[int]],
    size: int,
    *,
    after: Sequence[Iterable[int]] | None = None,
    every_bound: bool = False,
) -> NodeOrder:
    """An order of elimination of the nodes of a graph, of the lowest estimated cost.

    **Arguments:** `neighbours` of each node, without itself; `size` of a block; `after`: the nodes that must be
    eliminated before each node; `every_bound`: whether to try orders that eliminate nodes of higher degrees at once
    even if a node of low degree exists. An order by low degrees may follow a chain and take a level for each node.
    """
    tries = []
    for cap in _CAPS:
        tries.append(_eliminate([set(adjacent) for adjacent in neighbours], size, cap, after))
        if cap >= tries[-1][3] and not every_bound:
            break
    if every_bound:
        # On other machines than the one of the estimate, steps that wait for each other may cost more.
        tries = [tried for tried in tries if len(tried[1]) <= _MOST_LEVELS] or tries
    cost, levels, rest, _ = min(tries, key=lambda tried: tried[0])
    return _laid_out(neighbours, levels, rest, size, cost)


def _eliminate(graph: list[set[int]], size: int, cap: int, after: Sequence[Iterable[int]] | None) -> Any:
    """Levels of independent nodes with their later neighbours, the rest, and the estimated cost."""
    n = len(graph)
    waiting = [0] * n
    followers: list[list[int]] = [[] for _ in range(n)]
    for node, firsts in enumerate(after or ()):
        for first in firsts:
            waiting[node] += 1
            followers[first].append(node)
    left = set(range(n))
    ready = [k for k in range(n) if not waiting[k]]
    levels, highest = [], 0
    dense = _dense_costs(n, size)
    # The cost of the levels so far, and the least total with the remaining nodes as one dense matrix.
    spent, best = 0.0, (dense[n], 0)
    while left:
        candidates = sorted((len(graph[k]), k) for k in ready)
        lowest = candidates[0][0]
        bound = max(cap, lowest)
        blocked: set[int] = set()
        level = []
        for degree, node in candidates:
            if degree > bound:
                break
            if node not in blocked:
                level.append(node)
                blocked |= graph[node]
        chosen = set(level)
        left -= chosen
        entries = []
        for node in level:
            adjacent = graph[node]
            highest = max(highest, len(adjacent))
            entries.append((node, tuple(adjacent)))
            for k in adjacent:
                other = graph[k]
                other.discard(node)
                other |= adjacent
                other.discard(k)
            for k in followers[node]:
                waiting[k] -= 1
        ready = [k for k in left if not waiting[k]]
        levels.append(entries)
        spent += _level_cost(entries, size)
        total = spent + dense[len(left)]
        if total < best[0]:
            best = total, len(levels)
    cost, count = best
    return cost, levels[:count], [node for level in levels[count:] for node, _ in level], highest


def _dense_costs(n, size):
    rows = np.arange(n + 1) * size
    costs = rows * _DENSE_STEP + rows**3 * _DENSE_FLOP
    costs[_LARGEST_REST + 1 :] = np.inf
    return costs


def _step_flops(d, size):
    return size**3 * (1 + d + d * (d + 1) / 2)


def _level_cost(entries, size):
    d = max(len(adjacent) for _, adjacent in entries)
    return min(-(-len(entries) // w) * (_STEP + w * _FLOP * _step_flops(d, size)) for w in _LANES)


def _laid_out(neighbours, levels, rest, size, cost):
    n = len(neighbours)
    rank = np.full(n, 0)
    for k, node in enumerate([node for level in levels for node, _ in level] + list(rest)):
        rank[node] = k
    pairs: dict[tuple[int, int], int] = {}

    def place(i, j):
        # The later node is the row.
        pair = (i, j) if rank[i] > rank[j] else (j, i)
        return pairs.setdefault(pair, len(pairs))

    diagonal = [pairs.setdefault((k, k), len(pairs)) for k in range(n)]
    sorted_levels = []
    for level in levels:
        entries = []
        for node, adjacent in level:
            later = sorted(adjacent, key=rank.__getitem__)
            columns = [place(k, node) for k in later]
            targets = [place(a, b) if a != b else diagonal[a] for i, a in enumerate(later) for b in later[: i + 1]]
            entries.append((node, later, columns, targets))
        sorted_levels.append(entries)
    rest_blocks = [[diagonal[i] if i == j else place(i, j) for j in rest] for i in rest]
    blocks = len(pairs)
    stages = tuple(_stage(part, diagonal, n, blocks) for part in _cut(sorted_levels, size))
    row, column = np.array(list(pairs), np.int32).reshape(-1, 2).T
    arrays = [row, column, np.array(rest, np.int32), np.array(rest_blocks, np.int32).reshape(len(rest), len(rest))]
    key = digest([*arrays, *(array for stage in stages for array in dataclasses.astuple(stage))])
    return NodeOrder(key, n, size, blocks, row, column, stages, arrays[2], arrays[3], len(levels), cost)


def _cut(levels, size, most=2):
    """Levels grouped in at most `most` stages, each with one number of lanes and one number of later neighbours.

    (A third stage saves no time in chains, trees and nets of up to 10 000 bodies, and compiles 10 to 25 % longer.)
    """
    count = len(levels)
    if not count:
        return []
    widths = [len(level) for level in levels]
    degrees = [max(len(entry[1]) for entry in level) for level in levels]

    def cost(a, b):
        d = max(degrees[a:b])
        return min(
            (sum(-(-n // w) for n in widths[a:b]) * (_STEP + w * _FLOP * _step_flops(d, size)), w) for w in _LANES
        )

    if count > _MOST_LEVELS:
        most = 1
        starts = [count]
    else:
        starts = range(1, count + 1)
    best = {(0, 0): (0.0, [])}
    for stages in range(1, most + 1):
        for b in starts:
            options = []
            for a in range(b):
                before = best.get((stages - 1, a))
                if before is not None:
                    stage_cost, w = cost(a, b)
                    options.append((before[0] + stage_cost + 5.0, [*before[1], (a, b, w)]))
            if options:
                best[stages, b] = min(options, key=lambda o: o[0])
    chosen = min((best[stages, count] for stages in range(1, most + 1) if (stages, count) in best), key=lambda o: o[0])
    out = []
    for a, b, w in chosen[1]:
        steps = [level[k : k + w] for level in levels[a:b] for k in range(0, len(level), w)]
        out.append((steps, w, max(degrees[a:b])))
    return out


def _stage(part, diagonal_of, n, blocks):
    steps, w, d = part
    nodes = np.full((len(steps), w), n, np.int32)
    later = np.full((len(steps), w, d), n, np.int32)
    diagonal = np.full((len(steps), w), blocks + 1, np.int32)
    columns = np.full((len(steps), w, d), blocks, np.int32)
    targets = np.full((len(steps), w, d * (d + 1) // 2), blocks, np.int32)
    for s, step in enumerate(steps):
        for lane, (node, neighbours, blocks_of, changed) in enumerate(step):
            nodes[s, lane] = node
            diagonal[s, lane] = diagonal_of[node]
            later[s, lane, : len(neighbours)] = neighbours
            columns[s, lane, : len(neighbours)] = blocks_of
            targets[s, lane, : len(changed)] = changed
    return Stage(nodes, later, diagonal, columns, targets)
