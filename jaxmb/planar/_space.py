"""Kinematics of a body in the plane."""

from typing import ClassVar

import jax.numpy as jnp

from .._space import AbstractSpace
from ..rotations import rotate_2d


class PlanarSpace(AbstractSpace):
    """Poses (x, y, angle), velocities (ẋ, ẏ, angular rate); y is up, angles counter-clockwise."""

    dimension: ClassVar[int] = 2
    pose_size: ClassVar[int] = 3
    velocity_size: ClassVar[int] = 3
    ground: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0)

    def point(self, pose, s):
        return pose[:2] + rotate_2d(pose[2], s)

    def point_velocity(self, pose, velocity, s):
        arm = rotate_2d(pose[2], s)
        return velocity[:2] + velocity[2] * jnp.stack([-arm[1], arm[0]])

    def point_force(self, pose, s, force_W):
        arm = rotate_2d(pose[2], s)
        return jnp.concatenate([force_W, (arm[0] * force_W[1] - arm[1] * force_W[0])[None]])

    def direction(self, pose, v):
        return rotate_2d(pose[2], v)

    def body_point(self, pose, point_W):
        return rotate_2d(-pose[2], point_W - pose[:2])

    def body_direction(self, pose, v_W):
        return rotate_2d(-pose[2], v_W)

    def rates(self, pose, velocity):
        del pose
        return velocity

    def pull_back(self, pose, gradient):
        del pose
        return gradient

    def normalize(self, pose):
        return pose


PLANE = PlanarSpace()
