"""Places of motions in a picture, its camera, and its ground, grids and labels."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from ..linalg.rotations import rotation_matrix
from ..parts.shapes import GROUND, along
from . import meshes, stage
from .motion_nodes import Motion

# Vertical fields of view of planar and of spatial pictures; the narrow field shows nearly no perspective.
_FRONT_ANGLE, _ANGLE = np.radians(8.0), np.radians(35.0)
# Width over height of a picture, and the share of it that the motions fill.
_ASPECT, _FILLED = 1.6, 0.85


@dataclasses.dataclass(frozen=True)
class View:
    """The places of motions and the view of them.

    **Fields:** `offsets` [m] of the motions; `low` and `high`: corners [m] of the region that all motions reach; `size`
    [m] of one motion; `camera`; `cell` [m] of grids.
    """

    offsets: list[Float[np.ndarray, "3"]]
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    size: float
    camera: stage.Camera
    cell: float

    @property
    def grain(self) -> float:
        """The length [m] below which nothing is visible."""
        return 2e-5 * self.size

    @classmethod
    def of(cls, motions: Sequence[Motion], overlay: bool) -> "View":
        """Motions in rows and columns, or all in one place."""
        planar, up = motions[0].picture.planar, motions[0].picture.up
        if any(single.picture.planar != planar for single in motions):
            raise ValueError("Planar and spatial motions cannot be shown in one picture; show each by itself.")
        bounds = np.array([single.bounds for single in motions])
        extent = np.max(bounds[:, 1] - bounds[:, 0], axis=0)
        size = float(np.linalg.norm(extent))
        # The directions of rows and columns: across the picture, and down or into its depth.
        right, deep = _across(planar, up)
        n, step = len(motions), 1.15 * extent + 0.1 * size
        columns = _columns(n, abs(step @ right), abs(step @ deep))
        place = lambda k: (k % columns) * abs(step @ right) * right + (k // columns) * abs(step @ deep) * deep
        offsets = [np.zeros(3) if overlay else place(k) for k in range(n)]
        corners = np.array([single.bounds + offset for single, offset in zip(motions, offsets, strict=True)])
        low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
        cell = round_number(float(np.max(extent)) / 12)
        return cls(offsets, low, high, size, _camera(planar, up, low, high), cell)


def round_number(size: float) -> float:
    """The largest of the numbers …, 1, 2, 5, 10, … that is not above a size."""
    power = 10.0 ** np.floor(np.log10(size))
    return float(max(digit * power for digit in (1, 2, 5) if digit * power <= size * (1 + 1e-9)))


def _across(planar, up):
    if planar:
        return np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    right = np.roll(np.abs(up), 1)
    return right, np.cross(up, right)


def _columns(n, width, height):
    """The number of columns for which the shape of the arrangement is nearest to the picture's."""
    shape = lambda columns: columns * width / (np.ceil(n / columns) * height)
    return min(range(1, n + 1), key=lambda columns: abs(np.log(shape(columns) / _ASPECT)))


def _camera(planar, up, low, high):
    middle, extent = (low + high) / 2, high - low
    if planar:
        half = max(0.6 * extent[1], 0.55 * extent[0] / _ASPECT) + 0.06 * np.linalg.norm(extent)
        away = np.array([0.0, 0.0, half / np.tan(_FRONT_ANGLE / 2) + extent[2]])
        return stage.Camera(middle + away, middle, up, _FRONT_ANGLE, shadows=False)
    right, deep = _across(planar, up)
    direction = 0.55 * right - deep + 0.45 * up
    direction /= np.linalg.norm(direction)
    across = np.cross(up, direction)
    across /= np.linalg.norm(across)
    corners = np.array(np.meshgrid(*zip(low - middle, high - middle, strict=True))).reshape(3, -1).T
    # As near as the corners of the region allow, with some room for labels.
    beside, above = np.abs(corners @ across) / _ASPECT, np.abs(corners @ np.cross(direction, across))
    distance = np.max(corners @ direction + np.maximum(beside, above) / (_FILLED * np.tan(_ANGLE / 2)))
    return stage.Camera(middle + distance * direction, middle, up, _ANGLE, shadows=True)


