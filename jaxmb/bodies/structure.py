"""The structure of a compiled scene: ranks of the constraint rows, implied rows, and the joints' order of elimination.

All steps follow the joint graph: sparse elimination meets the constraints, and independent rows are found component by
component. So the time is proportional to the number of bodies if loops are local.
"""

import dataclasses
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..linalg.inertia import DiagonalInertia
from ..linalg.jitted import on_host
from ..linalg.rotations import unrotate
from ..states.closest import largest_residual, meet_in_blocks, tolerance
from ..states.headings import check_headings
from ..states.redundancy import (
    ZERO,
    DependentRows,
    Nearby,
    Remains,
    check_gradients,
    check_implied,
    dense_remains,
    smallest_step,
)
from ..states.refusals import violated_joints, without_a_joint
from ..system.equation import Ranks
from ..system.instant import Instant
from .independence import JointBlocks, JointRows
from .joint_graph import elimination_order, joint_order
from .rigid_bodies import Implied, RigidBodySystem
from .rigidity import check_rigid
from .shared_contacts import imply_each_other


def with_structure(system: RigidBodySystem) -> RigidBodySystem:
    """The system with its ranks, implied rows and order of elimination.

    They are found once: the scene is assembled from the given poses, and its Jacobian is eliminated in concrete
    numbers. Then they are static.

    **Raises:** `ValueError` if the constraints cannot be satisfied, or contradict each other in velocities or
    accelerations, or if the given pose is singular.
    """
    invariants = system.coordinate_rows - system.position_rows
    check_headings(system, 0.0, system.guess.q, "the given pose")
    if not system.acceleration_rows:
        return dataclasses.replace(system, ranks=Ranks(0, invariants, 0, 0))
    other_rows = tuple(range(system.position_rows, system.acceleration_rows))
    of_positions = dataclasses.replace(system, elimination=joint_order(system, other_rows))
    q, residual, at = _analysed(of_positions)
    if not float(residual) <= tolerance(q.dtype):
        listed = violated_joints(system, 0.0, q, least=0.0)
        turn = "angle" if system.layout.space.dimension == 2 else "orientation"
        raise ValueError(
            "The scene cannot be compiled: the mechanism cannot be assembled from the given poses, residuals [m, rad] "
            f"remain in {listed}. The assembly starts at the position and the {turn} of each body: give poses that are "
            "nearer to an assembled mechanism. Else check lengths, points and axes: joints may contradict each other. "
            "jaxmb.viz.plot_scene(scene) draws the gaps."
            f"{without_a_joint(system, np.zeros((), q.dtype), system.guess.q)}"
        )
    joints = JointBlocks(_parts(system), _of_parts(at.blocks), system.layout, system.known_scales()[1])
    check_gradients(system, _row_norms(system, at.blocks))
    row = np.arange(system.acceleration_rows)
    level = (row >= system.position_rows).astype(int) + (row >= system.velocity_rows)
    motions = _motions_as_one(system.layout, np.asarray(q))
    absolute = joints.absolute_parts(motions)
    subsets = joints.subsets(level, absolute)
    dropped = tuple(sorted(r for subset in subsets for r in subset.dropped.tolist()))
    shares = [share for subset in subsets for share in subset.shares]

    order = joint_order(system, dropped, absolute)
    _check_contradictions(dataclasses.replace(system, elimination=order), q, shares)
    check_rigid(system, joints, subsets, motions, absolute)
    implied = _implied(system, shares)
    _check_determined(system, implied)
    _check_nearby(dataclasses.replace(of_positions, elimination=order), q, joints, subsets)
    position, velocity, acceleration = (
        sum(int(np.sum(level[subset.kept] <= k)) for subset in subsets) for k in range(3)
    )
    return dataclasses.replace(
        system,
        ranks=Ranks(position, position + invariants, velocity, acceleration),
        shares=system.contacts.may_share and imply_each_other(system, q),
        implied=implied,
        elimination=elimination_order(system, dropped, absolute),
    )


def _parts(system):
    """The rows of every part."""
    groups = [(g.group.bodies, g.rows) for g in system.constraints.groups]
    sizes = [(part_bodies, rows) for bodies, rows in groups for part_bodies in bodies]
    starts = itertools.accumulate((rows for _, rows in sizes), initial=0)
    return [JointRows(part_bodies, first, rows) for (part_bodies, rows), first in zip(sizes, starts, strict=False)]


def _of_parts(groups):
    return [block for group in groups for block in np.asarray(group)]


