"""The structure of a compiled scene: numbers of independent rows, which rows are implied by which joints, and the order
in which joints are eliminated.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..linalg.elimination import full_pivot
from ..system.bodies import Implied
from ..system.equation import Ranks
from ..system.joint_graph import elimination_order
from ..system.rigid_bodies import RigidBodySystem
from .assembly import violated_joints
from .closest import (
    INDEPENDENT,
    configuration_by_blocks,
    eliminates_by_blocks,
    meet_constraints,
    residual_size,
    tolerance,
)
from .redundancy import check_gradients, check_implied

# Thresholds of the smallest singular value of the equilibrated Jacobian of bodies without freedom: below the first the
# bodies do move, and between the two they would with slightly different dimensions. (Three rockers of 1 m with a pin 1
# mm out of place: 6e-5.)
_MOVES = 1e-8
_LOCKED = 5e-3
# Dense matrices with more rows are too large.
_DENSE = 3000


def with_structure(system: RigidBodySystem) -> RigidBodySystem:
    """The system with its ranks, implied rows and order of elimination. They are found once, by assembling from the
    given poses and eliminating on concrete numbers; afterwards they are static.

    **Raises:** `ValueError` if the constraints cannot be satisfied, or contradict each other in velocities or
    accelerations, or if the given pose is singular.
    """
    order, rows = elimination_order(system), system.velocity_rows
    structured = dataclasses.replace(system, elimination=order)
    if eliminates_by_blocks(structured):
        if bool(_independent_by_blocks(structured)):
            return dataclasses.replace(structured, ranks=Ranks(rows, rows, rows, rows))
        if rows > _DENSE:
            listed = violated_joints(system, 0.0, system.guess.q)
            raise ValueError(
                f"These {rows} constraint rows are too many for dense matrices, and by blocks they cannot be "
                + (
                    f"assembled from the given poses, which violate {listed}. Give poses nearer to the constraints."
                    if listed
                    else "distinguished from redundant rows. Move the points of joints apart."
                )
            )
    found = _analyse(system)
    if system.position_rows and not float(found["residual"]) <= tolerance(system.guess.q.dtype):
        listed = violated_joints(system, 0.0, found["q"], least=0.0)
        raise ValueError(
            f"The mechanism cannot be assembled from the given poses: residuals remain in {listed}. Check lengths, "
            "points and axes for joints that contradict each other, or give better poses."
        )
    for what in ("velocities", "accelerations"):
        _check_left_over(system, what, *map(np.asarray, found[what]))
    jacobian, scale = np.asarray(found["jacobian"]), np.asarray(found["scale"])
    _check_locked(system, jacobian[: system.position_rows] * scale)
    check_gradients(system, np.asarray(found["A"]) * scale)
    position, velocity = int(found["position rank"]), int(found["rank"])
    coordinate = position + system.coordinate_rows - system.position_rows
    implied = _implied(system, jacobian, np.asarray(found["order"]), velocity)
    _check_determined(system, implied)
    acceleration = int(found["acceleration rank"])
    check_implied(
        system,
        found["q"],
        np.asarray(found["position order"])[:position],
        np.asarray(found["acceleration order"])[:acceleration],
        _bodies_of_joints(system),
    )
    ranks = Ranks(position, coordinate, velocity, acceleration)
    # Block elimination drops no rows.
    order = order if velocity == rows else None
    return dataclasses.replace(system, ranks=ranks, implied=implied, elimination=order)


@eqx.filter_jit
def _independent_by_blocks(system):
    """Whether the scene can be assembled by blocks, and none of its rows is nearly redundant."""
    held = np.zeros(system.nq, bool)
    _, ok, pivot = configuration_by_blocks(
        system, jnp.zeros((), system.guess.q.dtype), system.guess.q, held, tolerance(system.guess.q.dtype)
    )
    return ok & (pivot > INDEPENDENT)


@eqx.filter_jit
def _analyse(system):
    """All evaluations of the system, in one compiled function."""
    q, u = system.normalize(system.guess.q), system.guess.u
    t = jnp.zeros((), q.dtype)
    scale = system.velocity_scale()
    residual = jnp.zeros((), q.dtype)
    if system.position_rows:
        q, linearized = meet_constraints(system, t, q, system.coordinate_scale())
        residual = residual_size(system, t, q, linearized)
    jacobian = system.velocity_jacobian(t, q, u)
    level = (jnp.arange(system.velocity_rows) >= system.position_rows).astype(int)
    every = full_pivot(jacobian, scale=scale, level=level)
    holonomic = system.velocity_rows == system.position_rows
    positions = every if holonomic else full_pivot(jacobian[: system.position_rows], scale=scale)
    A = system.jacobian(t, q, u) if system.servos else jacobian
    accelerations = full_pivot(A, scale=scale) if system.servos else every
    out = {
        "q": q,
        "residual": residual,
        "jacobian": jacobian,
        "scale": scale,
        "position rank": positions.rank,
        "rank": every.rank,
        "acceleration rank": accelerations.rank,
        "position order": positions.order.rows,
        "order": every.order.rows,
        "acceleration order": accelerations.order.rows,
        "A": A,
        "velocities": (jnp.zeros(0), jnp.zeros(0)),
        "accelerations": (jnp.zeros(0), jnp.zeros(0)),
    }
    if system.linear and (system.servos or not system.drift_free):
        # Implied rows must be consistent with the rows that imply them: a least-squares residual is a contradiction.
        if system.velocity_rows:
            asked = system.velocity_residual(t, q, u)
            change, left = _least_squares(jacobian, scale, asked)
            out["velocities"] = left, asked
            u = u + change
        asked = system.acceleration_residual(t, q, u, jnp.zeros_like(u))
        out["accelerations"] = _least_squares(system.jacobian(t, q, u), scale, asked)[1], asked
    return out


def _least_squares(jacobian, scale, asked):
    """The smallest least-squares solution x of `jacobian x + asked = 0`, and its residual."""
    x = -scale * (jnp.linalg.pinv(jacobian * scale[None, :], rtol=1e-8) @ asked)
    return x, jacobian @ x + asked


def _check_left_over(system, what, left, asked):
    bad = np.abs(left) > 1e-6 * np.maximum(np.max(np.abs(asked), initial=0.0), 1e-6)
    if np.any(bad):
        names = sorted({name for (name, _), b in zip(system.rows, bad, strict=True) if b})
        raise ValueError(
            f"The {what} prescribed by {', '.join(names)} contradict each other (largest residual "
            f"{np.abs(left).max():.3g}). Remove one of them, or make their motions agree."
        )


def _check_locked(system, jacobian):
    """Refuse bodies that only a small disagreement of redundant joints keeps from moving.

    Three parallel rockers move, and one of their rows is implied; with one pin slightly out of place they assemble,
    if at all, where they lock. No row is implied there, but some nearly are.

    **Arguments:** `jacobian` (position rows × nu), its columns scaled.
    """
    scaled = jacobian / np.maximum(np.linalg.norm(jacobian, axis=1, keepdims=True), np.finfo(jacobian.dtype).tiny)
    for bodies, rows in _connected(system):
        columns = system.layout.velocity_index[bodies].ravel()
        columns = columns[columns < system.nu]
        if len(rows) < len(columns):
            continue
        left, sizes, _ = np.linalg.svd(scaled[np.ix_(rows, columns)])
        if _MOVES < sizes[-1] < _LOCKED:
            share = np.abs(left[:, len(columns) - 1])
            names = dict.fromkeys(system.rows[r][0] for r, x in zip(rows, share, strict=True) if x > 0.05 * share.max())
            raise ValueError(
                f"{', '.join(system.body_names[k] for k in bodies)} cannot move: {', '.join(names)} leave no degree of "
                "freedom, but with dimensions that differ only slightly from these they would (smallest singular value "
                f"{sizes[-1]:.1e}). Make the points and lengths of redundant joints agree, or remove one of them."
            )


def _connected(system):
    """Sets of bodies that joints connect without the ground, with their rows, except sets with a driver."""
    ground, row = system.layout.bodies, 0
    # A union-find forest: the root of a tree represents all bodies connected to it.
    parent = list(range(ground))

    def root(body):
        while parent[body] != body:
            parent[body] = parent[parent[body]]
            body = parent[body]
        return body

    parts = []
    for g in system.constraints:
        for own in g.group.bodies:
            moving = [k for k in own if k != ground]
            for k in moving[1:]:
                parent[root(k)] = root(moving[0])
            parts.append((moving, range(row, row + g.rows), g.rheonomic))
            row += g.rows
    bodies, rows, driven = ([[] for _ in parent] for _ in range(3))
    for k in range(ground):
        bodies[root(k)].append(k)
    for moving, own, rheonomic in parts:
        if moving:
            rows[root(moving[0])] += own
            driven[root(moving[0])].append(rheonomic)
    return [(b, r) for b, r, d in zip(bodies, rows, driven, strict=True) if d and not any(d)]


def _bodies_of_joints(system):
    """Names of the bodies of each joint, without the ground."""
    bodies = lambda own: tuple(system.body_names[k] for k in own if k < system.layout.bodies)
    groups = [g.group for g in system.joints]
    return {name: bodies(own) for g in groups for name, own in zip(g.names, g.bodies, strict=True)}


def _check_determined(system, implied):
    """Refuse friction laws of joints whose reaction is indeterminate."""
    for g in system.nonideal:
        for name, joint in zip(g.group.names, g.joints, strict=True):
            others = {other for item in implied for other in (item.name, *item.by) if joint in (item.name, *item.by)}
            if others:
                raise ValueError(
                    f"{g.group.part.kind} {name!r} needs the force of {joint!r}, which is not determined: "
                    f"rows of {', '.join(sorted(others))} imply one another. Remove the redundant ones."
                )


def _implied(system, jacobian, order, rank):
    """Express each dropped row by the kept ones; the joints that contribute imply it."""
    kept, dropped = order[:rank], order[rank:]
    out = []
    for row in dropped:
        share, *_ = np.linalg.lstsq(jacobian[kept].T, jacobian[row], rcond=None)
        weight = np.abs(share) * np.linalg.norm(jacobian[kept], axis=1)
        name, k = system.rows[row]
        by = {system.rows[r][0] for r, w in zip(kept, weight, strict=True) if w > 1e-6 * np.linalg.norm(jacobian[row])}
        out.append(Implied(name, k, tuple(sorted(by - {name})) or (name,)))
    return tuple(sorted(out, key=lambda item: (item.name, item.row)))
