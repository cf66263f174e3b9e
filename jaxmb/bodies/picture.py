"""The picture of a motion: poses of the bodies, and shapes and points of the parts."""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import State
from ..linalg.rotations import rotation_matrix
from ..parts.base import GROUND, AbstractLink
from ..parts.shapes import ring, support, wheel
from ..system.picture import Anchors, Line, Picture, in_space
from .groups import FrameGroup, Group


def picture(
    system: Any, groups: Sequence[Group], ts: Float[Array, "times"], ys: State, deformation: float = 1.0
) -> Picture:
    """The picture of a system of bodies and of stacked parts, with magnified deformations of flexible bodies."""
    layout, moving = system.layout, tuple(system.body_names)
    space, groups = layout.space, [_pictured(group) for group in groups]
    # Scalar coordinates have no place in the picture.
    body_names = dict(zip((*range(layout.bodies), layout.ground), (*moving, GROUND), strict=True))
    single = [one for group in groups for one in _parts(group, body_names)]
    owners = {name: moving[of[0]] for g in _flexible_frames(system) for name, of in zip(g.names, g.bodies, strict=True)}
    joints = {name for g in system.constraints.groups for name in g.group.names}
    held = {owners[frame] for name, of, _ in single if name in joints for frame in of if frame in owners}
    positions, orientations, lines = _places(system, ts, ys, owners, held, deformation)
    parts: dict[str, Anchors] = {}
    for name, bodies, part in single:
        points = [part.anchor(space, k) for k in range(len(bodies))]
        parts.setdefault(
            name, Anchors(bodies, tuple(None if p is None else np.asarray(space.in_space(p)) for p in points))
        )
    for name, body, place in _frames_on(system, body_names):
        parts.setdefault(name, Anchors((body,), (place,)))
    width = _width(float(system.length), parts, {name: at[0] for name, at in positions.items()}, owners)
    followed = [of_part for group in groups for of_part in _followed(system, group, ts, ys)]
    shapes = [
        (GROUND if k is None else bodies[k], shape)
        for (_, bodies, part), along in zip(single, followed, strict=True)
        for k, shape in _shapes(part, space, width, along)
    ]
    shapes += [
        gear for _, bodies, part in single for gear in _gears(part, bodies, parts, positions, orientations, width)
    ]
    up = _up(space, None if system.forces.gravity is None else np.asarray(system.forces.gravity))
    held = (point for _, bodies, part in single for point in _held(part, bodies, space))
    shapes += [(GROUND, support(point, -up, width)) for point in held]
    # The friction of a joint acts where the joint does.
    of_laws = {law: joint for g in system.constraints.laws for law, joint in zip(g.group.names, g.joints, strict=True)}
    mass, moments = np.asarray(system.mass), np.asarray(system.moments_of_inertia)
    if not system.spatial:
        moments = moments[:, None, None] * np.diag([0.5, 0.5, 1.0])
    return Picture(
        planar=not system.spatial,
        up=up,
        width=width,
        positions=positions,
        orientations=orientations,
        bodies=moving,
        owners=owners,
        parts=parts | {law: parts[joint] for law, joint in of_laws.items()},
        shapes=shapes,
        paths={name: path for group in groups for name, path in _paths(system, group, ts, ys, up).items()} | lines,
        centres={
            name: np.asarray(space.in_space(centre)) for g in system.bodies.groups for name, centre in _centres(g.group)
        },
        inertias={name: (float(m), J) for name, m, J in zip(moving, mass, moments, strict=False)},
        notes=(f"deformations × {deformation:g}",) if owners and deformation != 1 else (),
    )


def _pictured(group):
    """The parts as a picture shows them; parts on the ground keep their given places."""
    # A part may have no numbers, such as a driver of an angle by a function.
    moved = jax.vmap(lambda part: part.pictured(group.layout.space), axis_size=len(group.names))(group.part)
    last = np.flatnonzero(group.layout.is_place(group.bodies[0]))[-1]
    on_ground = group.body_index[:, last] == group.layout.ground
    kept = lambda old, new: jnp.where(on_ground.reshape(-1, *[1] * (new.ndim - 1)), old, new)
    return eqx.tree_at(lambda stacked: stacked.part, group, jax.tree.map(kept, group.part, moved))


def _shapes(part, space, width, followed):
    """The shapes of a part in the frames of their bodies, each with the index of its body within the part."""
    along = () if followed is None else part.shapes_along(space, width, followed)
    for k, shape in (*part.shapes(space, width), *along):
        frame = part.body_frames.get(str(k))
        yield k, shape if frame is None else shape.moved(*space.placement(frame.pose_in_body(space)))


