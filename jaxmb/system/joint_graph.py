"""The joint graph of a scene, and the order in which its joints are eliminated.

Bodies and the ground are the vertices of the graph and joints its edges. The Gram matrix `A M⁻¹ Aᵀ` couples the joints
that share a body, but not those that share the ground only, so joints are the nodes of its elimination. Joints between
the same bodies are one node where their rows fit in. A body of many joints is a node too, so that it does not couple
all of these with each other: the joints that hang on it are eliminated while it is held, then the body, then the others
at it. The rows of joints are independent with one body of a biconnected component held if they are at all, so every
pivot is regular.
"""

import functools
import hashlib
import itertools
from typing import Any

import numpy as np

from ..linalg.block_jacobian import JointOrder
from ..linalg.elimination_order import order_nodes
from ..linalg.sums import placed_sums
from .block_cut_tree import components
from .layout import Layout
from .rigid_bodies import RigidBodySystem

# A body on which this many joints hang is a node of the elimination.
_HUB = 6


# From this number of rows on block elimination is faster; see jaxmb.linalg for the measurement.
_LEAST_ROWS = 30
# The same where rows are implied by others: a chart finds others to leave out on the way, block elimination does not.
_LEAST_ROWS_WITH_IMPLIED = 150


def elimination_order(
    system: RigidBodySystem, left_out: tuple[int, ...], absolute: frozenset[int]
) -> JointOrder | None:
    """The order of elimination of a scene's joints; None where a dense matrix is faster.

    **Arguments:** as in `joint_order`.
    """
    least = _LEAST_ROWS_WITH_IMPLIED if left_out else _LEAST_ROWS
    if not (system.ideal_on_velocities and system.linear) or system.velocity_rows < least:
        return None
    return joint_order(system, left_out, absolute)


def joint_order(
    system: RigidBodySystem, left_out: tuple[int, ...] = (), absolute: frozenset[int] = frozenset()
) -> JointOrder:
    """The order of elimination of a scene's joints.

    **Arguments:** `left_out`: rows of A that are not eliminated, such as those that others imply; `absolute`: numbers
    of parts that bind bodies to the world, not only to each other.
    """
    parts = tuple((g.group.bodies, g.rows) for g in system.joints)
    return _joint_order(system.layout, parts, left_out, absolute)


@functools.lru_cache(maxsize=64)
def _joint_order(
    layout: Layout, groups: tuple[Any, ...], left_out: tuple[int, ...], absolute: frozenset[int]
) -> JointOrder:
    ground, size = layout.bodies, layout.space.velocity_size
    parts = [(own, rows) for bodies, rows in groups for own in bodies]
    first_row = [0, *itertools.accumulate(rows for _, rows in parts)]
    first_entry = [0, *itertools.accumulate(rows * len(own) * size for own, rows in parts)]
    joints = _merged(parts, ground)
    count = len(joints)
    widest = max(sum(parts[p][1] for p in own) for _, own in joints)
    most = max(len(bodies) for bodies, _ in joints)

    rows = np.full((count, widest), first_row[-1], np.int32)
    bodies_of = np.full((count, most), ground, np.int32)
    blocks = np.full((count, most, widest, size), first_entry[-1], np.int32)
    for joint, (bodies, own) in enumerate(joints):
        bodies_of[joint, : len(bodies)] = bodies
        start = 0
        for p in own:
            part_bodies, n = parts[p]
            rows[joint, start : start + n] = np.arange(first_row[p], first_row[p + 1])
            entries = np.arange(first_entry[p], first_entry[p + 1]).reshape(n, len(part_bodies), size)
            for k, body in enumerate(part_bodies):
                if body != ground:
                    blocks[joint, bodies.index(body), start : start + n] = entries[:, k]
            start += n
    filled = rows < first_row[-1]
    place = np.empty(first_row[-1], np.int32)
    place[rows[filled]] = np.flatnonzero(filled.ravel())
    kept = filled & ~np.isin(rows, np.array(left_out, int))

    below = _hubs(joints, parts, absolute, ground)
    hubs = sorted(below)
    node_of_hub = {hub: count + k for k, hub in enumerate(hubs)}
    of_body: dict[int, list[tuple[int, int]]] = {}
    for joint, (bodies, _) in enumerate(joints):
        for k, body in enumerate(bodies):
            of_body.setdefault(body, []).append((joint, joint * most + k))
    neighbours: list[set[int]] = [set() for _ in range(count + len(hubs))]
    for body, own in of_body.items():
        if body in node_of_hub:
            hub = node_of_hub[body]
            for joint, _ in own:
                neighbours[hub].add(joint)
                neighbours[joint].add(hub)
        else:
            everyone = {joint for joint, _ in own}
            for joint in everyone:
                neighbours[joint] |= everyone - {joint}
    block_size = max(widest, size) if hubs else widest
    above = [
        {node_of_hub[hub] for hub in own if joint not in below.get(hub, {joint})}
        for joint, (own, _) in enumerate(joints)
    ]
    nodes = order_nodes(neighbours, block_size, after=[*above, *(below[hub] for hub in hubs)])
    stored = {pair: k for k, pair in enumerate(zip(nodes.row.tolist(), nodes.column.tolist(), strict=True))}
    first, second, targets, on_hubs, hub_places = [], [], [], [], []
    for body, own in of_body.items():
        if body in node_of_hub:
            for joint, block in own:
                hub = node_of_hub[body]
                on_hubs.append(block)
                hub_places.append(stored[hub, joint] if (hub, joint) in stored else stored[joint, hub])
            continue
        for i, (a, block_a) in enumerate(own):
            for b, block_b in own[: i + 1]:
                straight = (a, b) in stored
                targets.append(stored[a, b] if straight else stored[b, a])
                first.append(block_a if straight else block_b)
                second.append(block_b if straight else block_a)
    index = lambda values: np.array(values, np.int32)
    arrays = rows, kept, place, bodies_of, blocks
    on_bodies = placed_sums(bodies_of.reshape(-1), ground)
    kinematics = layout.velocity_index, layout.velocity_place
    gram = index(first), index(second), placed_sums(index(targets), nodes.blocks)
    hub_arrays = index(hubs), index(on_hubs), index(hub_places)
    digest = hashlib.sha256(nodes.key + on_bodies.key + gram[2].key)
    for array in (*arrays, *kinematics, *gram[:2], *hub_arrays):
        digest.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return JointOrder(digest.digest(), *arrays, on_bodies, *kinematics, *gram, *hub_arrays, nodes)


def _merged(parts, ground):
    """Joints as their moving bodies and their parts: parts of the same bodies, as many as fit in the rows of one."""
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
    """Bodies that are nodes of the elimination, each with the joints that are eliminated before it."""
    if max(np.bincount([body for own, _ in joints for body in own], minlength=1)) < _HUB:
        return {}
    # The ground counts as well.
    bound = lambda p: {*parts[p][0], *([ground] if p in absolute else ())}
    vertices = [set().union(*map(bound, own)) for _, own in joints]
    below: dict[int, set[int]] = {}
    for component in components(vertices, ground):
        own = {joint for joint in component.joints if component.top in vertices[joint]}
        below.setdefault(component.top, set()).update(own)
    return {body: own for body, own in below.items() if body != ground and len(own) >= _HUB}
