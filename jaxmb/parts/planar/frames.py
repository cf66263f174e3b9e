"""A frame fixed in a planar body."""

import jax.numpy as jnp

from ...linalg.arrays import namespace
from ...linalg.rotations import rotate_2d
from .. import fields
from ..base import AbstractPlanarPart
from ..frames import AbstractFixedFrame


class Frame(AbstractPlanarPart, AbstractFixedFrame):
    """A frame fixed in a body, or in another frame.

    ```python
    tip = planar.Frame("tip", "bar", position=(0.5, 0.0))
    pull = planar.PointForce("pull", "tip", force=(0.0, 5.0))
    system = jaxmb.Scene([bar], joints=[pin], forces=[pull], frames=[tip]).compile()
    ```

    Joints, forces and contacts may name it in place of a body. Along a motion it has `position`, `velocity` and
    `acceleration` of its origin (world axes), `angle`, `angular_velocity`, `angular_acceleration`, and
    `specific_force`, the reading of an accelerometer: acceleration less gravity, in the frame's axes [m/s²].

    **Arguments:** `body`: the name of a body or frame; `position` [m], shape (2,), of its origin, and `angle` [rad], of
    its axes, in the body's frame.
    """

    position: fields.Number = fields.point(body=0, default=(0.0, 0.0), sizes=False)
    angle: fields.Number = fields.parameter(unit="rad", default=0.0)

    def own_pose(self, space, pose):
        angle = (pose[2] + self.angle)[None]
        return namespace(pose, angle).concatenate([space.point(pose, self.position), angle])

    def own_velocity(self, space, pose, velocity):
        return jnp.concatenate([space.point_velocity(pose, velocity, self.position), velocity[2:]])

    def own_wrench(self, space, pose, wrench):
        at_origin = space.point_force(pose, self.position, wrench[:2])
        return at_origin + jnp.concatenate([jnp.zeros_like(wrench[:2]), wrench[2:]])

    def own_point(self, point):
        return self.position + rotate_2d(self.angle, point)
