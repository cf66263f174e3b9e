"""The elementary constraints that joints in space consist of: points that coincide, and products of two vectors.

A joint that declares them as its property `elements` has its rows computed together with those of all other such
joints, whatever their types, in a few small kernels. The declared rows and the `residual` of the joint vanish together,
and have the same derivatives where they do.

```python
class Hinge(jaxmb.spatial.AbstractJoint):  # A point and two directions; compare jaxmb.spatial.Revolute.
    axis_a: jaxmb.parts.Number = jaxmb.parts.axis(body=0)
    axis_b: jaxmb.parts.Number = jaxmb.parts.axis(body=1)

    @property
    def elements(self):
        u, v = perpendiculars(self.axis_a)
        return coincident(self), perpendicular(u, self.axis_b), perpendicular(v, self.axis_b)
```

Source: E. J. Haug, "Computer Aided Kinematics and Dynamics of Mechanical Systems", Allyn and Bacon 1989, chapter 9;
P. E. Nikravesh, "Computer-Aided Analysis of Mechanical Systems", Prentice-Hall 1988, chapter 7.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ...linalg.rotations import rotation_matrix
from .axes import Vector3, perpendiculars


class Coincident(NamedTuple):
    """`d = 0`, three rows: the vector d from `point_a`, fixed in A, to `point_b`, fixed in B [m]."""

    point_a: Any
    point_b: Any


class Product(NamedTuple):
    """`X · Y = 0`, one row.

    **Fields:** `x_a`: X, fixed in A; None for X = Y / length. `y_b`: Y, fixed in B; or, with `y_a`, the vector from the
    point `y_a` of A to the point `y_b` of B [m]. `length` [m]: the row is `(Y · Y / length − length) / 2`.
    """

    x_a: Any
    y_b: Any
    y_a: Any = None
    length: Any = None


Element: TypeAlias = Coincident | Product
# The number of rows of each kind of element.
ROWS: dict[type, int] = {Coincident: 3, Product: 1}


def coincident(part: Any) -> Coincident:
    """Points A and B of a part coincide."""
    return Coincident(part.point_a, part.point_b)


def perpendicular(x_a: Vector3, y_b: Vector3) -> Product:
    """A direction fixed in A and one fixed in B are perpendicular."""
    return Product(x_a, y_b)


def in_planes(part: Any, normals: Iterable[Vector3]) -> tuple[Product, ...]:
    """Point B of a part stays in planes fixed in A, through point A, with these normals."""
    return tuple(Product(x, part.point_b, part.point_a) for x in normals)


def apart(part: Any) -> Product:
    """Points A and B of a part keep the distance `part.length`."""
    return Product(None, part.point_b, part.point_a, part.length)


def parallel(part: Any) -> tuple[Product, ...]:
    """The axes of a part in A and in B are parallel."""
    return tuple(perpendicular(x, part.axis_b) for x in perpendiculars(part.axis_a))


def aligned(part: Any) -> tuple[Product, ...]:
    """The relative attitude is `part.orientation`."""
    in_a = rotation_matrix(part.orientation).T
    unit = np.eye(3, dtype=in_a.dtype)
    # Their rates are the components of the angular velocity of B in A along its axes.
    return tuple(perpendicular(in_a[k], unit[j]) for k, j in ((2, 1), (0, 2), (1, 0)))


def on_bodies(part: Any, space: Any, elements: Iterable[Element]) -> tuple[Element, ...]:
    """Elements in the axes of the bodies, from those in the frames that the part names in their place."""
    frames = part.body_frames
    if not frames:
        return tuple(elements)
    poses = [frames[k].pose(space, np.array(space.ground)) if k in frames else None for k in ("0", "1")]
    point = lambda k, s: s if poses[k] is None else space.point(poses[k], s)
    direction = lambda k, v: v if v is None or poses[k] is None else space.direction(poses[k], v)

    def moved(element: Element) -> Element:
        if isinstance(element, Coincident):
            return Coincident(point(0, element.point_a), point(1, element.point_b))
        x_a, y_b, y_a, length = element
        if y_a is None:
            return Product(direction(0, x_a), direction(1, y_b))
        return Product(direction(0, x_a), point(1, y_b), point(0, y_a), length)

    return tuple(map(moved, elements))
