"""Simple shapes, by which a picture shows bodies and parts.

```python
from jaxmb import shapes
beam = [shapes.Box((1.0, 0.1, 0.05)), shapes.Sphere(0.1, position=(0.5, 0.0, 0.0), color=(200, 60, 40))]
strut = shapes.Cylinder.between((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), 0.03)
lying = {"orientation": shapes.along((1.0, 0.0, 0.0))}  # From the z axis of a shape to the x axis of its body.
logs = [shapes.Cylinder(0.1, 1.0, **lying), *shapes.capsule(0.1, 1.0, **lying)]
egg = shapes.Ellipsoid((0.3, 0.2, 0.2))
flag = shapes.Mesh([(0.0, 0.0, 0.0), (0.3, 0.1, 0.0), (0.0, 0.2, 0.0)], [(0, 1, 2)])
jaxmb.viz.show(motion, shapes={"bar": [*beam, strut], "ground": shapes.Ground()})
```

A shape is placed in the frame of a body: `position` [m] of its origin, and `orientation`, Euler parameters from its
axes to the body's. In the plane, z points to the viewer. A shape has no mass and no effect on the motion.
"""

import abc
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np

from .._moved import tell_of_moved as _tell_of_moved
from .._types import VectorLike
from ..linalg import rotations as rot

__all__ = [
    "AbstractShape",
    "Box",
    "Cylinder",
    "Ellipsoid",
    "Ground",
    "Mesh",
    "Sphere",
    "along",
    "capsule",
]

Color = tuple[int, int, int]
STEEL, DARK, GROUND = (150, 155, 162), (64, 68, 76), (176, 170, 158)


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class AbstractShape(abc.ABC):
    """A shape with its place in a body; `color`: red, green and blue from 0 to 255, default the body's."""

    position: Any = (0.0, 0.0, 0.0)
    orientation: Any = (1.0, 0.0, 0.0, 0.0)
    color: Color | None = None

    # The mesh of unit size that the shape scales; "own" for its own vertices.
    primitive: ClassVar[Literal["box", "sphere", "cylinder", "own", "ground"]]
    # The fields that are lengths.
    lengths: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self):
        for name, size in (("position", 3), ("orientation", 4)):
            value = np.asarray(getattr(self, name), float)
            if value.shape != (size,) or not np.all(np.isfinite(value)):
                raise ValueError(f"{type(self).__name__}: {name} must be {size} finite numbers, got {value.tolist()}.")
            object.__setattr__(self, name, value)
        if not np.any(self.orientation):
            raise ValueError(f"{type(self).__name__}: orientation must not be zero.")
        object.__setattr__(self, "orientation", self.orientation / np.linalg.norm(self.orientation))
        for name in self.lengths:
            value = getattr(self, name)
            if not (np.all(np.isfinite(value)) and np.all(np.asarray(value) > 0)):
                raise ValueError(f"{type(self).__name__}: {name} must be positive, got {value}.")
            if np.shape(self.scale) != (3,):
                raise ValueError(f"{type(self).__name__}: {name} must be three lengths, got {value}.")

    @property
    @abc.abstractmethod
    def scale(self) -> np.ndarray:
        """Lengths [m] by which the mesh of unit size is stretched along its axes, shape (3,)."""

    def moved(self, position: Any, orientation: Any) -> Self:
        """The shape in another frame, given the position and orientation of the present frame in it."""
        shifted = position + rot.rotate(orientation, self.position)
        return dataclasses.replace(self, position=shifted, orientation=rot.multiply(orientation, self.orientation))

    def colored(self, color: Color) -> Self:
        """The shape in this colour, if it has none."""
        return self if self.color is not None else dataclasses.replace(self, color=color)


@dataclasses.dataclass(frozen=True, eq=False)
class Box(AbstractShape):
    """A cuboid with its centre at the position.

    **Arguments:** `size` [m], shape (3,): its edges.
    """

    size: VectorLike
    primitive = "box"
    lengths = ("size",)

    @property
    def scale(self):
        return np.asarray(self.size, float)


@dataclasses.dataclass(frozen=True, eq=False)
class Sphere(AbstractShape):
    """A ball with its centre at the position.

    **Arguments:** `radius` [m].
    """

    radius: float
    primitive = "sphere"
    lengths = ("radius",)

    @property
    def scale(self):
        return np.full(3, float(self.radius))


@dataclasses.dataclass(frozen=True, eq=False)
class Ellipsoid(AbstractShape):
    """An ellipsoid with its centre at the position.

    **Arguments:** `radii` [m], shape (3,), along its axes.
    """

    radii: VectorLike
    primitive = "sphere"
    lengths = ("radii",)

    @property
    def scale(self):
        return np.asarray(self.radii, float)


