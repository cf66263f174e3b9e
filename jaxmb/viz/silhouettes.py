"""Shapes and the lines of parts as areas and lines of a figure."""

import numpy as np
from jaxtyping import Float

from ..linalg.rotations import rotation_matrix
from ..parts.shapes import AbstractShape
from ..system.picture import Line
from .solids import hull

_TURN = np.linspace(0.0, 2 * np.pi, 33)
_CIRCLE = np.stack([np.cos(_TURN), np.sin(_TURN), 0 * _TURN], axis=1)
_UP = np.array([0.0, 0.0, 0.5])
_SQUARE = np.array([(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0), (-0.5, -0.5, 0.0)])
# The edges of shapes of unit size.
_EDGES = {
    "box": [np.concatenate([_SQUARE - _UP, _SQUARE + _UP]), *(np.stack([x - _UP, x + _UP]) for x in _SQUARE[1:4])],
    "cylinder": [_CIRCLE - _UP, _CIRCLE + _UP],
    "sphere": [_CIRCLE, np.roll(_CIRCLE, 1, axis=1), np.roll(_CIRCLE, 2, axis=1)],
}
# Into how many faces a circle, a bar along its length, and a ball from pole to pole are cut.
_SEGMENTS, _ALONG, _BELTS = 32, 6, 10
_COIL = np.array([0.0, 0.15, *np.linspace(0.2, 0.8, 12), 0.85, 1.0])


def area(shape: AbstractShape) -> Float[np.ndarray, "corners 3"]:
    """The corners [m] of a shape's outline in the plane, by default of its convex hull, at the middle of its
    depth; in the axes of its body.
    """
    outline = getattr(shape, "outline", None)
    vertices = getattr(shape, "vertices", None)
    points = _placed(shape, np.concatenate(_EDGES[shape.primitive]) if vertices is None else vertices)
    corners = hull(list(points)) if outline is None else _placed(shape, outline)
    return np.column_stack([corners[:, :2], np.full(len(corners), 0.5 * (points[:, 2].min() + points[:, 2].max()))])


def size(corners: Float[np.ndarray, "corners 3"]) -> float:
    """The area [m²] of a polygon in the plane."""
    x, y = corners[:, :2].T
    return 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))


def edges(shape: AbstractShape) -> list[Float[np.ndarray, "points 3"]]:
    """The edges [m] of a shape in the axes of its body; a bar has only its middle line, a surface of triangles none."""
    if shape.primitive == "cylinder" and shape.scale[2] > 3 * shape.scale[0]:
        return [_placed(shape, np.stack([-_UP, _UP]))]
    return [_placed(shape, line) for line in _EDGES.get(shape.primitive, [])]


def faces(shape: AbstractShape) -> Float[np.ndarray, "faces 4 3"]:
    """The faces [m] of a shape in the axes of its body, as quadrilaterals, of which triangles have their last corner
    twice; none of the ground.
    """
    if shape.primitive == "ground":
        return np.zeros((0, 4, 3))
    triangles = getattr(shape, "faces", None)
    unit = _UNIT[shape.primitive] if triangles is None else shape.vertices[triangles[:, [0, 1, 2, 2]]]  # pyright: ignore
    return _placed(shape, unit.reshape(-1, 3)).reshape(unit.shape)


def _grid(points):
    """The quadrilaterals between rows of points."""
    a, b = points[:-1], points[1:]
    return np.stack([a[:, :-1], a[:, 1:], b[:, 1:], b[:, :-1]], axis=2).reshape(-1, 4, 3)


def _unit_faces():
    """A bar is cut along its length, so that the faces in front of another body hide it."""
    turn, height = np.linspace(0.0, 2 * np.pi, _SEGMENTS + 1), np.linspace(-0.5, 0.5, _ALONG + 1)
    circle = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    tilt = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _BELTS + 1)[:, None]
    ball = np.stack([np.cos(tilt) * circle[:, 0], np.cos(tilt) * circle[:, 1], np.sin(tilt) + 0 * turn], axis=2)
    tube = _grid(circle + height[:, None, None] * 2 * _UP)
    end = np.stack([0 * circle[1:], circle[:-1], circle[1:], circle[1:]], axis=1)
    square = np.stack([_SQUARE[:4] - _UP, _SQUARE[:4] + _UP])
    box = np.concatenate([np.roll(square, k, axis=2) for k in range(3)])
    return {"box": box, "cylinder": np.concatenate([tube, end - _UP, end + _UP]), "sphere": _grid(ball)}


def _placed(shape, points):
    return shape.position + (points * shape.scale) @ rotation_matrix(shape.orientation).T


def strip(points: Float[np.ndarray, "points 3"], width: float) -> Float[np.ndarray, "segments 4 2"]:
    """The corners [m] of the segments of a thick line in the plane."""
    start, end = points[:-1, :2], points[1:, :2]
    along = end - start
    across = width * np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([start + across, end + across, end - across, start - across], axis=1)


def stroke(line: Line, time: int, width: float) -> Float[np.ndarray, "points 3"]:
    """The points [m] of the line of a part at a time: a zigzag for a spring, a closed line for a belt."""
    points = line.points[time]
    if line.kind == "belt":
        return np.concatenate([points, points[:1]])
    if line.kind != "coil":
        return points
    start, along = points[0], points[-1] - points[0]
    across = np.array([-along[1], along[0], 0.0]) if np.any(along[:2]) else np.array([1.0, 0.0, 0.0])
    out = start + _COIL[:, None] * along
    sides = np.where(np.arange(len(_COIL) - 4) % 2 == 0, 1.0, -1.0)[:, None]
    out[2:-2] += 1.5 * width * sides * across / np.linalg.norm(across)
    return out


_UNIT = _unit_faces()