def _held(part, bodies, space):
    """The ends of a rope or a tendon on the ground, where blocks hold it."""
    owners: Any = getattr(part, "owners", ()) if part.path_kind == "cord" else ()
    # Of a tendon no point is on a circle.
    on_circles = getattr(part, "senses", np.zeros(len(owners)))
    for k in (0, -1) if owners else ():
        if bodies[owners[k]] == GROUND and not on_circles[k]:
            yield np.asarray(space.in_space(part.points[k]))


def _gears(part, bodies, parts, positions, orientations, width):
    """The wheels of a pair of gears about their axes, with the names of their bodies."""
    if part.pitch_radii(1.0) is None:
        return
    gears = bodies[:2]
    axes: list[Any] = [_axis(name, {*bodies} - {name}, parts) for name in gears]
    if any(axis is None for axis in axes):
        return
    first, second = (
        positions[name][0] + rotation_matrix(orientations[name][0]) @ axis
        for name, axis in zip(gears, axes, strict=True)
    )
    distance = float(np.linalg.norm(second - first))
    for name, axis, radius in zip(gears, axes, part.pitch_radii(distance), strict=True):
        if distance > 0:
            gear = wheel(radius, 2.4 * width, axis) if radius > 0 else ring(-radius, 2.4 * width, axis)
            yield from ((name, shape) for shape in gear)


def _axis(name, others, parts):
    """The point of a gear at its axis: of a joint with another body of the pair, or else the mass centre."""
    shared = [part for part in parts.values() if name in part.bodies and others & {*part.bodies}]
    points = [part.points[part.bodies.index(name)] for part in shared]
    return next((point for point in points if point is not None), None if name == GROUND else np.zeros(3))


def _centres(group):
    """Names and mass centres of bodies whose origin is elsewhere."""
    given = group.part.mass_centre
    return () if given is None else zip(group.names, np.asarray(given), strict=True)


def _parts(group, body_names):
    """Names, bodies and parts of a group, with numbers in NumPy. A frame that moves in a flexible body counts as a
    body, and its part sees it alone.
    """
    stacked = jax.tree.map(np.asarray, group.part)
    moving = [k for k, frame in stacked.body_frames.items() if frame.is_flexible]
    if moving:
        fixed = {k: frame for k, frame in stacked.body_frames.items() if k not in moving}
        stacked = stacked.with_fields(body_frames=fixed)
    for member, (name, bodies) in enumerate(zip(group.names, group.bodies, strict=True)):
        named = {k: body_names[body] for k, body in enumerate(bodies) if body in body_names}
        named |= {int(k): dict(group.inner)["body_frames", k][member] for k in moving}
        yield name, tuple(named.values()), jax.tree.map(lambda leaf, k=member: leaf[k], stacked)


def _flexible_frames(system):
    """Groups of frames that move in flexible bodies."""
    return [g.group for g in system.frames if g.group.part.is_flexible]


def _frames_on(system, body_names):
    """Names, bodies and places of frames that are fixed in their bodies."""
    for group in (g.group for g in system.frames if not g.group.part.is_flexible):
        for k, (name, (body, *_)) in enumerate(zip(group.names, group.bodies, strict=True)):
            frame = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], group.part)
            yield (
                name,
                body_names[body],
                np.asarray(system.layout.space.placement(frame.pose_in_body(system.layout.space))[0]),
            )


def _width(length, parts, places, owners):
    """The radius of a bar, from the sizes of the system and of a typical body; of points, from their distances."""
    reach: dict[str, float] = {}
    for part in parts.values():
        for body, point in zip(part.bodies, part.points, strict=True):
            if point is not None and body != GROUND:
                owner = owners.get(body, body)
                away = np.linalg.norm(point) + np.linalg.norm(places[body] - places[owner])
                reach[owner] = max(reach.get(owner, 0.0), float(away))
    joined = [part.bodies for part in parts.values() if len(part.bodies) == 2 and GROUND not in part.bodies]
    halves = [0.5 * float(np.linalg.norm(places[a] - places[b])) for a, b in joined]
    sizes = [distance for distance in reach.values() if distance > 0] or [half for half in halves if half > 0]
    typical = float(np.median(sizes or [length]))
    return min(0.024 * length, 0.08 * typical)


def _paths(system, group, ts, ys, up) -> dict[str, Line]:
    lines, slack = (_world_values(system, group, hook, ts, ys) for hook in ("path", "excess_length"))
    if lines is None:
        return {}
    lines = in_space(lines)
    drawn = lambda k: lines[:, k] if slack is None else _hanging(lines[:, k], np.asarray(slack)[:, k], up)
    return {name: Line(group.part.path_kind or "rod", drawn(k)) for k, name in enumerate(group.names)}