@dataclasses.dataclass(frozen=True, eq=False)
class Cylinder(AbstractShape):
    """A cylinder along its z axis, with its centre at the position; `Cylinder.between` makes one from its ends.

    **Arguments:** `radius` [m]; `length` [m].
    """

    radius: float
    length: float
    primitive = "cylinder"
    lengths = ("radius", "length")

    @classmethod
    def between(cls, start: VectorLike, end: VectorLike, radius: float, **place: Any) -> "Cylinder":
        """A round bar between two points [m] of a body."""
        start, end = np.asarray(start, float), np.asarray(end, float)
        length = float(np.linalg.norm(end - start))
        return cls(radius, length, position=0.5 * (start + end), orientation=along(end - start), **place)

    @property
    def scale(self):
        return np.array([self.radius, self.radius, self.length], float)


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh(AbstractShape):
    """A surface of triangles; `Mesh.read` reads one from a file, `Mesh.plate` has an outline.

    **Arguments:** `vertices` [m], shape (n, 3), in the shape's axes; `faces`, shape (m, 3): the vertices of each
    triangle, counter-clockwise seen from outside; `outline` [m], shape (k, 3), in a figure of the plane, default the
    convex hull.
    """

    vertices: Any
    faces: Any
    outline: Any = None
    primitive = "own"

    def __post_init__(self):
        super().__post_init__()
        vertices, faces = np.asarray(self.vertices, float), np.asarray(self.faces, int)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(
                f"Mesh: vertices and faces must have shapes (n, 3) and (m, 3), got {vertices.shape} and {faces.shape}."
            )
        if not np.all(np.isfinite(vertices)) or faces.size == 0 or faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError("Mesh: vertices must be finite, and faces must be indices of vertices.")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        if self.outline is not None:
            object.__setattr__(self, "outline", np.asarray(self.outline, float))

    @property
    def scale(self):
        return np.ones(3)

    @classmethod
    def plate(cls, outer: Any, thickness: float, *, inner: Any = None, **place: Any) -> "Mesh":
        """A plate about z = 0, or a ring.

        **Arguments:** `outer` [m], shape (n, 2): the corners of its outline, counter-clockwise, all of which are seen
        from their mean; `thickness` [m]; `inner` [m], shape (n, 2): the corners of the hole of a ring, one for each;
        `position`, `orientation` and `color` as for all shapes.
        """
        outer = np.asarray(outer, float)
        inner, n = np.broadcast_to(outer.mean(axis=0), outer.shape) if inner is None else np.asarray(inner), len(outer)
        layer = lambda points, z: np.column_stack([points, np.full(n, z)])
        rims = [
            layer(points, z * thickness) for points, z in ((outer, 0.5), (outer, -0.5), (inner, -0.5), (inner, 0.5))
        ]
        k, ahead = np.arange(n), np.roll(np.arange(n), -1)
        # Around the section of the plate: outside, back, hole and front.
        faces = [
            corners
            for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))
            for corners in (
                np.stack([a * n + k, b * n + k, a * n + ahead], 1),
                np.stack([a * n + ahead, b * n + k, b * n + ahead], 1),
            )
        ]
        closed = lambda points: layer(points, 0.0)[[*range(n), 0]]
        outline = (
            layer(outer, 0.0)
            if np.ptp(inner, axis=0).max() == 0
            else np.concatenate([closed(outer), closed(inner)[::-1]])
        )
        return cls(np.concatenate(rims), np.concatenate(faces), outline, **place)

    @classmethod
    def read(cls, path: str | Path, *, scale: VectorLike = 1.0, **place: Any) -> "Mesh":
        """A mesh from a file that trimesh reads, such as STL, OBJ, PLY or GLB.

        **Arguments:** `scale` [m per unit of the file], one number or one along each axis, negative for a mirror image;
        `position`, `orientation` and `color` as for all shapes.

        **Raises:** `ImportError` without trimesh, which `jaxmb[view]` installs; `ValueError` for a file that trimesh
        cannot read, such as a file without the extension that specifies its format.
        """
        try:
            import trimesh
        except ImportError as error:
            raise ImportError('Mesh.read needs trimesh; install it with: pip install "jaxmb[view]"') from error
        scales = np.broadcast_to(np.asarray(scale, float), (3,))
        try:
            mesh = trimesh.load_mesh(path)
        except Exception as error:  # Its readers of many formats raise any type of error.
            format_of = Path(path).suffix or "without an extension, which tells the format"
            raise ValueError(
                f"Mesh.read: trimesh cannot read {str(path)!r} ({format_of}): {type(error).__name__}: {error}"
            ) from error
        if not len(mesh.faces):
            raise ValueError(f"Mesh.read: there are no triangles in {str(path)!r}.")
        # A mirrored triangle is seen from its other side.
        faces = np.asarray(mesh.faces)[:, :: -1 if np.prod(scales) < 0 else 1]
        return cls(scales * np.asarray(mesh.vertices), faces, **place)


