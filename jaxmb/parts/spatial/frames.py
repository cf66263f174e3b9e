"""A frame fixed in a spatial body."""

import jax.numpy as jnp

from ...linalg.arrays import namespace
from ...linalg.rotations import multiply, rotate, unrotate
from .. import fields
from ..base import AbstractSpatialPart
from ..frames import AbstractFixedFrame


class Frame(AbstractSpatialPart, AbstractFixedFrame):
    """A frame fixed in a body, or in another frame.

    ```python
    crate = spatial.Body("crate", mass=3.0, inertia=spatial.box(3.0, 0.4, 0.2, 0.1))
    corner = spatial.Frame("corner", "crate", position=(0.2, 0.1, 0.05))
    pull = spatial.PointForce("pull", "corner", force=(0.0, 0.0, 40.0))
    system = jaxmb.Scene([crate], forces=[pull], frames=[corner]).compile()
    ```

    Joints, forces and contacts may name it in place of a body. Along a motion it has `position`, `velocity` and
    `acceleration` of its origin (world axes), and `orientation` (Euler parameters). In the frame's axes it has
    `angular_velocity` (a gyroscope's reading), `angular_acceleration`, and `specific_force` (an accelerometer's
    reading: acceleration less gravity [m/s²]).

    **Arguments:** `body`: the name of a body or frame; `position` [m], shape (3,), of its origin, and `orientation`,
    shape (4,), unit Euler parameters from its axes to the body's.
    """

    position: fields.Number = fields.point(body=0, default=(0.0, 0.0, 0.0), sizes=False)
    orientation: fields.Number = fields.attitude(default=(1.0, 0.0, 0.0, 0.0))

    def own_pose(self, space, pose):
        attitude = multiply(pose[3:7], self.orientation)
        return namespace(pose, attitude).concatenate([space.point(pose, self.position), attitude])

    def own_velocity(self, space, pose, velocity):
        turning = unrotate(self.orientation, velocity[3:])
        return jnp.concatenate([space.point_velocity(pose, velocity, self.position), turning])

    def own_wrench(self, space, pose, wrench):
        moment = rotate(self.orientation, wrench[3:])
        at_origin = space.point_force(pose, self.position, wrench[:3])
        return at_origin + jnp.concatenate([jnp.zeros_like(moment), moment])

    def own_point(self, point):
        return self.position + rotate(self.orientation, point)
