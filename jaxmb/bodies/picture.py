"""The picture of a motion: poses of the bodies, and shapes and points of the parts."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import State
from ..parts.base import GROUND
from ..system.picture import Anchors, Line, Picture
from .groups import Group


def picture(system: Any, groups: Sequence[Group], ts: Float[Array, "times"], ys: State) -> Picture:
    """The picture of a system of bodies and of stacked parts."""
    layout, names = system.layout, (*system.body_names, GROUND)
    space, groups = layout.space, [_pictured(group) for group in groups]
    # Scalar coordinates have no place in the picture.
    body_names = dict(zip((*range(layout.bodies), layout.ground), names, strict=True))
    position, orientation = (np.asarray(values)[list(body_names)] for values in _placements(system, ys))
    single = [
        (name, tuple(body_names[body] for body in bodies if body in body_names), part)
        for group in groups
        for name, bodies, part in zip(group.names, group.bodies, _unstacked(group), strict=True)
    ]
    parts: dict[str, Anchors] = {}
    for name, bodies, part in single:
        points = [part.anchor(space, k) for k in range(len(bodies))]
        parts.setdefault(
            name, Anchors(bodies, tuple(None if p is None else np.asarray(space.in_space(p)) for p in points))
        )
    width = _width(float(system.length), parts, dict(zip(names, position[:, 0], strict=True)))
    shapes = [
        (GROUND if k is None else bodies[k], shape)
        for _, bodies, part in single
        for k, shape in _shapes(part, space, width)
    ]
    # The friction of a joint acts where the joint does.
    of_laws = {law: joint for g in system.constraints.laws for law, joint in zip(g.group.names, g.joints, strict=True)}
    mass, moments = np.asarray(system.mass), np.asarray(system.moments_of_inertia)
    if not system.spatial:
        moments = moments[:, None, None] * np.diag([0.5, 0.5, 1.0])
    return Picture(
        planar=not system.spatial,
        up=_up(space, None if system.forces.gravity is None else np.asarray(system.forces.gravity)),
        width=width,
        positions=dict(zip(names, position, strict=True)),
        orientations=dict(zip(names, orientation, strict=True)),
        parts=parts | {law: parts[joint] for law, joint in of_laws.items()},
        shapes=shapes,
        paths={name: path for group in groups for name, path in _paths(system, group, ts, ys).items()},
        centres={
            name: np.asarray(space.in_space(centre)) for g in system.bodies.groups for name, centre in _centres(g.group)
        },
        inertias={name: (float(m), J) for name, m, J in zip(names, mass, moments, strict=False)},
    )


def _pictured(group):
    """The parts as a picture shows them; parts on the ground keep their given places."""
    moved = jax.vmap(lambda part: part.pictured(group.layout.space))(group.part)
    last = np.flatnonzero(group.layout.is_place(group.bodies[0]))[-1]
    on_ground = group.body_index[:, last] == group.layout.ground
    kept = lambda old, new: jnp.where(on_ground.reshape(-1, *[1] * (new.ndim - 1)), old, new)
    return eqx.tree_at(lambda stacked: stacked.part, group, jax.tree.map(kept, group.part, moved))


def _shapes(part, space, width):
    """The shapes of a part in the frames of their bodies, each with the index of its body within the part."""
    for k, shape in part.shapes(space, width):
        frame = part.body_frames.get(str(k))
        yield k, shape if frame is None else shape.moved(*space.placement(frame.pose_in_body(space)))


def _centres(group):
    """Names and mass centres of bodies whose origin is elsewhere."""
    given = group.part.mass_centre
    return () if given is None else zip(group.names, np.asarray(given), strict=True)


def _unstacked(group):
    """The parts of a group, with numbers in NumPy."""
    stacked = jax.tree.map(np.asarray, group.part)
    return [jax.tree.map(lambda leaf, k=k: leaf[k], stacked) for k in range(len(group.names))]


def _width(length, parts, places):
    """The radius of a bar, from the sizes of the system and of a typical body; of points, from their distances."""
    reach: dict[str, float] = {}
    for part in parts.values():
        for body, point in zip(part.bodies, part.points, strict=True):
            if point is not None and body != GROUND:
                reach[body] = max(reach.get(body, 0.0), float(np.linalg.norm(point)))
    joined = [part.bodies for part in parts.values() if len(part.bodies) == 2 and GROUND not in part.bodies]
    halves = [0.5 * float(np.linalg.norm(places[a] - places[b])) for a, b in joined]
    sizes = [distance for distance in reach.values() if distance > 0] or [half for half in halves if half > 0]
    typical = float(np.median(sizes or [length]))
    return min(0.024 * length, 0.08 * typical)


def _paths(system, group, ts, ys) -> dict[str, Line]:
    lines = _world_paths(system, group, ts, ys)
    if lines is None:
        return {}
    lines = np.asarray(lines)
    lines = np.concatenate([lines, np.zeros((*lines.shape[:-1], 3 - lines.shape[-1]))], axis=-1)
    return {name: Line(group.part.path_kind or "rod", lines[:, k]) for k, name in enumerate(group.names)}


@eqx.filter_jit
def _placements(system, ys):
    poses = jax.vmap(system.bodies.prepared_poses)(ys.q)
    position, orientation = jax.vmap(jax.vmap(system.layout.space.placement))(poses)
    return jnp.swapaxes(position, 0, 1), jnp.swapaxes(orientation, 0, 1)


@eqx.filter_jit
def _world_paths(system, group, ts, ys):
    """World points of the parts' lines, shape (times, parts, points, d); None without lines."""

    def at_time(t, y):
        poses = group.gather(system.bodies.prepared_poses(y.q))
        space = system.layout.space
        return group.map(lambda at, x: at(t).path(space, at(t).seen_poses(space, x)), poses)

    return jax.vmap(at_time)(ts, ys)


def _up(space, gravity):
    """The world axis against gravity."""
    vertical = np.zeros(3)
    if space.dimension == 2 or gravity is None or not np.any(gravity):
        vertical[space.dimension - 1] = 1.0
    else:
        k = np.argmax(np.abs(gravity))
        vertical[k] = -np.sign(gravity[k])
    return vertical
