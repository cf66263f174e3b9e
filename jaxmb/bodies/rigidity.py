"""Checks that bodies without freedom would have none either if dimensions differed a little.

Three parallel rockers move, and one of their rows is implied. With one pin slightly out of place they assemble, if at
all, at a pose where they lock. A truss is rigid at all dimensions near its own, but the longer it is, the less its bars
stretch as it bends: the smallest singular value of its constraints does not tell it from the rockers. So motions are
measured by deformation: for each body, the motion of the body and its neighbours less their best common rigid motion.
A body's part in it counts by how far its own joints would open. The least opening of all joints, as a share of the
deformation, depends neither on the number of bodies nor on units. Inverse iteration finds it.
"""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..system.description import shorten
from .independence import JointBlocks, Subset

# A smaller share of openings in a deformation is a small disagreement of joints. (Three rockers of 1 m with a pin 1 mm
# out of place: 1.3e-4; a truss of bays about as high as wide, of any length: 0.07.)
_LOCKED = 5e-3
_ITERATIONS = 6
# The smallest share of a joint that counts in a message, relative to the largest share.
_SHARE = 0.05
# Relative sizes of eigenvalues that count as zero, and of the shift in the augmented matrix of least squares.
_ZERO, _SHIFT = 1e-10, 1e-6


class _Parts(NamedTuple):
    """Joints that leave their bodies no freedom, with free bodies numbered from 0 and the fixed bodies as the last.

    **Fields:** indices of the parts, `numbers`; the `free` bodies by their indices; the `bodies` of each part; `owner`:
    the part of each row; the `rows` of unit norm, sparse; `columns` of each body (bodies + 1, v), and their number
    `size` for absent columns; `stiffness` of all joints of each body against its velocities; `rigid`: velocities of the
    bodies in rigid motions.
    """

    numbers: tuple[int, ...]
    free: frozenset[int]
    bodies: list[list[int]]
    owner: Int[np.ndarray, "m"]
    rows: Any
    columns: Int[np.ndarray, "b v"]
    size: int
    stiffness: Float[np.ndarray, "b v v"]
    rigid: Float[np.ndarray, "b v d"]


def check_rigid(
    system: Any,
    joints: JointBlocks,
    subsets: Sequence[Subset],
    motions: Float[np.ndarray, "d b v"],
    absolute: Collection[int],
) -> None:
    """Refuse bodies that only a small disagreement of joints holds in place.

    **Arguments:** `subsets` of rows that depend only on each other; `motions`: velocities of all bodies as one;
    `absolute`: indices of parts that bind bodies to the world.
    """
    drivers = np.repeat(
        [g.rheonomic for g in system.constraints.position], [g.row_count for g in system.constraints.position]
    )
    for subset in subsets:
        kept = subset.kept[subset.kept < system.position_rows]
        numbers = tuple(p for p in subset.parts if joints.parts[p].first < system.position_rows)
        # A joint alone holds its bodies at all dimensions; with fewer independent rows than columns the bodies move.
        if len(numbers) < 2 or not 0 < subset.columns.size <= kept.size:
            continue
        if any(drivers[joints.parts[p].first] for p in numbers):
            continue
        parts = _parts(joints, numbers, subset.columns, motions, absolute)
        share, opening = _softest(parts)
        if share < _LOCKED:
            raise ValueError(_disagreement(system, joints, parts, share, opening))


def _parts(joints, numbers, columns, motions, absolute):
    of_system = np.append(joints.scale, 0.0)
    place = np.full(of_system.size, columns.size)
    place[columns] = np.arange(columns.size)
    columns_of = place[joints.layout.velocity_index]
    free = np.flatnonzero(np.any(columns_of < columns.size, axis=1))
    rank = np.full(len(columns_of), free.size)
    rank[free] = np.arange(free.size)
    is_free = columns_of < columns.size
    scales = np.where(is_free, of_system[joints.layout.velocity_index], 0.0)
    v = columns_of.shape[1]
    stiffness = np.zeros((free.size + 1, v, v))
    entries, bodies, owner = [], [], []
    for n, p in enumerate(numbers):
        part = joints.parts[p]
        of_bodies = list(part.bodies)
        block = joints.blocks[p] * scales[of_bodies]
        block = block / np.maximum(np.linalg.norm(block, axis=(1, 2), keepdims=True), np.finfo(block.dtype).tiny)
        np.add.at(stiffness, rank[of_bodies], np.einsum("rkv,rkw->kvw", block, block))
        row = len(owner) + np.arange(part.rows)
        entries.append((block, *np.broadcast_arrays(row[:, None, None], columns_of[of_bodies][None])))
        bodies.append([*rank[of_bodies].tolist(), *([free.size] if p in absolute else ())])
        owner += [n] * part.rows
    rigid = np.where(scales > 0, motions / np.where(scales > 0, scales, 1.0), 0.0)[:, [*free, -1]]
    kept = [*free.tolist(), joints.layout.ground]
    return _Parts(
        numbers,
        frozenset(free.tolist()),
        bodies,
        np.array(owner),
        _sparse(entries, len(owner), columns.size),
        columns_of[kept],
        columns.size,
        _in_all_directions(stiffness, joints.layout.space.dimension),
        np.moveaxis(rigid, 0, 2),
    )


