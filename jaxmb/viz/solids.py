"""Shapes that show bodies in a picture: given shapes, shapes of parts, or bars to the points where parts act."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..linalg.rotations import from_matrix
from ..parts.base import GROUND
from ..parts.shapes import DARK, AbstractShape, Box, Color, Cylinder, Mesh, Sphere, support
from ..system.picture import Picture

# Distinct also for colour-blind readers, after Okabe and Ito, darkened for a white background.
COLORS: tuple[Color, ...] = (
    (0, 114, 178),
    (213, 94, 0),
    (0, 140, 105),
    (204, 121, 167),
    (214, 150, 0),
    (64, 160, 215),
    (130, 92, 60),
    (120, 120, 200),
)
_GROUND: Color = (125, 125, 125)

Placed = tuple[str, Any]


def solids(
    picture: Picture, given: Mapping[str, AbstractShape | Sequence[AbstractShape]], tint: Color | None
) -> list[Placed]:
    """All shapes with the names of their bodies.

    **Arguments:** `given`: the shapes of bodies by name, in place of the default; `tint`: a colour for all bodies,
    default a colour each.
    """
    points, width, on_bars = _attachments(picture), picture.width, picture.on_bars
    of_parts: dict[str, list[AbstractShape]] = {name: [] for name in picture.positions}
    for body, shape in picture.shapes:
        of_parts[body].append(shape)
    out: list[Placed] = []
    for name in picture.positions:
        if name in given:
            body_shapes = given[name]
            body_shapes = [body_shapes] if isinstance(body_shapes, AbstractShape) else list(body_shapes)
            if name in picture.centres:
                # Bodies are placed by their mass centres.
                body_shapes = [
                    shape.moved(-picture.centres[name], np.array([1.0, 0.0, 0.0, 0.0])) for shape in body_shapes
                ]
        elif name == GROUND:
            body_shapes = [support(point, picture.up, width) for point in points[name]]
        else:
            body_shapes = [] if name in picture.owners else _linkage(points[name], picture.planar, width)
            if not body_shapes and name in on_bars:
                body_shapes = [Sphere(width, color=None if name in picture.paths else DARK)]
            elif not body_shapes and not of_parts[name] and name in picture.bodies:
                body_shapes = _equivalent(*picture.inertias[name], width)
        color = _GROUND if name == GROUND else color_in(picture, name, tint)
        # Blocks of joints would hide given shapes.
        kept = [shape for shape in of_parts[name] if name not in given or shape.color != DARK]
        out += [(name, shape.colored(color)) for shape in (*body_shapes, *kept)]
    return out


def color_in(picture: Picture, name: str, tint: Color | None = None) -> Color:
    """The colour of a body, of a frame in it, and of its line; other lines are dark."""
    body = picture.owners.get(name, name)
    return tint or COLORS[picture.bodies.index(body) % len(COLORS)] if body in picture.bodies else DARK


def _attachments(picture):
    """The distinct points of every body where parts act on it."""
    points: dict[str, dict[tuple, np.ndarray]] = {name: {} for name in picture.positions}
    for part in picture.parts.values():
        for body, point in zip(part.bodies, part.points, strict=True):
            if point is not None:
                points[body][tuple(np.round(point, 9))] = point
    return {name: list(distinct.values()) for name, distinct in points.items()}


def _linkage(points, planar, width):
    """A plate through three or more points in the plane; otherwise bars from the mass centre to the points, and a ball
    at the mass centre.
    """
    if planar and len(points) > 2:
        corners = hull([np.zeros(3), *points])
        middle = np.mean(corners, axis=0)
        area = 0.5 * np.sum(_turn(corners, np.roll(corners, -1, axis=0), middle))
        if area > 2 * width * np.max(np.linalg.norm(corners - middle, axis=1)):
            return [
                Mesh.plate(corners[:, :2], 0.8 * width, position=(0.0, 0.0, -1.2 * width)),
                Sphere(1.4 * width),
            ]
    away = [point for point in points if np.linalg.norm(point) > 0.5 * width]
    bars = [Cylinder.between(np.zeros(3), point, width) for point in away]
    # A bar to a single point ends in the mass.
    return [*bars, Sphere((1.4 if len(bars) > 1 else 2.2) * width)] if bars else []


def hull(points):
    """The corners of the convex hull of points of the plane, counter-clockwise, by A. M. Andrew's monotone chain."""
    ascending = sorted(points, key=lambda p: (p[0], p[1]))

    def half(ordered):
        chain: list[np.ndarray] = []
        for point in ordered:
            while len(chain) > 1 and _turn(chain[-1], point, chain[-2]) <= 0:
                chain.pop()
            chain.append(point)
        return chain[:-1]

    return np.array([*half(ascending), *half(ascending[::-1])])


def _turn(a, b, origin):
    """The third component of the product of two arms from an origin, positive for a turn to the left."""
    a, b = a - origin, b - origin
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _equivalent(mass, moments, width) -> list[AbstractShape]:
    """The homogeneous cuboid with a body's mass and moments of inertia; a ball for a point mass."""
    values, axes = np.linalg.eigh(moments)
    if values[-1] <= 0:
        return [Sphere(2.5 * width)]
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    squares = 6.0 * (np.sum(values) - 2.0 * values) / mass
    size = np.sqrt(np.maximum(squares, (0.5 * width) ** 2))
    return [Box(size, orientation=np.asarray(from_matrix(axes)))]