@dataclasses.dataclass(frozen=True, eq=False)
class Ground(AbstractShape):
    """Ground without limits; a picture draws the visible part.

    **Arguments:** `height(place)`, None for level ground. In space: height [m] above the shape's plane z = 0 at a
    place, shape (2,), in the shape's axes. In the plane: height above y = 0 at a place, shape (1,).
    """

    height: Callable[[Any], Any] | None = None
    primitive = "ground"

    @property
    def scale(self):
        return np.ones(3)


def along(axis: VectorLike) -> np.ndarray:
    """Euler parameters of the shortest turn of the z axis to a direction."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    if z < -1 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    half = np.array([1 + z, -y, x, 0.0])
    return half / np.linalg.norm(half)


def support(point: np.ndarray, up: np.ndarray, width: float) -> Box:
    """A block of the ground below a point [m], in the scale of bars of the radius `width` [m]; above it for `-up`."""
    return Box(np.where(up == 0, 4.0, 2.4) * width, position=point - 1.2 * width * up, color=DARK)


def capsule(radius: float, length: float, **place: Any) -> tuple[AbstractShape, ...]:
    """A cylinder along its z axis with a half ball at either end; `length` [m] without the half balls."""
    middle = Cylinder(radius, length, **place)
    top: Any = np.array([0.0, 0.0, 0.5 * length])
    half = rot.rotate(middle.orientation, top)
    ends = (Sphere(radius, **(place | {"position": middle.position + way * half})) for way in (-1.0, 1.0))
    return middle, *ends


def wheel(
    radius: float,
    width: float | None = None,
    position: VectorLike = (0.0, 0.0, 0.0),
    axis: VectorLike = (0.0, 0.0, 1.0),
) -> tuple[AbstractShape, ...]:
    """A wheel about an axis of a body, with a spoke that shows how it turns; `width` [m], default a third of the
    radius.
    """
    width, turn = radius / 3 if width is None else width, along(axis)
    disc = Cylinder(radius, width, position=position, orientation=turn)
    spoke = Box((1.9 * radius, 0.08 * radius, 1.1 * width), position=position, orientation=turn, color=DARK)
    return disc, spoke


def ring(radius: float, width: float, position: VectorLike) -> tuple[AbstractShape, ...]:
    """A gear with internal teeth in the plane: a ring around its pitch circle, with a mark that shows how it turns."""
    angle = np.linspace(0.0, 2 * np.pi, 73)[:-1]
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x, y, _ = place = np.asarray(position, float)
    mark = Box((0.08 * radius, 0.08 * radius, 1.1 * width), position=(x + 1.04 * radius, y, 0.0), color=DARK)
    return Mesh.plate(1.08 * radius * circle, width, inner=radius * circle, position=place), mark


def marked_ball(radius: float, position: VectorLike = (0.0, 0.0, 0.0)) -> tuple[AbstractShape, ...]:
    """A ball with two bands around it that show how it turns."""
    band = lambda axis: Cylinder(1.005 * radius, 0.1 * radius, position=position, orientation=along(axis), color=DARK)
    return Sphere(radius, position=position), band((0.0, 0.0, 1.0)), band((1.0, 0.0, 0.0))


# Symbols of joints, scaled by the radius of a bar.


def pin(point: VectorLike, size: float, axis: VectorLike = (0.0, 0.0, 1.0)) -> Cylinder:
    """A hinge pin."""
    return Cylinder(0.8 * size, 3.2 * size, position=point, orientation=along(axis), color=DARK)


def ball(point: VectorLike, size: float) -> Sphere:
    """A ball joint."""
    return Sphere(1.6 * size, position=point, color=DARK)


def sleeve(point: VectorLike, size: float, axis: VectorLike) -> Box:
    """A block or bush that slides."""
    return Box((3.2 * size, 3.2 * size, 6.0 * size), position=point, orientation=along(axis), color=DARK)


_tell_of_moved(__name__, cylinder_between="jaxmb.shapes.Cylinder.between")