def _in_all_directions(stiffness, d):
    """The same stiffness, on average over the directions, about the centre of the joints' forces.

    A body that joints hold in few directions, or nearly so, is not less deformed as it moves across them.
    """
    along, across = stiffness[:, :d, :d], stiffness[:, :d, d:]
    # The velocity of the centre is that of the body plus `arm` times the angular velocity.
    arm = np.linalg.pinv(along, rcond=_ZERO, hermitian=True) @ across
    of_turns = stiffness[:, d:, d:] - arm.swapaxes(1, 2) @ across
    total, of_turns = (np.einsum("bii->b", x)[:, None, None] for x in (along, of_turns))
    unit, turn = np.eye(d), np.eye(across.shape[2])
    centre = np.concatenate([np.broadcast_to(unit, along.shape), arm], axis=2)
    out = total * centre.swapaxes(1, 2) @ centre
    out[:, d:, d:] += np.maximum(of_turns, 0.0) * turn
    return out


def _sparse(entries, rows, columns):
    from scipy.sparse import csc_array

    values, row, column = (np.concatenate([x.ravel() for x in pieces]) for pieces in zip(*entries, strict=True))
    return csc_array((values, (row, column)), shape=(rows, columns + 1))[:, :columns]


class _Deformation:
    """The deformation of a motion as a quadratic form: for each free body, the body and its neighbours.

    **Fields:** pairs of a `star`, a body with its neighbours, and a `body` in it; `rigid`: the velocities of the bodies
    of pairs, as all move as one about the star's first body; `inverse`: of the form of these motions of each star, zero
    if a body of the star is fixed.
    """

    def __init__(self, parts: _Parts):
        fixed = len(parts.columns) - 1
        near: list[set[int]] = [set() for _ in range(fixed + 1)]
        for bodies in parts.bodies:
            for body in bodies:
                near[body].update(bodies)
        pairs = [(k, body) for k in range(fixed) for body in sorted(near[k] - {fixed})]
        self.parts = parts
        self.star, self.body = np.array(pairs).T
        self.rigid = self._about_first(parts.rigid)
        common = self._of_stars(np.einsum("pvd,pvw,pwe->pde", self.rigid, parts.stiffness[self.body], self.rigid))
        size = np.sqrt(np.einsum("sdd->sd", common))
        size = np.where(size > 0, size, 1.0)
        inverse = np.linalg.pinv(common / (size[:, :, None] * size[:, None, :]), rcond=_ZERO, hermitian=True)
        rigidly = np.array([fixed not in near[k] for k in range(fixed)])
        self.inverse = np.where(rigidly[:, None, None], inverse / (size[:, :, None] * size[:, None, :]), 0.0)

    def _about_first(self, rigid):
        """Translations first; then rotations that leave the first body of the pair's star in place."""
        d = {3: 2, 6: 3}[rigid.shape[2]]
        first, of_bodies = rigid[self.star], rigid[self.body]
        back = np.linalg.pinv(first[:, :d, :d]) @ first[:, :d, d:]
        return np.concatenate([of_bodies[:, :, :d], of_bodies[:, :, d:] - of_bodies[:, :, :d] @ back], axis=2)

    def _of_stars(self, values):
        out = np.zeros((len(self.parts.columns) - 1, *values.shape[1:]))
        np.add.at(out, self.star, values)
        return out

    def product(self, w: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """The form's matrix times a motion."""
        parts = self.parts
        of_bodies = np.append(w, 0.0)[parts.columns]
        forces = np.einsum("bvw,bw->bv", parts.stiffness, of_bodies)
        along = self._of_stars(np.einsum("pvd,pv->pd", self.rigid, forces[self.body]))
        common = np.einsum("sde,se->sd", self.inverse, along)
        left = of_bodies[self.body] - np.einsum("pvd,pd->pv", self.rigid, common[self.star])
        out = np.zeros(parts.size + 1)
        np.add.at(out, parts.columns[self.body], np.einsum("pvw,pw->pv", parts.stiffness[self.body], left))
        return out[:-1]


def _softest(parts) -> tuple[float, Float[np.ndarray, "m"]]:
    """The least norm of the joints' openings as a share of the deformation, and the openings."""
    from scipy.sparse import block_array, eye_array
    from scipy.sparse.linalg import splu

    rows, deformation = parts.rows, _Deformation(parts)
    count = rows.shape[0]
    # Least squares by the augmented matrix: the rows' Gram matrix would square their condition.
    factor = splu(block_array([[_SHIFT * eye_array(count), rows], [rows.T, None]], format="csc"))
    motion = np.random.default_rng(0).standard_normal(parts.size)
    share, opening = np.inf, np.zeros(count)
    for _ in range(_ITERATIONS):
        load = np.concatenate([np.zeros(count), -deformation.product(motion)])
        motion = factor.solve(load)[count:]
        motion = motion / np.linalg.norm(motion)
        opening = rows @ motion
        share = np.linalg.norm(opening) / np.sqrt(max(motion @ deformation.product(motion), np.finfo(float).tiny))
    return float(share), opening


def _disagreement(system, joints, parts, share, opening):
    size = np.zeros(len(parts.numbers))
    np.maximum.at(size, parts.owner, np.abs(opening))
    largest = [parts.numbers[n] for n in np.argsort(-size, kind="stable") if size[n] > _SHARE * size.max()]
    names = shorten(dict.fromkeys(system.rows[joints.parts[p].first][0] for p in sorted(largest)))
    bodies = {k for p in largest for k in joints.parts[p].bodies if k < system.layout.bodies}
    moving = shorten(system.body_names[k] for k in sorted(bodies & parts.free))
    return (
        f"{moving} cannot move: {names} leave no degree of freedom, but with "
        f"dimensions that differ only slightly from these they would (these joints open by {share:.1e} of a "
        "deformation). If the bodies shall move, make points and lengths of the joints agree, or remove one; if not, "
        "give dimensions that lock them more firmly."
    )
