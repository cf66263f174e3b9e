"""Triangle meshes of unit size, scaled by shapes, and of the ground."""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..parts.shapes import Ground

_COIL_TURNS, _COIL_RADIUS = 8, 0.9


class Triangles(NamedTuple):
    """Vertices, and the three vertices of each face; `smooth`: whether light varies within a face."""

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    smooth: bool = False


@functools.cache
def unit_mesh(kind: str) -> Triangles:
    """`"box"` with edges of 1, `"sphere"` of radius 1, `"cylinder"` along z of radius and length 1, all centred;
    `"coil"`, a helix along z from 0 to 1 of radius about 1.
    """
    if kind == "coil":
        return _coil()
    import trimesh

    if kind == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=3)
    else:
        mesh = trimesh.creation.box() if kind == "box" else trimesh.creation.cylinder(1.0, 1.0, sections=40)
    return Triangles(np.asarray(mesh.vertices), np.asarray(mesh.faces), kind == "sphere")


def _coil():
    """A tube around a helix with straight ends on its axis."""
    s = np.linspace(0.0, 1.0, 24 * _COIL_TURNS + 1)
    wound = np.clip((s - 0.1) / 0.8, 0.0, 1.0)
    radius = _COIL_RADIUS * np.clip(np.minimum(s - 0.08, 0.92 - s) / 0.04, 0.0, 1.0)
    angle = 2 * np.pi * _COIL_TURNS * wound
    line = np.stack([radius * np.cos(angle), radius * np.sin(angle), s], axis=1)
    # The section of the tube lies in the plane through the axis, so that stretching the coil keeps its wire round.
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(s)], axis=1)
    around = 2 * np.pi * np.arange(6) / 6
    ring = np.cos(around)[None, :, None] * outward[:, None] + np.sin(around)[None, :, None] * np.array([0, 0, 0.08])
    vertices = (line[:, None] + 0.22 * ring).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(len(s) - 1), np.arange(6), indexing="ij")
    a, b = 6 * i + j, 6 * i + (j + 1) % 6
    faces = np.concatenate([np.stack([a, b, b + 6], -1).reshape(-1, 3), np.stack([a, b + 6, a + 6], -1).reshape(-1, 3)])
    return Triangles(vertices, faces, smooth=True)


def strip(ground: Ground, low: np.ndarray, high: np.ndarray, depth: float, width: float) -> Triangles:
    """The ground of a planar picture from x = low[0] to high[0] [m], as a slab with its profile on top."""
    x = np.linspace(low[0], high[0], 400)
    y = heights(ground, x[:, None])
    bottom = np.full_like(y, y.min() - depth)
    corners = [np.stack([x, height, np.full_like(x, z)], axis=1) for z in (width, -width) for height in (y, bottom)]
    front_top, front_bottom, back_top, back_bottom = (400 * k + np.arange(400) for k in range(4))
    faces = [_band(front_bottom, front_top), _band(front_top, back_top), _band(back_top, back_bottom)]
    return Triangles(np.concatenate(corners), np.concatenate(faces))


def sheet(ground: Ground, low: np.ndarray, high: np.ndarray) -> Triangles:
    """The ground of a spatial picture over a rectangle of places [m], in the ground's axes."""
    n = 80
    x, y = np.meshgrid(np.linspace(low[0], high[0], n), np.linspace(low[1], high[1], n), indexing="ij")
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    rows = np.arange(n * n).reshape(n, n)
    faces = np.concatenate([_band(rows[k], rows[k + 1])[:, ::-1] for k in range(n - 1)])
    return Triangles(np.concatenate([places, heights(ground, places)[:, None]], axis=1), faces, smooth=True)


def heights(ground: Ground, places: np.ndarray) -> np.ndarray:
    """Heights [m] of the ground at places, shape (n, 1) in the plane or (n, 2)."""
    import jax

    return np.asarray(jax.vmap(ground.height)(places)) if ground.height is not None else np.zeros(len(places))


def _band(a, b):
    """Faces between two rows of vertices."""
    return np.concatenate([np.stack([a[:-1], a[1:], b[1:]], 1), np.stack([a[:-1], b[1:], b[:-1]], 1)])
