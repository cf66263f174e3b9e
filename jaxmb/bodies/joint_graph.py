"""The joint graph of a scene, and the order of elimination of its joints.

Bodies and the ground are the vertices of the graph, joints its edges. The Gram matrix `A M⁻¹ Aᵀ` couples joints that
share a body, not joints that share the ground only. So joints are the nodes of its elimination. Joints between the same
bodies are one node if their rows fit in.

A body with many joints, a hub, is a node too, since it would couple all its joints. Joints that hang on the hub are
eliminated first, while the hub is held; then the hub; then its remaining joints. Every pivot is regular: independent
rows of a biconnected component stay independent while one of its bodies is held.
"""

import dataclasses
import functools
import itertools
from typing import Any

import numpy as np

from ..linalg.block_jacobian import JointOrder
from ..linalg.digest import digest_of_fields
from ..linalg.elimination_order import order_nodes
from ..linalg.graphs import components
from ..linalg.sums import placed_sums
from .layout import Layout

# A body with this many hanging joints is a hub. (A step of two coupled carriers with five arms each: 49 µs, and 57 µs
# with the front carrier as the only hub.)
_HUB = 5
# From this number of rows on, block elimination is faster; see jaxmb.linalg for the measurement.
_LEAST_ROWS = 30
# The same number for systems with implied rows: a chart may change the rows that it leaves out, elimination may not.
_LEAST_ROWS_WITH_IMPLIED = 150
# The largest share of rows whose reactions friction depends on: these rows are solved for as one full matrix. (An
# evaluation of a chain of 50 pins, in blocks and by dense matrices: 61 and 3800 µs if two pins rub, 36000 and 28000 µs
# if all do.)
_MOST_FRICTION = 0.5


def elimination_order(system: Any, left_out: tuple[int, ...], absolute: frozenset[int]) -> JointOrder | None:
    """The order of elimination of a scene's joints, as `joint_order`; None if a dense matrix is faster."""
    least = _LEAST_ROWS_WITH_IMPLIED if left_out else _LEAST_ROWS
    if not system.linear or system.velocity_rows < least:
        return None
    if system.friction_rows.size > _MOST_FRICTION * system.velocity_rows:
        return None
    return joint_order(system, left_out, absolute)


def joint_order(system: Any, left_out: tuple[int, ...] = (), absolute: frozenset[int] = frozenset()) -> JointOrder:
    """The order of elimination of a scene's joints.

    **Arguments:** `left_out`: rows of A that are not eliminated, such as implied rows; `absolute`: indices of parts
    that bind bodies to the world, not only to each other.
    """
    parts = tuple((g.group.bodies, g.rows) for g in system.constraints.groups)
    return _joint_order(system.layout, parts, left_out, absolute)


def extended_joint_order(system: Any, before: Any, order: JointOrder) -> JointOrder:
    """The order of elimination of a `system` that extends the system `before`, whose `order` is given.

    The additional position constraints follow the position constraints of `before`.
    """
    count = lambda scene: sum(len(g.group.names) for g in scene.constraints.position)
    new_parts, new_rows = count(system) - count(before), system.position_rows - before.position_rows
    left_out = tuple(row if row < before.position_rows else row + new_rows for row in order.left_out)
    absolute = frozenset(part if part < count(before) else part + new_parts for part in order.absolute)
    return joint_order(system, left_out, absolute)


@functools.lru_cache(maxsize=64)
def _joint_order(
    layout: Layout, groups: tuple[Any, ...], left_out: tuple[int, ...], absolute: frozenset[int]
) -> JointOrder:
    ground, size = layout.ground, layout.mass_index.shape[1]
    parts = [(part_bodies, rows) for bodies, rows in groups for part_bodies in bodies]
    # A flexible body is one vertex of the graph, with its modal coordinates.
    on_vertices = [(tuple(layout.mass_place(body)[0] for body in bodies), rows) for bodies, rows in parts]
    joints = _merged(on_vertices, ground)
    rows, bodies_of, blocks = _indices(parts, joints, layout)
    total = sum(rows for _, rows in parts)
    filled = rows < total
    place = np.empty(total, np.int32)
    place[rows[filled]] = np.flatnonzero(filled.ravel())
    kept = filled & ~np.isin(rows, np.array(left_out, int))

    below = _hubs(joints, on_vertices, absolute, ground)
    hubs = {hub: len(joints) + k for k, hub in enumerate(sorted(below))}
    of_body: dict[int, list[int]] = {}
    for joint, (bodies, _) in enumerate(joints):
        for body in bodies:
            of_body.setdefault(body, []).append(joint)
    widest = rows.shape[1]
    nodes = _nodes(joints, of_body, hubs, below, max(widest, size) if hubs else widest)
    first, second, products, on_hubs, hub_places = _gram(joints, of_body, hubs, nodes, bodies_of.shape[1])
    order = JointOrder(
        key=None,
        rows=rows,
        kept=kept,
        place=place,
        bodies=bodies_of,
        blocks=blocks,
        on_bodies=placed_sums(bodies_of.reshape(-1), ground),
        velocity_index=layout.mass_index,
        velocity_place=_places(layout.mass_index, layout.nu),
        first=first,
        second=second,
        products=placed_sums(products, nodes.blocks),
        hubs=np.array(list(hubs), np.int32),
        on_hubs=on_hubs,
        hub_places=hub_places,
        nodes=nodes,
        left_out=left_out,
        absolute=absolute,
    )
    return dataclasses.replace(order, key=digest_of_fields(order))