def _followed(system, group, ts, ys):
    """For each part what it follows along the motion, or None."""
    values = _world_values(system, group, "followed", ts, ys)
    return [None] * len(group.names) if values is None else np.asarray(values).swapaxes(0, 1)


def _hanging(ends, slack, up):
    """Cords with two ends, shape (times, 2, 3), that are longer than their distance by `slack` [m], as parabolas."""
    share = np.linspace(0.0, 1.0, 25)[:, None]
    straight = ends[:, :1] + share * (ends[:, 1:] - ends[:, :1])
    hung = lambda sag: straight - 4 * sag[:, None, None] * share * (1 - share) * up
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) + np.maximum(slack, 0.0)
    low, high = np.zeros_like(length), length
    for _ in range(40):
        sag = 0.5 * (low + high)
        longer = np.sum(np.linalg.norm(np.diff(hung(sag), axis=1), axis=2), axis=1) > length
        low, high = np.where(longer, low, sag), np.where(longer, sag, high)
    return hung(np.where(slack > 0, low, 0.0))


def _places(system, ts, ys, owners, held, deformation):
    """Positions and orientations of bodies, ground and flexible frames, and lines of flexible bodies, by name.

    Deformations are magnified from the undeformed body, or from the chord where joints have `held` its frames.
    """
    names: list[str] = [*system.body_names, GROUND, *owners]
    position, orientation, lines = _named_places(system, names, ts, ys.q)
    if owners and deformation != 1:
        modal = [system.layout.pose_index[g.body_index[:, 1:], 0].ravel() for g in _flexible(system)]
        at_rest, _, rest = _named_places(system, names, ts, ys.q.at[:, np.concatenate(modal)].set(0.0))
        grown = lambda base, to: base + deformation * (to - base)
        position |= {name: grown(at_rest[name], position[name]) for name in owners if owners[name] not in held}
        for name, line in lines.items():
            share = np.linspace(0.0, 1.0, line.shape[1])[:, None]
            lines[name] = grown(
                line[:, :1] + share * (line[:, -1:] - line[:, :1]) if name in held else rest[name], line
            )
    # Other flexible bodies are straight lines to their frames.
    for name in dict.fromkeys(owners.values()):
        ends = [x for frame, owner in owners.items() if owner == name for x in (position[name], position[frame])]
        lines.setdefault(name, np.stack(ends, axis=1))
    return position, orientation, {name: Line("bar", points) for name, points in lines.items()}


def _flexible(system):
    return [g.group for g in system.bodies.groups if g.is_flexible]


def _named_places(system, names, ts, q):
    position, orientation, lines = _placements(system, ts, q)
    of_groups = [(g, in_space(x)) for g, x in zip(_flexible(system), lines, strict=True) if x is not None]
    named = {name: x[:, k] for g, x in of_groups for k, name in enumerate(g.names)}
    by_name = lambda values: dict(zip(names, np.asarray(values).swapaxes(0, 1), strict=True))
    return by_name(position), by_name(orientation), named


@eqx.filter_jit
def _placements(system, ts, q):
    """Positions and orientations of bodies, ground and flexible frames, and of points of flexible bodies in lines."""
    space, places = system.layout.space, np.append(np.arange(system.layout.bodies), system.layout.ground)

    def at_time(t, q):
        poses = system.bodies.prepared_poses(q)
        frames = [FrameGroup(g).poses(t, poses) for g in _flexible_frames(system)]
        in_world = lambda pose, line: None if line is None else jax.vmap(functools.partial(space.point, pose))(line)
        line = lambda at, x: in_world(x[0], at(t).line(space, x[1:, 0]))
        lines = [g.map(line, g.gather(poses)) for g in _flexible(system)]
        return *jax.vmap(space.placement)(jnp.concatenate([poses[places], *frames])), lines

    return jax.vmap(at_time)(ts, q)


def _world_values(system, group, hook, ts, ys):
    """What a hook of the parts gives along the motion, shape (times, parts, …); None if they have no such hook."""
    is_inherited = getattr(type(group.part), hook) is getattr(AbstractLink, hook)
    if is_inherited and (hook != "path" or group.part.path_kind is None):
        return None
    return _values_along(system, group, hook, ts, ys)


@eqx.filter_jit
def _values_along(system, group, hook, ts, ys):
    def at_time(t, y):
        poses = group.gather(system.bodies.prepared_poses(y.q))
        space = system.layout.space
        return group.map(lambda at, x: getattr(at(t), hook)(space, at(t).seen_poses(space, x)), poses)

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
