"""The shapes of imported links as those of pictures."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..linalg import rotations as rot
from ..parts.shapes import AbstractShape, Box, Cylinder, Ground, Mesh, Sphere
from .description import Shape


def pictures(shapes: Sequence[Shape]) -> dict[str, tuple[AbstractShape, ...]]:
    """Shapes for a picture by the name of the body. Meshes whose files are not there are left out, and shapes for
    collisions are shown where a body has nothing else to show.
    """
    of_bodies: dict[str, list[Shape]] = {}
    for shape in shapes:
        of_bodies.setdefault(shape.body, []).append(shape)
    out = {}
    for body, own in of_bodies.items():
        for collides in (False, True):
            found = tuple(picture for shape in own if shape.collides is collides for picture in _picture(shape))
            if found:
                out[body] = found
                break
    return out


def _picture(shape: Shape) -> tuple[AbstractShape, ...]:
    r, g, b = (round(255 * value) for value in shape.colour[:3])
    place = {"position": np.asarray(shape.position), "orientation": np.asarray(shape.orientation), "color": (r, g, b)}
    if shape.colour[3] == 0:
        return ()
    size = shape.size
    if shape.kind == "box":
        return (Box(2 * np.asarray(size), **place),)
    if shape.kind == "sphere":
        return (Sphere(size[0], **place),)
    if shape.kind == "cylinder":
        return (Cylinder(size[0], 2 * size[1], **place),)
    if shape.kind == "capsule":
        half: Any = np.array([0.0, 0.0, size[1]])
        axis = rot.rotate(place["orientation"], half)
        balls = [Sphere(size[0], **(place | {"position": place["position"] + s * axis})) for s in (-1.0, 1.0)]
        return Cylinder(size[0], 2 * size[1], **place), *balls
    if shape.kind == "ellipsoid":
        return (dataclasses.replace(_UNIT_BALL, vertices=_UNIT_BALL.vertices * np.asarray(size), **place),)
    if shape.kind == "plane":
        return (Ground(**place),)
    if shape.vertices is not None:
        return (Mesh(shape.vertices, shape.faces, **place),)
    if not Path(shape.file).is_file():
        return ()
    mesh = Mesh.read(shape.file, **place)
    return (dataclasses.replace(mesh, vertices=mesh.vertices * np.asarray(shape.size or (1.0, 1.0, 1.0))),)


def _unit_ball(rings: int = 12) -> Mesh:
    """Rings of vertices from pole to pole, those at the poles in one point."""
    turn, rise = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * rings + 1), np.linspace(-np.pi / 2, np.pi / 2, rings + 1))
    vertices = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=-1)
    k = np.arange(vertices[..., 0].size).reshape(turn.shape)
    a, b, c, d = (own.ravel() for own in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    return Mesh(vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


_UNIT_BALL = _unit_ball()
