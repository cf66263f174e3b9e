"""Graphs of bodies and joints: connected and biconnected components, the vertices between these, shortest loops.

Source: J. Hopcroft and R. Tarjan, "Efficient algorithms for graph manipulation", Comm. ACM 16(6), 1973.
"""

import collections
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple


def connected(count: int, edges: Iterable[Sequence[int]]) -> list[int]:
    """For each vertex the first vertex connected to it, perhaps itself."""
    # A union-find forest, whose trees have their first vertex as the root.
    parent = list(range(count))

    def root(vertex):
        while parent[vertex] != vertex:
            parent[vertex] = parent[parent[vertex]]
            vertex = parent[vertex]
        return vertex

    for edge in edges:
        first = min(map(root, edge))
        for vertex in edge:
            parent[root(vertex)] = first
    return [root(vertex) for vertex in range(count)]


class Component(NamedTuple):
    """Joints that are on loops together, or a single joint. Components form a tree, each below one vertex.

    **Fields:** the indices of its `joints`; `top`: the vertex that it shares with components above it, or the root.
    """

    joints: tuple[int, ...]
    top: int


def components(joints: Sequence[Collection[int]], ground: int) -> list[Component]:
    """The biconnected components, each below its top.

    **Arguments:** `joints`: the bodies of each joint, the ground among them; `ground`: the ground's index, after the
    last body's. The root of a tree is the ground if it is connected, else the body of most joints.
    """
    # Edges (vertex, other, joint); a joint of three bodies is a triangle of edges.
    adjacent: list[list[tuple[int, int]]] = [[] for _ in range(ground + 1)]
    edges: list[tuple[int, int, int]] = []
    alone: list[tuple[int, int]] = []
    for joint, bodies in enumerate(joints):
        vertices = sorted(set(bodies))
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
                on_component: dict[int, None] = {}
                while True:
                    edge = open_edges.pop()
                    on_component[edges[edge][2]] = None
                    if edge == above:
                        break
                out.append(Component(tuple(sorted(on_component)), parent))


def vertices_before(edges: Sequence[tuple[int, ...]], ground: int) -> list[tuple[int, ...]]:
    """The vertices that each edge waits for in an elimination. An edge of a spanning tree waits for the vertex below
    it, another edge for the vertices of a shortest loop through it.

    **Arguments:** `edges`: the vertices of each, without the ground; `ground`: its index, after the last vertex.
    """
    at: list[list[int]] = [[] for _ in range(ground + 1)]
    vertices = [ends if len(ends) > 1 else (*ends, ground) for ends in edges]
    for edge, ends in enumerate(vertices):
        for vertex in ends:
            at[vertex].append(edge)
    before: list[tuple[int, ...]] = [()] * len(edges)
    reached = [False] * (ground + 1)
    waits = [False] * len(edges)
    for root in [ground, *range(ground)]:
        if reached[root]:
            continue
        reached[root] = True
        queue = collections.deque([root])
        while queue:
            for edge in at[queue.popleft()]:
                below = next((vertex for vertex in vertices[edge] if not reached[vertex]), None)
                if below is not None and not waits[edge]:
                    reached[below] = waits[edge] = True
                    before[edge] = (below,)
                    queue.append(below)
    for edge, ends in enumerate(vertices):
        if not waits[edge]:
            before[edge] = tuple(vertex for vertex in _shortest_loop(edge, ends, at, vertices) if vertex != ground)
    return before


def _shortest_loop(edge, edge_vertices, at, vertices):
    """The vertices of a shortest loop through an edge; of the edge alone if it is on none."""
    start, *ends = edge_vertices
    on_loop = set(edge_vertices)
    for end in ends:
        above = {start: start}
        queue = collections.deque([start])
        while queue and end not in above:
            vertex = queue.popleft()
            for other in at[vertex]:
                if other != edge:
                    for far in vertices[other]:
                        if far not in above:
                            above[far] = vertex
                            queue.append(far)
        while end in above and end != start:
            end = above[end]
            on_loop.add(end)
    return on_loop
