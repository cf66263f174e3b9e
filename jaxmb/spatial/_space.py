"""Kinematics of a body in space."""

from typing import ClassVar

import jax.numpy as jnp

from .. import rotations as rot
from .._space import AbstractSpace


class SpatialSpace(AbstractSpace):
    """Poses (r, Euler parameters), velocities (ṙ in the world frame, angular velocity in the body frame)."""

    dimension: ClassVar[int] = 3
    pose_size: ClassVar[int] = 7
    velocity_size: ClassVar[int] = 6
    ground: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

    def point(self, pose, s):
        return pose[:3] + rot.rotate(pose[3:], s)

    def point_velocity(self, pose, velocity, s):
        return velocity[:3] + rot.rotate(pose[3:], rot.cross(velocity[3:], s))

    def point_force(self, pose, s, force_W):
        return jnp.concatenate([force_W, rot.cross(s, rot.unrotate(pose[3:], force_W))])

    def direction(self, pose, v):
        return rot.rotate(pose[3:], v)

    def body_point(self, pose, point_W):
        return rot.unrotate(pose[3:], point_W - pose[:3])

    def body_direction(self, pose, v_W):
        return rot.unrotate(pose[3:], v_W)

    def prepare(self, pose):
        return pose

    def rates(self, pose, velocity):
        return jnp.concatenate([velocity[:3], rot.rates(pose[3:], velocity[3:])])

    def pull_back(self, pose, gradient):
        return jnp.concatenate([gradient[:3], rot.pull_back(pose[3:], gradient[3:])])

    def normalize(self, pose):
        return jnp.concatenate([pose[:3], rot.normalize(pose[3:])])


SPACE = SpatialSpace()
