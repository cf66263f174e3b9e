"""A blade in the plane."""

from typing import ClassVar

from .. import fields
from ..base import AbstractPlanarPart, AbstractVelocityConstraint
from ..shapes import sleeve
from ..space import with_drift


class KnifeEdge(AbstractPlanarPart, AbstractVelocityConstraint):
    """A blade, skate or wheel that does not slip sideways. Rows 1: `n·v = 0`, v the velocity of the contact point, n
    the normal of the blade.

    ```python
    sled = planar.Body("sled", mass=1.0, inertia=0.1, velocity=(1.0, 0.0))
    blade = planar.KnifeEdge("blade", "sled", point=(0.3, 0.0), axis=(1.0, 0.0))
    system = jaxmb.Scene([sled], joints=[blade]).compile()
    ```

    It has no coordinates of its own.

    **Arguments:**

    - `name`, of the blade; `body`: that it is fixed in, or a frame in it, by name.
    - `point` [m], shape (2,): the contact point fixed in the body, default the origin of its frame.
    - `axis`, unit, shape (2,): the direction of the blade fixed in the body, default its x axis.
    """

    name: str = fields.name()
    body: str = fields.body_name()
    point: fields.Number = fields.point(body=0, default=(0.0, 0.0))
    axis: fields.Number = fields.axis(body=0, default=(1.0, 0.0))
    rows: ClassVar[int] = 1
    linear: ClassVar[bool] = True
    homogeneous: ClassVar[bool] = True

    def residual(self, space, poses, velocities, t):
        along = space.direction(poses[0], self.axis)
        v = space.point_velocity(poses[0], velocities[0], self.point)
        v = with_drift(self, v, lambda part: space.point(poses[0], part.point))
        return (along[0] * v[1] - along[1] * v[0])[None]

    def shapes(self, space, size):
        return ((0, sleeve(space.in_space(self.point), size, space.in_space(self.axis))),)
