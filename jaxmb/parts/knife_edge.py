"""A blade that does not slip sideways."""

from typing import Any, ClassVar, cast

import numpy as np

from ..linalg.arrays import is_traced
from ..linalg.rotations import cross, dot
from . import fields
from .base import AbstractVelocityConstraint
from .shapes import Ground, along, sleeve
from .space import with_drift

# The sine of the angle between blade and normal below which the blade binds nothing.
_ALONG = 1e-6


class KnifeEdge(AbstractVelocityConstraint):
    """A blade, skate or wheel that does not slip sideways. Rows 1: `n·v = 0`, with the velocity v of the contact point
    and the normal n of the blade in the plane of motion. In space `n = e × h`, with the direction h of the blade and
    the plane's normal e.

    ```python
    sled = planar.Body("sled", mass=1.0, inertia=0.1, velocity=(1.0, 0.0))
    blade = planar.KnifeEdge("blade", "sled", point=(0.3, 0.0), axis=(1.0, 0.0))
    system = jaxmb.Scene([sled], joints=[blade]).compile()
    ```

    It has no coordinates. In space it does not hold the body on the plane; add a `spatial.Planar` or `PointOnPlane`
    joint.

    **Arguments:**

    - `name`, of the blade; `body`: the body that it is fixed in, or a frame in it, by name.
    - `point` [m]: the contact point fixed in the body, default the origin of its frame.
    - `axis`, unit: the direction of the blade fixed in the body, default its x axis.
    - `normal`, unit, shape (3,), in space: the normal of the plane in the world, default z.
    """

    name: str = fields.name()
    body: str = fields.body_name()
    point: fields.Number = fields.point(body=0, default="origin")
    axis: fields.Number = fields.axis(body=0, optional=True)
    normal: fields.Number = fields.axis(body=None, optional=True, dimension=3)
    rows: ClassVar[int] = 1
    linear: ClassVar[bool] = True
    homogeneous: ClassVar[bool] = True

    def complete(self, space, poses):
        axes = np.eye(space.dimension)
        part = self.filled(axis=axes[0])
        if space.dimension == 2:
            return part
        part = part.filled(normal=axes[2])
        if is_traced((part, poses)):
            return part
        pose, axis = (cast(Any, np.asarray(x)) for x in (poses[0], part.axis))
        ahead = space.direction(pose, axis)
        if np.linalg.norm(np.cross(np.asarray(part.normal), ahead)) < _ALONG:
            raise ValueError(
                f"{self.label}: the blade stands along the normal of its plane at the given pose, and binds nothing "
                "there; give another axis, normal or pose."
            )
        return part

    def residual(self, space, poses, velocities, t):
        ahead = space.direction(poses[0], self.axis)
        v = space.point_velocity(poses[0], velocities[0], self.point)
        v = with_drift(self, v, lambda part: space.point(poses[0], part.point))
        if space.dimension == 2:
            return (ahead[0] * v[1] - ahead[1] * v[0])[None]
        return dot(cross(self.normal, ahead), v)[None]

    def shapes(self, space, size):
        blade = (0, sleeve(space.in_space(self.point), size, space.in_space(self.axis)))
        return (blade,) if space.dimension == 2 else (blade, (None, Ground(orientation=along(self.normal))))
