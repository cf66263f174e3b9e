"""Spatial joints that bind points of two bodies and leave their attitudes free; for notation see `joints`."""

from typing import ClassVar

from ...linalg.rotations import dot, norm
from .. import fields
from ..base import AbstractConstraint, AbstractJoint, AbstractPair, AbstractSpatialPart, Quantities
from ..elements import apart, in_planes
from ..shapes import ball
from ..space import both_points, separation
from .axes import across, displacement_along, offset_in_a, perpendiculars


class Distance(AbstractSpatialPart, AbstractPair, AbstractConstraint):
    """A massless rod: points A and B of two bodies keep their distance. Rows 1: `(d·d − length²) / (2 length) = 0`,
    with d from A to B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    rod = spatial.Distance("rod", "ground", "arm", point_b=(-0.4, 0.0, 0.0))
    system = jaxmb.Scene([arm], joints=[rod]).compile()
    ```

    The multiplier is the rod force [N]. It has no coordinates of its own.

    **Arguments:**

    - `name`, of the joint; `body_a`, `body_b`: the bodies that it connects, or frames in them, by name. Either may be
        `"ground"`.
    - `point_a`, `point_b` [m], shape (3,): A fixed in `body_a`, B fixed in `body_b`, default the origins of the frames.
    - `length` [m] > 0, default that of the given poses.
    """

    point_a: fields.Number = fields.point(body=0, default=(0.0, 0.0, 0.0))
    point_b: fields.Number = fields.point(body=1, default=(0.0, 0.0, 0.0))
    length: fields.Number = fields.length(sign="positive", optional=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    def complete(self, space, poses):
        return self.filled(length=norm(separation(space, self, poses)))

    @property
    def elements(self):
        return (apart(self),)

    def residual(self, space, poses, t):
        d = separation(space, self, poses)
        return ((dot(d, d) - self.length**2) / (2 * self.length))[None]

    def path(self, space, poses):
        return both_points(space, self, poses)


class PointOnPlane(AbstractSpatialPart, AbstractJoint):
    """Point B of a body stays in a plane fixed in A, through A normal to the axis. Rows 1: the component along the axis
    of d from A to B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    table = spatial.PointOnPlane("table", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    system = jaxmb.Scene([arm], joints=[table]).compile()
    ```

    It has no coordinates of its own.

    **Arguments:**

    - `name`, of the joint; `body_a`, `body_b`: the bodies that it connects, or frames in them, by name. Either may be
        `"ground"`.
    - `point_a`, `point_b` [m], shape (3,): A fixed in `body_a`, B fixed in `body_b`; or `point` [m], shape (3,): both,
        at this place of the world at the given poses.
    - `axis_a`, unit, shape (3,): the normal of the plane fixed in `body_a`; or `axis`, unit, shape (3,): that in the
        world at the given poses.
    """

    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",))
    rows: ClassVar[int] = 1

    @property
    def elements(self):
        return in_planes(self, [self.axis_a])

    def residual(self, space, poses, t):
        return dot(self.axis_a, offset_in_a(space, self, poses))[None]


class PointOnLine(AbstractSpatialPart, AbstractJoint):
    """A ball in a straight slot: point B stays on the line through A along the axis. Rows 2: the components across the
    axis of d from A to B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    slot = spatial.PointOnLine("slot", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0))
    system = jaxmb.Scene([arm], joints=[slot]).compile()
    ```

    Its coordinate is `displacement` [m], how far B is from A along the slot: zero where they coincide, so at the given
    poses if both are given by a world `point`.

    **Arguments:**

    - `name`, of the joint; `body_a`, `body_b`: the bodies that it connects, or frames in them, by name. Either may be
        `"ground"`.
    - `point_a`, `point_b` [m], shape (3,): A fixed in `body_a`, B fixed in `body_b`; or `point` [m], shape (3,): both,
        at this place of the world at the given poses.
    - `axis_a`, unit, shape (3,): the direction of the slot fixed in `body_a`; or `axis`, unit, shape (3,): that in the
        world at the given poses.
    """

    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",))
    rows: ClassVar[int] = 2
    quantities: ClassVar[Quantities] = {"displacement": "length"}

    @property
    def elements(self):
        return in_planes(self, perpendiculars(self.axis_a))

    def residual(self, space, poses, t):
        return across(self.axis_a, offset_in_a(space, self, poses))

    def coordinates(self, space, poses):
        return {"displacement": displacement_along(space, self, poses)}

    def path(self, space, poses):
        return both_points(space, self, poses)

    def shapes(self, space, size):
        return ((1, ball(self.point_b, size)),)
