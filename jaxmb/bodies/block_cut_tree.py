"""The biconnected components of a graph of bodies and joints, and the bodies and ground where they meet.

Source: J. Hopcroft and R. Tarjan, "Efficient algorithms for graph manipulation", Comm. ACM 16(6), 1973.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple


class Component(NamedTuple):
    """Joints that are on loops together, or a single one: a tree of components, of which each is below one vertex.

    **Fields:** the numbers of its `joints`; `top`: the vertex that it shares with components above it, or the root.
    """

    joints: tuple[int, ...]
    top: int


def components(joints: Sequence[Collection[int]], ground: int) -> list[Component]:
    """The biconnected components, each below its top.

    **Arguments:** `joints`: the bodies of each, the ground among them; `ground`: its number, one more than those of the
    bodies. The root of a tree is the ground where it is connected to it, else the body of most joints.
    """
    # Edges (vertex, other, joint); a joint of three bodies is a triangle of edges.
    adjacent: list[list[tuple[int, int]]] = [[] for _ in range(ground + 1)]
    edges: list[tuple[int, int, int]] = []
    alone: list[tuple[int, int]] = []
    for joint, own in enumerate(joints):
        vertices = sorted(set(own))
        if len(vertices) == 1:
            alone.append((joint, vertices[0]))
        for i, a in enumerate(vertices):
            for b in vertices[i + 1 :]:
                adjacent[a].append((b, len(edges)))
                adjacent[b].append((a, len(edges)))
                edges.append((a, b, joint))
    out: list[Component] = []
    depth = [-1] * (ground + 1)
    for root in [ground, *sorted(range(ground), key=lambda k: -len(adjacent[k]))]:
        if depth[root] < 0 and adjacent[root]:
            _search(root, adjacent, edges, depth, out)
    return [*out, *(Component((joint,), vertex) for joint, vertex in alone)]


def _search(root, adjacent, edges, depth, out):
    """Depth-first search without recursion; appends the components of one connected part."""
    depth[root] = 0
    low = {root: 0}
    open_edges: list[int] = []
    stack = [(root, -1, iter(adjacent[root]))]
    used: set[int] = set()
    while stack:
        vertex, above, ahead = stack[-1]
        for other, edge in ahead:
            if edge in used:
                continue
            used.add(edge)
            open_edges.append(edge)
            if depth[other] < 0:
                depth[other] = depth[vertex] + 1
                low[other] = depth[other]
                stack.append((other, edge, iter(adjacent[other])))
                break
            low[vertex] = min(low[vertex], depth[other])
        else:
            stack.pop()
            if not stack:
                continue
            parent = stack[-1][0]
            low[parent] = min(low[parent], low[vertex])
            if low[vertex] >= depth[parent]:
                own: dict[int, None] = {}
                while True:
                    edge = open_edges.pop()
                    own[edges[edge][2]] = None
                    if edge == above:
                        break
                out.append(Component(tuple(sorted(own)), parent))
