"""The elementary constraints that joints consist of: points that coincide, and products of two vectors.

The rows of all joints that declare them as their property `elements` are computed together in a few small kernels,
whatever the joints' types. The declared rows and the joint's `residual` vanish together, and have the same derivatives
there; `jaxmb.report.check_elements` compares them.

Source: E. J. Haug, "Computer Aided Kinematics and Dynamics of Mechanical Systems", Allyn and Bacon 1989, chapter 9;
P. E. Nikravesh, "Computer-Aided Analysis of Mechanical Systems", Prentice-Hall 1988, chapter 7.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, Self, TypeAlias


class Coincident(NamedTuple):
    """`d = 0`, a row for each dimension: the vector d from `point_a`, fixed in A, to `point_b`, fixed in B [m]."""

    point_a: Any
    point_b: Any
    coincide = True

    def rows(self, dimension: int) -> int:
        return dimension

    def moved(self, point: Callable[[int, Any], Any], direction: Callable[[int, Any], Any]) -> Self:
        """The same element in other axes: `point(k, s)` and `direction(k, v)` convert to the axes of body k."""
        del direction
        return type(self)(point(0, self.point_a), point(1, self.point_b))


class Product(NamedTuple):
    """`X · Y = 0`, one row.

    **Fields:** `x_a`: X, fixed in A; None for X = Y / length. `y_b`: Y, fixed in B; or, with `y_a`, the vector from the
    point `y_a` of A to the point `y_b` of B [m]. `length` [m]: the row is `(Y · Y / length − length) / 2`. `along_a`
    and `along_b`, fixed in A and in B: directions with a positive product, if the row alone also holds half a turn
    away.
    """

    x_a: Any
    y_b: Any
    y_a: Any = None
    length: Any = None
    along_a: Any = None
    along_b: Any = None
    coincide = False

    def rows(self, dimension: int) -> int:
        del dimension
        return 1

    def moved(self, point: Callable[[int, Any], Any], direction: Callable[[int, Any], Any]) -> Self:
        """As in `Coincident`."""
        x_a, y_b, y_a, length, *along = self
        if y_a is None:
            return type(self)(direction(0, x_a), direction(1, y_b), None, None, *map(direction, (0, 1), along))
        return type(self)(direction(0, x_a), point(1, y_b), point(0, y_a), length)


Element: TypeAlias = Coincident | Product


def coincident(part: Any) -> Coincident:
    """Points A and B of a part coincide.

    ```python
    class Slide(jaxmb.parts.AbstractPlanarPart, jaxmb.parts.AbstractJoint):  # As planar.Prismatic, along x of both.
        rows = 2

        def residual(self, space, poses, t):
            d = space.body_point(poses[0], space.point(poses[1], self.point_b)) - self.point_a
            return jnp.array([d[1], poses[1, 2] - poses[0, 2]])

        @property
        def elements(self):
            x, y = np.eye(2)
            return *jaxmb.parts.in_planes(self, [y]), jaxmb.parts.perpendicular(y, x, (x, x))

    slide = Slide("slide", "ground", "bar", point=(0.0, 0.0))
    system = jaxmb.Scene([bar], joints=[slide]).compile()
    jaxmb.report.check_elements(system, jaxmb.assemble(system, rates={"bar.x": 1.0}))
    rod = planar.Distance("rod", "ground", "bar", point_b=(-0.1, 0.0))
    jaxmb.parts.coincident(slide), jaxmb.parts.apart(rod)  # The elements of planar.Revolute and of the rod.
    ```
    """
    return Coincident(part.point_a, part.point_b)


def perpendicular(x_a: Any, y_b: Any, along: tuple[Any, Any] = (None, None)) -> Product:
    """A direction fixed in A and a direction fixed in B are perpendicular; the two directions `along` have a positive
    product.

    **Arguments:** `along`: needed if the joint's residual, unlike this row, does not vanish half a turn away.
    """
    return Product(x_a, y_b, along_a=along[0], along_b=along[1])


def in_planes(part: Any, normals: Iterable[Any]) -> tuple[Product, ...]:
    """Point B of a part stays in planes (lines in planar scenes) with these normals, fixed in A and through point A."""
    return tuple(Product(x, part.point_b, part.point_a) for x in normals)


def apart(part: Any) -> Product:
    """Points A and B of a part keep the distance `part.length`."""
    return Product(None, part.point_b, part.point_a, part.length)


def on_bodies(part: Any, space: Any, elements: Iterable[Element]) -> tuple[Element, ...]:
    """Elements in the axes of the bodies, from elements in the frames that the part names in their place."""
    frames = part.body_frames
    if not frames:
        return tuple(elements)
    poses = [frames[k].pose_in_body(space) if k in frames else None for k in ("0", "1")]
    point = lambda k, s: s if poses[k] is None else space.point(poses[k], s)
    direction = lambda k, v: v if v is None or poses[k] is None else space.direction(poses[k], v)

    return tuple(element.moved(point, direction) for element in elements)
