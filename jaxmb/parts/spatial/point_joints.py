"""Spatial joints that bind points of two bodies and leave their attitudes free; for notation see `joints`."""

from typing import ClassVar

from ...linalg.rotations import dot
from ..base import AbstractAxisJoint, AbstractSpatialPart, PathKind, Quantities
from ..elements import in_planes
from ..shapes import ball
from .axes import across, displacement_along, offset_in_a, perpendiculars


class PointOnPlane(AbstractSpatialPart, AbstractAxisJoint):
    """Point B stays in the plane fixed in `body_a` through point A, normal to the axis. Rows 1: the component along the
    axis of d from A to B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    table = spatial.PointOnPlane("table", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    system = jaxmb.Scene([arm], joints=[table]).compile()
    ```

    It has no coordinates.
    """

    rows: ClassVar[int] = 1

    @property
    def elements(self):
        return in_planes(self, [self.axis_a])

    def residual(self, space, poses, t):
        return dot(self.axis_a, offset_in_a(space, self, poses))[None]


class PointOnLine(AbstractSpatialPart, AbstractAxisJoint):
    """A ball in a straight slot: point B stays on the line through A along the axis. Rows 2: the components across the
    axis of d from A to B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    slot = spatial.PointOnLine("slot", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0))
    system = jaxmb.Scene([arm], joints=[slot]).compile()
    ```

    Its coordinate is `displacement` [m], from A to B along the slot, zero at the given poses if a world `point` gives
    both.
    """

    rows: ClassVar[int] = 2
    quantities: ClassVar[Quantities] = {"displacement": "length"}
    path_kind: ClassVar[PathKind] = "rod"

    @property
    def elements(self):
        return in_planes(self, perpendiculars(self.axis_a))

    def residual(self, space, poses, t):
        return across(self.axis_a, offset_in_a(space, self, poses))

    def coordinates(self, space, poses):
        return {"displacement": displacement_along(space, self, poses)}

    def shapes(self, space, size):
        return ((1, ball(self.point_b, size)),)