def _places(index, count):
    """The index of each of `count` velocities among the raveled entries of `index`."""
    places = np.zeros(count + 1, np.int32)
    places[index[:-1].ravel()] = np.arange(index[:-1].size)
    return places[:-1]


def _indices(parts, joints, layout):
    """Rows, bodies and entries of the blocks of each joint, padded to the largest joint."""
    ground, size = layout.ground, layout.space.velocity_size
    first_row = [0, *itertools.accumulate(rows for _, rows in parts)]
    first_entry = [0, *itertools.accumulate(rows * len(bodies) * size for bodies, rows in parts)]
    widest = max(sum(parts[p][1] for p in numbers) for _, numbers in joints)
    most = max(len(bodies) for bodies, _ in joints)
    rows = np.full((len(joints), widest), first_row[-1], np.int32)
    bodies_of = np.full((len(joints), most), ground, np.int32)
    blocks = np.full((len(joints), most, widest, layout.mass_index.shape[1]), first_entry[-1], np.int32)
    for joint, (bodies, numbers) in enumerate(joints):
        bodies_of[joint, : len(bodies)] = bodies
        start = 0
        for p in numbers:
            part_bodies, n = parts[p]
            rows[joint, start : start + n] = np.arange(first_row[p], first_row[p + 1])
            entries = np.arange(first_entry[p], first_entry[p + 1]).reshape(n, len(part_bodies), size)
            for k, body in enumerate(part_bodies):
                vertex, column = layout.mass_place(body)
                if vertex != ground:
                    columns = slice(0, size) if vertex == body else slice(column, column + 1)
                    of_vertex = blocks[joint, bodies.index(vertex), start : start + n]
                    of_vertex[:, columns] = entries[:, k, : columns.stop - columns.start]
            start += n
    return rows, bodies_of, blocks


def _nodes(joints, of_body, hubs, below, size):
    """The order of elimination of joints and hubs."""
    neighbours: list[set[int]] = [set() for _ in range(len(joints) + len(hubs))]
    for body, incident in of_body.items():
        if body in hubs:
            neighbours[hubs[body]].update(incident)
            for joint in incident:
                neighbours[joint].add(hubs[body])
        else:
            for joint in incident:
                neighbours[joint].update(other for other in incident if other != joint)
    above = lambda joint, bodies: [hubs[body] for body in bodies if body in hubs and joint not in below[body]]
    after = [above(joint, bodies) for joint, (bodies, _) in enumerate(joints)]
    return order_nodes(neighbours, size, after=[*after, *(below[hub] for hub in hubs)])


def _gram(joints, of_body, hubs, nodes, most):
    """Pairs of blocks whose products make up the Gram matrix, and the places of the products in it.

    Also the blocks of joints on hubs, and their places. Indices of blocks are by joint and body, raveled; places are
    indices of stored blocks.
    """
    stored = {pair: k for k, pair in enumerate(zip(nodes.row.tolist(), nodes.column.tolist(), strict=True))}
    block = lambda joint, body: joint * most + joints[joint][0].index(body)
    first, second, products, on_hubs, hub_places = [], [], [], [], []
    for body, incident in of_body.items():
        if body in hubs:
            hub = hubs[body]
            on_hubs += [block(joint, body) for joint in incident]
            hub_places += [stored[hub, j] if (hub, j) in stored else stored[j, hub] for j in incident]
            continue
        for i, a in enumerate(incident):
            for b in incident[: i + 1]:
                # The later of the two nodes is the row.
                row, column = (a, b) if (a, b) in stored else (b, a)
                first.append(block(row, body))
                second.append(block(column, body))
                products.append(stored[row, column])
    return [np.array(values, np.int32) for values in (first, second, products, on_hubs, hub_places)]


def _merged(parts, ground):
    """Joints as moving bodies and indices of parts; a joint takes parts of the same bodies while their rows fit in."""
    widest = max(rows for _, rows in parts)
    joints: list[tuple[tuple[int, ...], list[int]]] = []
    open_joints: dict[frozenset[int], int] = {}
    filled: list[int] = []
    for p, (bodies, rows) in enumerate(parts):
        moving = tuple(dict.fromkeys(body for body in bodies if body != ground))
        key = frozenset(moving)
        joint = open_joints.get(key)
        if joint is not None and filled[joint] + rows <= widest:
            joints[joint][1].append(p)
            filled[joint] += rows
        else:
            open_joints[key] = len(joints)
            joints.append((moving, [p]))
            filled.append(rows)
    return joints


def _hubs(joints, parts, absolute, ground):
    """Hubs, each with its hanging joints, which are eliminated before it."""
    if max(np.bincount([body for bodies, _ in joints for body in bodies], minlength=1)) < _HUB:
        return {}
    # The ground is a vertex too.
    bound = lambda p: {*parts[p][0], *([ground] if p in absolute else ())}
    vertices = [set().union(*map(bound, numbers)) for _, numbers in joints]
    below: dict[int, set[int]] = {}
    for component in components(vertices, ground):
        hanging = {joint for joint in component.joints if component.top in vertices[joint]}
        below.setdefault(component.top, set()).update(hanging)
    return {body: hanging for body, hanging in below.items() if body != ground and len(hanging) >= _HUB}
