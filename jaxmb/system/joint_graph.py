"""The joint graph of a scene, and the order in which its joints are eliminated.

Bodies are the nodes of the graph and joints its edges; the ground is not a node, since joints that share only the
ground do not interact. In a chain every body has at most two joints, and joint i of the elimination shares bodies with
joints i − 1 and i + 1 only. Chains are the only graphs that have an order so far; others are eliminated as one dense
matrix.
"""

import functools
import hashlib
import itertools
from typing import Any

import numpy as np

from ..linalg.jacobian import EliminationOrder
from .layout import Layout
from .rigid_bodies import RigidBodySystem

# From this number of rows on block elimination is faster; see jaxmb.linalg for the measurement.
_LEAST_ROWS = 30


def elimination_order(system: RigidBodySystem) -> EliminationOrder | None:
    """The order of block elimination of a scene's joints; None where a dense matrix is faster, or where the graph has
    no order.

    Block elimination is faster for many ideal holonomic rows in the plane, if all of them are independent, which the
    caller must check.
    """
    rows = system.velocity_rows
    if (
        system.spatial
        or not system.ideal_on_velocities
        or not _LEAST_ROWS <= rows < system.nu
        or rows > system.position_rows
    ):
        return None
    return chain_order(system)


def chain_order(system: RigidBodySystem) -> EliminationOrder | None:
    """The order along the chain of a scene's joints, or along several chains; None where joints branch or close
    loops.
    """
    joints = tuple((g.group.bodies, g.rows) for g in system.joints)
    return _chain_order(system.layout, joints) if joints else None


@functools.lru_cache(maxsize=64)
def _chain_order(layout: Layout, groups: tuple[Any, ...]) -> EliminationOrder | None:
    bodies, rows = [], []
    for own_bodies, own_rows in groups:
        bodies += own_bodies
        rows += [own_rows] * len(own_bodies)
    none, size = layout.bodies, layout.space.velocity_size
    walk = _walk(none, bodies)
    if walk is None:
        return None

    first = [0, *itertools.accumulate(rows)]
    start = [0, *itertools.accumulate(n * len(own) * size for n, own in zip(rows, bodies, strict=True))]
    count, widest = len(bodies), max(rows)
    rows_of, sides = np.full((count, widest), first[-1]), np.full((2, count, widest, size), start[-1])
    shared, joints_of = np.full((2, count), none), np.full((2, none), count)
    for place, (joint, ends) in enumerate(walk):
        n, k = rows[joint], len(bodies[joint])
        rows_of[place, :n] = np.arange(first[joint], first[joint + 1])
        block = np.arange(start[joint], start[joint + 1]).reshape(n, k, size)
        for side, body in enumerate(ends):
            if body is not None:
                shared[side, place] = body
                joints_of[side, body] = place
                sides[side, place, :n] = block[:, bodies[joint].index(body)]
    place = np.empty(first[-1], int)
    filled = rows_of < first[-1]
    place[rows_of[filled]] = np.flatnonzero(filled.ravel())
    arrays = rows_of, place, *shared, *joints_of, *sides, layout.velocity_index, layout.velocity_place
    key = hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).digest()
    return EliminationOrder(key, *arrays)


def _walk(none, bodies):
    """Joints in order along the chains, each with the bodies before and after it; None where they are no chains."""
    moving = [[body for body in own if body != none] for own in bodies]
    of_body: dict[int, list[int]] = {}
    for joint, own in enumerate(moving):
        for body in own:
            of_body.setdefault(body, []).append(joint)
    if any(len(own) > 2 for own in (*moving, *of_body.values())):
        return None
    walk, seen = [], set()
    for joint, own in enumerate(moving):
        ends = [body for body in own if len(of_body[body]) == 1]
        if joint in seen or not (len(own) == 1 or ends):
            continue
        before = ends[0] if len(own) == 2 else None
        follow = joint
        while follow is not None:
            seen.add(follow)
            others = [body for body in moving[follow] if body != before]
            after = others[0] if others else None
            walk.append((follow, (before, after)))
            before = after
            further = [] if after is None else [k for k in of_body[after] if k not in seen]
            follow = further[0] if further else None
    # Joints that no walk from an end reaches close a loop.
    return walk if len(walk) == len(bodies) else None