class _Evaluation(NamedTuple):
    """Φ, `unmet`, and the blocks of A group by group."""

    unmet: Array
    blocks: Any


def _analysed(system):
    """The assembled configuration, the size of its remaining residuals, and the evaluation there."""
    on_host, guess = system.on_host(0.0), np.asarray(system.guess.q)
    met = None if on_host is None else on_host.met(on_host.normalize(guess))
    if on_host is not None and on_host.holds(met):
        q, at = met, _of_host(on_host, met)
    else:
        q, *at = _met(system)
        at = _Evaluation(*at)
    norms: Any = _row_norms(system, at.blocks)
    residual = largest_residual(at.unmet, norms[: system.position_rows])
    return jax.device_put(q), residual, at


@on_host
def _met(system):
    q, t = system.guess.q, jnp.zeros((), system.guess.q.dtype)
    at, fixed = _at_rest(system, t, q), np.zeros(system.nu, bool)
    q = meet_in_blocks(at, fixed) if system.position_rows else at.normalized().q
    return q, *_evaluated(system, t, q)


def _evaluated(system, t, q):
    """The evaluation at coordinates near the constraints, with the guess's velocities."""
    u = system.guess.u
    now = system.kinematics(t, q, u)
    return _Evaluation(system.position_residual(t, q), [g.jacobian(now) for g in system.constraints.groups])


def _of_host(on_host, q):
    return _Evaluation(on_host.residual(q), on_host.blocks(q))


def _row_norms(system, blocks):
    """The norm of each row of A, with columns multiplied by the scales of velocities."""
    of_bodies = np.append(system.known_scales()[1], 0.0)[system.layout.velocity_index]
    scales = [of_bodies[np.array(g.group.bodies)][:, None] for g in system.constraints.groups]
    sizes = [np.sqrt(np.sum((b * s) ** 2, axis=(2, 3))) for b, s in zip(blocks, scales, strict=True)]
    return np.concatenate([size.reshape(-1) for size in sizes])


def _displaced(system, t, q, moved):
    """The evaluation after displacements along velocities, in multiples of their scales."""
    on_host = system.on_host(t)
    if on_host is None:
        return _displaced_by_jax(system, t, q, moved)
    return _of_host(on_host, on_host.displaced(np.asarray(q), on_host.velocity_scale * moved))


def _at_rest(system, t, q):
    return Instant(system, t, q, jnp.zeros(system.nu, q.dtype))


@on_host
def _displaced_by_jax(system, t, q, moved):
    return _evaluated(system, t, _at_rest(system, t, q).moved(system.velocity_scale() * moved).q)


@on_host
def _asked(system, q):
    """Residuals of the guess's velocities, and of zero accelerations after the velocities are corrected."""
    t, u = jnp.zeros((), q.dtype), system.guess.u
    asked = system.velocity_residual(t, q, u)
    metric = DiagonalInertia(1 / system.velocity_scale() ** 2)
    zeros = jnp.zeros(system.acceleration_rows - system.velocity_rows, q.dtype)
    u = u + system.structured_jacobian(t, q, u).projector(metric).cancel(jnp.concatenate([asked, zeros]))
    return asked, system.acceleration_residual(t, q, u, jnp.zeros_like(u))


def _motions_as_one(layout, q):
    """Velocities as all bodies translate or rotate as one rigid body; zeros for scalar coordinates and ground."""
    poses: Any = np.append(q, layout.space.ground)[layout.pose_index[: layout.bodies]]
    d = layout.space.dimension
    moved = np.tile(np.eye(d, layout.space.velocity_size)[:, None], (1, len(poses), 1))
    if d == 2:
        turned = np.stack([-poses[:, 1], poses[:, 0], np.ones(len(poses))], axis=1)[None]
    else:
        axes: Any = np.eye(3)
        turned = np.array([[[*np.cross(axis, x[:3]), *unrotate(x[3:], axis)] for x in poses] for axis in axes])
    resting = layout.ground + 1 - layout.bodies
    return np.pad(np.concatenate([moved, turned]), ((0, 0), (0, resting), (0, 0)))


@on_host
def _way_back(system, t, q, moved):
    """The smallest displacement from the displaced configuration to the constraints, in multiples of scales."""
    scale = system.velocity_scale()
    at = _at_rest(system, t, q).moved(scale * moved)
    return at.binding_velocities.projector(DiagonalInertia(1 / scale**2)).cancel(at.position_rows) / scale


