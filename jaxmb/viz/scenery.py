"""Where motions stand in a picture, where it is seen from, and what is around them: ground, grids and labels."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..linalg.rotations import rotation_matrix
from ..parts.shapes import GROUND, Ground, along
from . import meshes, stage
from .motion_nodes import Motion

_FRONT_ANGLE, _ANGLE = np.radians(8.0), np.radians(35.0)  # Of view; from the front nearly without perspective.
_ASPECT = 1.6


@dataclasses.dataclass(frozen=True)
class View:
    """Where motions stand and how they are seen.

    **Fields:** `offsets` [m] of the motions; `low` and `high`: corners [m] of what all of them reach; `size` [m] of one
    motion; `camera`; `cell` [m] of grids.
    """

    offsets: list[Float[np.ndarray, "3"]]
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    size: float
    camera: stage.Camera
    cell: float

    @property
    def grain(self) -> float:
        """The length [m] below which nothing is seen."""
        return 2e-5 * self.size

    @classmethod
    def of(cls, motions: Sequence[Motion], overlay: bool) -> "View":
        """Motions in rows and columns, or all in one place."""
        planar, up = motions[0].picture.planar, motions[0].picture.up
        if any(own.picture.planar != planar for own in motions):
            raise ValueError("Planar and spatial motions cannot be shown in one picture; show each by itself.")
        bounds = np.array([own.bounds for own in motions])
        extent = np.max(bounds[:, 1] - bounds[:, 0], axis=0)
        size = float(np.linalg.norm(extent))
        # The two directions of rows and columns: across the picture, and down it or into its depth.
        right, deep = _across(planar, up)
        n, step = len(motions), 1.15 * extent + 0.1 * size
        columns = _columns(n, abs(step @ right), abs(step @ deep))
        offsets = [np.zeros(3) for _ in motions]
        if not overlay:
            for k in range(n):
                place = (k % columns) * abs(step @ right) * right + (k // columns) * abs(step @ deep) * deep
                offsets[k] = place
        corners = np.array([own.bounds + offset for own, offset in zip(motions, offsets, strict=True)])
        low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
        cell = _nice(float(np.max(extent)) / 12)
        return cls(offsets, low, high, size, _camera(planar, up, low, high), cell)


def _across(planar, up):
    if planar:
        return np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    right = np.roll(np.abs(up), 1)
    return right, np.cross(up, right)


def _columns(n, width, height):
    """How many columns make rows and columns of a size nearest to the picture's shape."""
    shape = lambda columns: columns * width / (np.ceil(n / columns) * height)
    return min(range(1, n + 1), key=lambda columns: abs(np.log(shape(columns) / _ASPECT)))


def _camera(planar, up, low, high):
    middle, extent = (low + high) / 2, high - low
    if planar:
        half = 0.56 * max(extent[1], extent[0] / _ASPECT) + 0.02 * np.linalg.norm(extent)
        away = np.array([0.0, 0.0, half / np.tan(_FRONT_ANGLE / 2) + extent[2]])
        return stage.Camera(middle + away, middle, up, _FRONT_ANGLE, shadows=False)
    right, deep = _across(planar, up)
    direction = 0.55 * right - deep + 0.45 * up
    half = 0.5 * np.linalg.norm(extent)
    away = direction / np.linalg.norm(direction) * 0.85 * half / np.sin(_ANGLE / 2)
    return stage.Camera(middle + away, middle, up, _ANGLE, shadows=True)


def nodes(motions: Sequence[Motion], view: View) -> list[stage.Node]:
    """What does not move: ground or grids, and the names of the motions."""
    out: list[stage.Node] = []
    up, planar = motions[0].picture.up, motions[0].picture.planar
    seen = []
    for own, offset in zip(motions, view.offsets, strict=True):
        for ground in own.grounds:
            drawn = _ground(ground, own.bounds, planar, own.width)
            if not any(_same(drawn, other) and np.array_equal(offset, there) for other, there in seen):
                seen.append((drawn, offset))
    for k, ((mesh, place), offset) in enumerate(seen):
        out.append(_surface(f"/ground/{k}", mesh, place.position + offset, place.orientation))
    if planar:
        out.append(_grid(view, np.array([0.0, 0.0, 1.0]), view.low[2] - 0.02 * view.size, margin=2.0))
    elif not seen:
        out.append(_grid(view, up, view.low @ np.abs(up) if up.sum() > 0 else -(view.high @ np.abs(up)), margin=0.6))
    for own, offset in zip(motions, view.offsets, strict=True):
        if own.name:
            low, high = own.bounds
            top = (low + high) / 2 + offset + up * (0.5 * abs((high - low) @ up) + 0.03 * view.size)
            out.append(stage.label(f"/names/{own.name}", [own.name], top))
    return out


def clock(times: Float[np.ndarray, "times"], notes: Sequence[str], view: View) -> stage.Node:
    """A label with the time of the motion, the size of the grid, and notes."""
    digits = max(0, 2 - int(np.floor(np.log10(times[-1] - times[0]))))
    rest = "".join(f"  ·  {note}" for note in (f"grid {view.cell:g} m", *notes))
    up = view.camera.up
    below = (view.low + view.high) / 2 - up * (0.5 * abs((view.high - view.low) @ up) + 0.04 * view.size)
    return stage.label("/clock", [f"t = {t:.{digits}f} s{rest}" for t in times], below, anchor="top-center")


def _ground(ground, bounds, planar, width):
    """The mesh of the ground below a motion, and its place."""
    low, high = bounds
    if planar:
        return meshes.strip(ground, *_wider(low, high, 0.08), 6 * width, 3 * width), ground
    matrix = rotation_matrix(ground.orientation)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
    own = (corners - ground.position) @ matrix
    return meshes.sheet(ground, *_wider(own.min(axis=0), own.max(axis=0), 0.25)), ground


def _wider(low, high, share):
    more = share * np.max(high - low)
    return low - more, high + more


def _same(a, b):
    (mesh, place), (other, there) = a, b
    same = lambda x, y: x.shape == y.shape and np.allclose(x, y)
    placed = same(place.position, there.position) and same(place.orientation, there.orientation)
    return placed and same(mesh.vertices, other.vertices)


def _surface(name, mesh, position, orientation):
    def add(scene):
        return scene.add_mesh_simple(
            name,
            mesh.vertices.astype(np.float32),
            mesh.faces.astype(np.uint32),
            color=GROUND,
            flat_shading=not mesh.smooth,
            side="double",
            position=position,
            wxyz=orientation,
        )

    return stage.Node(add)


def _grid(view, normal, height, margin):
    """Squares of the view's cell in the plane at a height along its normal."""
    middle = (view.low + view.high) / 2
    position = middle - (middle @ normal) * normal + height * normal
    position = np.where(normal == 0, np.round(position / (5 * view.cell)) * 5 * view.cell, position)
    extent = (1 + margin) * float(np.max(view.high - view.low))
    side = 10 * view.cell * np.ceil(extent / (10 * view.cell))

    def add(scene):
        return scene.add_grid(
            "/grid",
            width=side,
            height=side,
            plane="xy",
            cell_size=view.cell,
            section_size=5 * view.cell,
            cell_color=(225, 225, 225),
            section_color=(200, 200, 200),
            shadow_opacity=0.15,
            fade_strength=0.0,
            position=position,
            wxyz=along(normal),
        )

    return stage.Node(add)


def _nice(size):
    """The nearest lower number of the kind 1, 2, 5, 10, …"""
    power = 10.0 ** np.floor(np.log10(size))
    return float(max(digit * power for digit in (1, 2, 5) if digit * power <= size * (1 + 1e-9)))