def nodes(motions: Sequence[Motion], view: View) -> list[stage.SceneNode]:
    """Fixed objects: the ground, or a grid, and the names of the motions."""
    up, planar = motions[0].picture.up, motions[0].picture.planar
    out, surfaces, level = [], [], []
    for single, offset in zip(motions, view.offsets, strict=True):
        for ground in single.grounds:
            place = (ground.position + offset, ground.orientation)
            if planar or ground.height is not None:
                surfaces.append((_mesh(ground, single, planar), *place))
            else:
                level.append(place)
    surfaces, level = _distinct(surfaces), _distinct(level)
    out += [_surface(f"/ground/{k}", *arguments) for k, arguments in enumerate(surfaces)]
    out += [_grid(f"/ground/level {k}", view, *arguments, solid=True) for k, arguments in enumerate(level)]
    if planar:
        behind = np.array([0.0, 0.0, view.low[2] - 0.02 * view.size])
        out.append(_grid("/grid", view, behind, along((0.0, 0.0, 1.0)), share=5.0))
    elif not out:
        lowest = view.low if up.sum() > 0 else view.high
        out.append(_grid("/grid", view, lowest * np.abs(up), along(up)))
    return out + _names(motions, view)


def _names(motions, view):
    """The name above each motion; names of overlapping motions are stacked, with a ball of the motion's colour."""
    up, out = view.camera.up, []
    for k, (single, offset) in enumerate(zip(motions, view.offsets, strict=True)):
        low, high = single.bounds
        top = (low + high) / 2 + offset + up * (0.5 * abs((high - low) @ up) + 0.03 * view.size)
        if single.tint is not None:
            top = top + 0.06 * (len(motions) - 1 - k) * view.size * up
            left = np.cross(up, view.camera.position - view.camera.target)
            ball = top - 0.03 * view.size * left / np.linalg.norm(left)
            out.append(_ball(f"/names/color of {single.name}", ball, 0.012 * view.size, single.tint))
        if single.name:
            anchor = "bottom-center" if single.tint is None else "center-left"
            out.append(stage.label(f"/names/{single.name}", [single.name], top, anchor))
    return out


def _ball(name, position, radius, color):
    return stage.SceneNode(lambda scene: scene.add_icosphere(name, radius, color, position=position, cast_shadow=False))


def clock(times: Float[np.ndarray, "times"], notes: Sequence[str], marks: Sequence[str], view: View) -> stage.SceneNode:
    """A label with the time of the motion, the size of the grid, notes, and a mark at each time, which may be empty."""
    # A state has no duration.
    duration = times[-1] - times[0] or 1.0
    digits = max(0, 2 - int(np.floor(np.log10(duration))))
    rest = "".join(f"  ·  {note}" for note in (f"grid {view.cell:g} m", *notes))
    marks = [f"  ·  {mark}" if mark else "" for mark in marks]
    texts = [f"t = {t:.{digits}f} s{rest}{mark}" for t, mark in zip(times, marks, strict=True)]
    return stage.label("/clock", texts, view.camera.bottom)


def _mesh(ground, motion, planar):
    """The mesh of the ground below a motion, in the ground's axes."""
    low, high = motion.bounds
    if planar:
        depth = 0.02 * float(np.max(high - low))
        return meshes.strip(ground, *_wider(low, high, 0.08), depth, 3 * motion.picture.width)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1).T
    turned = (corners - ground.position) @ rotation_matrix(ground.orientation)
    return meshes.sheet(ground, *_wider(turned.min(axis=0), turned.max(axis=0), 0.25))


def _wider(low, high, share):
    more = share * np.max(high - low)
    return low - more, high + more


def _distinct(groups):
    """The groups without repetitions of equal arrays."""
    key = lambda group: tuple(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(group))
    return list({key(group): group for group in groups}.values())


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

    return stage.SceneNode(add)


def _grid(name, view, position, orientation, *, share=1.7, solid=False):
    """Squares of the view's cell in a plane through a position; `share`: the plane's side over the reach of the
    motions.
    """
    normal, middle = rotation_matrix(orientation)[:, 2], (view.low + view.high) / 2
    shift = middle - position - ((middle - position) @ normal) * normal
    section = 5 * view.cell
    centre = position + np.round(shift / section) * section
    centre = centre - ((centre - position) @ normal) * normal
    side = 2 * section * np.ceil(share * np.max(view.high - view.low) / (2 * section))

    def add(scene):
        return scene.add_grid(
            name,
            width=side,
            height=side,
            plane="xy",
            cell_size=view.cell,
            section_size=section,
            cell_color=(215, 215, 215),
            section_color=(185, 185, 185),
            plane_color=(238, 236, 232),
            plane_opacity=1.0 if solid else 0.0,
            shadow_opacity=0.25,
            fade_strength=0.0,
            position=centre,
            wxyz=orientation,
        )

    return stage.SceneNode(add)
