"""Chains of joints: an order of elimination from the joint graph, and Jacobians in the blocks of the joints.

Bodies are the nodes of the graph and joints its edges; the ground is none, since what is joined to it alone does not
feel each other. In a chain every body has at most two joints, and joint i of the elimination shares bodies with joints
i − 1 and i + 1 only: `A M⁻¹ Aᵀ` is block-tridiagonal.
"""

import dataclasses
import functools
import itertools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.block_tridiagonal import BlockTridiagonal
from .equation import AbstractSystem
from .inertia import AbstractInertia
from .layout import Layout, pick

# From this number of rows on, motions of chains are eliminated block by block. A step of `Adams` on a chain of 5, 10,
# 20, 35 rods takes 28, 46, 23, 33 µs that way and 39, 32, 111, 1076 µs by partitioning.
LONG = 30
# From this number on their assembly as well, which asks for a better guess than dense matrices do.
VERY_LONG = 300


@dataclasses.dataclass(frozen=True, eq=False)
class Chain:
    """Joints in their order of elimination; static index arithmetic.

    **Fields:**

    - `rows` (joints, r): where the rows of each joint stand among all, those that pad it out after the last.
    - `place` (all rows,): where each row stands among those of the joints in order, raveled.
    - `before`, `after` (joints,): the body shared with the joint before and after; the number of bodies for none.
    - `blocks_before`, `blocks_after` (joints, r, v): where their blocks stand among those of all groups, raveled one
        after the other and followed by a zero.
    - `joint_before`, `joint_after` (bodies,): the joint that comes after the body, and before it; the number of joints
        for none.
    """

    layout: Layout
    rows: np.ndarray
    place: np.ndarray
    before: np.ndarray
    after: np.ndarray
    blocks_before: np.ndarray
    blocks_after: np.ndarray
    joint_before: np.ndarray
    joint_after: np.ndarray


class BlockJacobian(eqx.Module):
    """A, as the blocks of joints in a chain. `before`, `after`: shape (joints, r, v), of the bodies to either side."""

    before: Float[Array, "k r v"]
    after: Float[Array, "k r v"]
    chain: Chain = eqx.field(static=True)

    def product(self, v: Float[Array, "nu"]) -> Float[Array, "m"]:
        """`A v`."""
        of_bodies = self._of_bodies(v[:, None])[:, :, 0]
        along = jnp.sum(self.before * of_bodies[self.chain.before][:, None], axis=2)
        along = along + jnp.sum(self.after * of_bodies[self.chain.after][:, None], axis=2)
        return self.ravel(along)

    def transpose_product(self, multipliers: Float[Array, "m"]) -> Float[Array, "nu"]:
        """`Aᵀ λ`."""
        own = self.blocks(multipliers)[:, :, None]
        chain = self.chain
        forces = [
            jnp.pad(jnp.sum(side * own, axis=1), ((0, 1), (0, 0)))[joint]
            for side, joint in ((self.before, chain.joint_before), (self.after, chain.joint_after))
        ]
        return self._of_velocities((forces[0] + forces[1])[:, :, None])[:, 0]

    def gram(self, inertia: AbstractInertia) -> BlockTridiagonal:
        """`A M⁻¹ Aᵀ`, for an M that couples no bodies; rows that pad joints out have a one on the diagonal."""
        chain = self.chain
        r = self.before.shape[1]
        padded = [jnp.pad(side, ((0, 1), (0, 0), (0, 0))) for side in (self.before, self.after)]
        columns = [padded[0][chain.joint_before], padded[1][chain.joint_after]]
        columns = jnp.concatenate(columns, axis=1).swapaxes(1, 2)
        moved = self._of_bodies(inertia.solve(self._of_velocities(columns)))
        of_before, of_after = moved[:, :, :r], moved[:, :, r:]
        padding = np.eye(r) * (chain.rows == chain.place.size)[:, :, None]
        diagonal = _products(self.before, of_before[chain.before]) + _products(self.after, of_after[chain.after])
        coupling = _products(self.after, of_before[chain.after])
        return BlockTridiagonal(diagonal + jnp.asarray(padding, diagonal.dtype), coupling)

    def blocks(self, of_rows: Float[Array, "m"]) -> Float[Array, "k r"]:
        """Values of rows, joint by joint."""
        return pick(jnp.append(of_rows, jnp.zeros((), of_rows.dtype)), self.chain.rows)

    def ravel(self, blocks: Float[Array, "k r"]) -> Float[Array, "m"]:
        """The inverse of `blocks`."""
        return pick(blocks.reshape(-1), self.chain.place)

    def _of_bodies(self, columns):
        """Columns (nu, c) body by body and zeros for none, (bodies + 1, v, c)."""
        return pick(jnp.pad(columns, ((0, 1), (0, 0))), self.chain.layout.velocity_index)

    def _of_velocities(self, of_bodies):
        """Columns (nu, c) from those of bodies (bodies, v, c)."""
        return pick(of_bodies.reshape(-1, of_bodies.shape[2]), self.chain.layout.velocity_place)