def _check_contradictions(system, q, shares):
    """Refuse dropped rows that contradict the rows that imply them, in velocities or accelerations.

    **Arguments:** `shares` of kept rows in dropped rows.
    """
    if not shares or not system.linear or (system.drift_free and not system.constraints.servos):
        return
    for what, asked in zip(("velocities", "accelerations"), _asked(system, q), strict=True):
        least = 1e-6 * max(np.max(np.abs(asked), initial=0.0), 1e-6)
        names, largest = set(), 0.0
        for row, by, multiples in shares:
            if row >= asked.size or np.any(by >= asked.size):
                continue
            left = abs(asked[row] - multiples @ asked[by])
            if left > least:
                names |= {system.rows[k][0] for k in (row, *by)}
                largest = max(largest, float(left))
        if names:
            raise ValueError(
                f"The {what} prescribed by {', '.join(sorted(names))} contradict each other (largest residual "
                f"{largest:.3g}). Remove one of them, or make their motions agree."
            )


def _bodies_of_joints(system):
    """Names of each joint's bodies, without the ground."""
    names = system.body_names
    bodies = lambda numbers: tuple(names[k] for k in numbers if k < len(names))
    groups = [g.group for g in system.constraints.groups]
    return {name: bodies(numbers) for g in groups for name, numbers in zip(g.names, g.bodies, strict=True)}


def _check_determined(system, implied):
    """Refuse friction laws of joints with an indeterminate reaction."""
    for g in system.constraints.laws:
        for name, joint in zip(g.group.names, g.joints, strict=True) if g.needs != "nothing" else ():
            involved = {other for item in implied for other in (item.name, *item.by) if joint in (item.name, *item.by)}
            if involved:
                raise ValueError(
                    f"{g.group.part.kind} {name!r} needs the force of {joint!r}, which is not determined: "
                    f"rows of {', '.join(sorted(involved))} imply one another. Remove redundant joints."
                )


def _implied(system, shares):
    """Names of the dropped rows, and of the joints that imply them."""
    out, rows = [], system.rows
    for row, by, _ in shares:
        if row < system.velocity_rows:
            name, k = rows[row]
            names = {rows[r][0] for r in by}
            out.append(Implied(name, k, tuple(sorted(names - {name})) or (name,)))
    return tuple(sorted(out, key=lambda item: (item.name, item.row)))


def _check_nearby(system, q, joints, subsets):
    """Refuse rows that are implied at the configuration but not near it."""
    groups = [subset for subset in subsets if subset.dropped.size]
    is_sparse = any(subset.is_sparse for subset in groups)

    def evaluate(t, moved):
        t = np.asarray(t, q.dtype)
        at = _displaced(system, t, q, moved)
        displaced, unmet = joints._replace(blocks=_of_parts(at.blocks)), np.asarray(at.unmet)
        back: Any = _way_back(system, t, q, moved) if is_sparse else None

        def dense(subset):
            return displaced.dense(subset.parts, subset.columns) * joints.scale[subset.columns]

        def step(k, rows):
            subset = groups[k]
            if subset.is_sparse:
                return back[subset.columns]
            return smallest_step(dense(subset)[np.searchsorted(subset.rows, rows)], unmet[rows])

        def remains(k, kept, dropped):
            subset = groups[k]
            if not subset.is_sparse:
                off, sizes, by = dense_remains(
                    dense(subset), *(np.searchsorted(subset.rows, x) for x in (kept, dropped))
                )
                return Remains(off, sizes, lambda bad: subset.rows[by(bad)])
            place, later = np.searchsorted(subset.rows, dropped), np.isin(subset.rows, dropped)
            pivots, sizes = displaced.eliminate(subset.parts, subset.columns, later.astype(int), ZERO)
            # A row that became a pivot is not implied.
            off = np.isin(place, pivots.order[: pivots.rank]).astype(q.dtype)
            implied_by = {share.row: share.by for share in subset.shares}
            by = lambda bad: np.unique(np.concatenate([implied_by[row] for row in dropped[bad].tolist()]))
            return Remains(off, sizes[place], by)

        return Nearby(unmet, step, remains)

    holonomic = lambda subset: subset.kept[subset.kept < system.position_rows]
    check_implied(
        system,
        [DependentRows(subset.rows, subset.kept, holonomic(subset)) for subset in groups],
        [subset.columns for subset in groups],
        evaluate,
        system.nu,
        q.dtype,
        _bodies_of_joints(system),
    )
