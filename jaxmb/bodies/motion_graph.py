"""The graph of a scene's bodies, forces and joints, and the order in which implicit methods eliminate it.

An implicit step solves

    [ M − r D − r² K   −Aᵀ ] [z]   [b]
    [       A           0  ] [l] = [c]

with the derivatives K and D of the forces by positions and velocities, for a complex number r. Bodies and joints are
the nodes of the elimination. Two bodies are neighbours if a force or a joint acts on both. A body and a joint are
neighbours if the joint acts on the body.

Pivots of bodies are regular. For dissipative forces the values of `xᴴ (M − r D − r² K) x` lie in a sector of the
complex plane with an opening below 180 degrees. The values of every Schur complement lie in it too.

The pivot of a joint is regular if its rows and those of eliminated joints are independent in the columns of the
eliminated bodies. So a joint of a spanning tree waits for the body below it. A joint that closes a loop waits for all
bodies of a shortest loop.

Source: J. Brüdigam and Z. Manchester, "Linear-time variational integrators in maximal coordinates", 2021 (elimination
over the graph of bodies and joints).
"""

import dataclasses
import functools
from typing import Any

import numpy as np

from ..linalg.block_jacobian import JointOrder
from ..linalg.digest import digest_of_fields
from ..linalg.elimination_order import NodeOrder, order_nodes
from ..linalg.graphs import vertices_before
from ..linalg.sums import PlacedSums, placed_sums
from .joint_graph import joint_order
from .layout import Layout


@dataclasses.dataclass(frozen=True)
class MotionOrder:
    """The order of elimination of a scene's bodies and joints; static, compared by its `key`.

    A body has v velocities, a joint r rows, a node b = max(v, r).

    **Fields:**

    - `joints`: the order of the joints alone, with their rows; None for a scene without joints.
    - `row`, `column` (pairs,): bodies that act on each other, first each body with itself; `sums`: sums of the
        contributions of forces and joints for each pair; `by_row` and `by_column`: sums of pairs for each body.
    - `lower`, `upper` (stored blocks,): indices into blocks of pairs, blocks of joints on bodies, their transposes,
        identities of joints, and a zero, one after the other.
    - `nodes`: the order of elimination, bodies first.
    """

    key: Any
    joints: JointOrder | None = dataclasses.field(compare=False)
    row: np.ndarray = dataclasses.field(compare=False)
    column: np.ndarray = dataclasses.field(compare=False)
    sums: PlacedSums = dataclasses.field(compare=False)
    by_row: PlacedSums = dataclasses.field(compare=False)
    by_column: PlacedSums = dataclasses.field(compare=False)
    lower: np.ndarray = dataclasses.field(compare=False)
    upper: np.ndarray = dataclasses.field(compare=False)
    nodes: NodeOrder = dataclasses.field(compare=False)


def motion_order(system: Any) -> MotionOrder:
    """The order of elimination of a scene's bodies and joints."""
    joints = system.elimination
    if joints is None and system.velocity_rows > 0:
        joints = joint_order(system)
    acting = tuple(g.group.bodies for g in (*system.forces.groups, *system.constraints.groups))
    return _motion_order(system.layout, acting, joints)


@functools.lru_cache(maxsize=64)
def _motion_order(
    layout: Layout, acting: tuple[tuple[tuple[int, ...], ...], ...], joints: JointOrder | None
) -> MotionOrder:
    ground, size = layout.ground, layout.space.velocity_size
    # Every pair of bodies of a part, row by row, in the order of `contributions` of `jaxmb.bodies.field_jacobian`.
    rows = [bodies[i] for group in acting for bodies in group for i in range(len(bodies)) for _ in bodies]
    columns = [bodies[j] for group in acting for bodies in group for _ in bodies for j in range(len(bodies))]
    rows, columns = [*rows, *range(ground)], [*columns, *range(ground)]
    places: dict[tuple[int, int], int] = {(body, body): body for body in range(ground)}
    outside = -1
    of_entries = np.array(
        [
            outside if ground in pair else places.setdefault(pair, len(places))
            for pair in zip(rows, columns, strict=True)
        ],
        np.int64,
    )
    row, column = np.array(list(places), np.int32).reshape(-1, 2).T

    of_joints = [] if joints is None else [tuple(int(b) for b in bodies if b != ground) for bodies in joints.bodies]
    neighbours: list[set[int]] = [set() for _ in range(ground + len(of_joints))]
    for a, b in places:
        if a != b:
            neighbours[a].add(b)
            neighbours[b].add(a)
    for joint, bodies in enumerate(of_joints, ground):
        neighbours[joint].update(bodies)
        for body in bodies:
            neighbours[body].add(joint)
    widest = size if joints is None else max(size, joints.rows.shape[1])
    after = [*([()] * ground), *vertices_before(of_joints, ground)]
    nodes = order_nodes(neighbours, widest, after=after, every_bound=True)

    # Blocks of pairs, of joints on bodies, their transposes, identities of joints, and a zero.
    pairs, most = len(places), 0 if joints is None else joints.bodies.shape[1]
    across = len(of_joints) * most
    block = {
        (b, a): pairs + across + k * most + bodies.index(b)
        for k, bodies in enumerate(of_joints)
        for a in [ground + k]
        for b in bodies
    }
    source = dict(places)
    for (body, joint), place in block.items():
        source[joint, body] = place - across
        source[body, joint] = place
    source |= {(ground + k, ground + k): pairs + 2 * across + k for k in range(len(of_joints))}
    zero = pairs + 2 * across + len(of_joints)
    ends = list(zip(nodes.row.tolist(), nodes.column.tolist(), strict=True))
    lower = np.array([source.get((a, b), zero) for a, b in ends], np.int32)
    upper = np.array([source.get((b, a), zero) for a, b in ends], np.int32)
    order = MotionOrder(
        key=None,
        joints=joints,
        row=row,
        column=column,
        sums=placed_sums(of_entries, pairs),
        by_row=placed_sums(row, ground),
        by_column=placed_sums(column, ground),
        lower=lower,
        upper=upper,
        nodes=nodes,
    )
    return dataclasses.replace(order, key=digest_of_fields(order))