def block_jacobian(system: Any, t: Scalar, q: Float[Array, "nq"], u: Float[Array, "nu"]) -> BlockJacobian:
    """A of a system whose joints form a chain.

    **Raises:** `ValueError` for other systems; the message names a joint that closes a loop or a body where the chain
    branches.
    """
    chain = chain_of(system)
    poses, velocities = system.prepared_poses(q), system.all_velocities(u)
    groups = (*system.constraints, *system.velocity_constraints)
    flat = [g.jacobian(t, poses, velocities).reshape(-1) for g in groups]
    flat = jnp.concatenate([*flat, jnp.zeros(1, q.dtype)])
    return BlockJacobian(pick(flat, chain.blocks_before), pick(flat, chain.blocks_after), chain)


def is_long(system: AbstractSystem, rows: int = LONG) -> bool:
    """Whether it pays to eliminate block by block: many rows in the plane, all independent, of joints in a chain."""
    return may_be_long(system, rows) and system.velocity_rank == system.velocity_rows


def may_be_long(system: Any, rows: int = LONG) -> bool:
    """The same before ranks are known."""
    if not system.has_bodies or system.spatial or not rows <= system.velocity_rows < system.nu:
        return False
    if system.velocity_rows > system.position_rows or not system.ideal_on_velocities:
        return False
    try:
        chain_of(system)
    except ValueError:
        return False
    return True


def chain_of(system: Any) -> Chain:
    """The chain of a system's joints.

    **Raises:** `ValueError` as `block_jacobian`.
    """
    if not system.has_bodies:
        raise ValueError("Only scenes have a joint graph; use Multipliers() and Partition() or Projection().")
    if not system.ideal_on_velocities:
        names = [name for g in (*system.servos, *system.nonideal) for name in g.group.names]
        raise ValueError(
            f"Chains are of ideal joints and without programs, and there is {', '.join(names)}; use Partition() or "
            "Projection()."
        )
    groups = (*system.constraints, *system.velocity_constraints)
    if not groups:
        raise ValueError("There are no joints, and nothing to eliminate; use Multipliers().")
    joints = tuple((g.group.names, g.group.bodies, g.rows) for g in groups)
    return _find(system.layout, system.body_names, joints)


@functools.lru_cache(maxsize=64)
def _find(layout: Layout, body_names: tuple[str, ...], groups: tuple[Any, ...]) -> Chain:
    names, bodies, rows = [], [], []
    for own_names, own_bodies, own_rows in groups:
        names += own_names
        bodies += own_bodies
        rows += [own_rows] * len(own_names)
    none, size = layout.bodies, layout.space.velocity_size
    ways = _walk(none, body_names, names, bodies)

    first = [0, *itertools.accumulate(rows)]
    start = [0, *itertools.accumulate(n * len(own) * size for n, own in zip(rows, bodies, strict=True))]
    count, widest = len(names), max(rows)
    rows_of, sides = np.full((count, widest), first[-1]), np.full((2, count, widest, size), start[-1])
    shared, joints_of = np.full((2, count), none), np.full((2, none), count)
    for place, (joint, ends) in enumerate(ways):
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
    return Chain(layout, rows_of, place, *shared, *sides, *joints_of)


def _walk(none, body_names, names, bodies):
    """Joints in order, each with the bodies before and after it."""
    moving = [[body for body in own if body != none] for own in bodies]
    of_body: dict[int, list[int]] = {}
    for joint, own in enumerate(moving):
        if len(own) > 2:
            raise ValueError(f"{names[joint]} joins more than two bodies; its scene is no chain of joints.")
        for body in own:
            of_body.setdefault(body, []).append(joint)
    for body, own in of_body.items():
        if len(own) > 2:
            raise ValueError(
                f"The joints branch at {body_names[body]}, where {', '.join(names[k] for k in own)} meet: they are no "
                "chain. Use Partition() or Projection(), which take any joints."
            )
    ways, seen = [], set()
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
            ways.append((follow, (before, after)))
            before = after
            further = [] if after is None else [k for k in of_body[after] if k not in seen]
            follow = further[0] if further else None
    if len(ways) < len(names):
        closing = max(set(range(len(names))) - seen)
        raise ValueError(
            f"{names[closing]} closes a loop: the joints are no chain. Use Partition() or Projection(), which take any "
            "joints."
        )
    return ways


def _products(a, b):
    # Written out: a batched dot of small blocks costs a library call, a sum of products fuses.
    return jnp.sum(a[:, :, :, None] * b[:, None, :, :], axis=2)
