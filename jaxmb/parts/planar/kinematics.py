"""Kinematics of a body in the plane."""

from typing import ClassVar

import jax.numpy as jnp

from ...linalg.arrays import namespace
from ..space import AbstractSpace


class PlanarSpace(AbstractSpace):
    """Poses (x, y, angle), velocities (ẋ, ẏ, angular rate); y is up, angles counter-clockwise.

    A prepared pose carries cosine and sine of its angle as well, (x, y, angle, cos, sin).
    """

    dimension: ClassVar[int] = 2
    pose_size: ClassVar[int] = 3
    velocity_size: ClassVar[int] = 3
    ground: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0)

    def point(self, pose, s):
        return pose[:2] + _turned(pose, s)

    def point_velocity(self, pose, velocity, s):
        return velocity[:2] + velocity[2:3] * _quarter_turn(_turned(pose, s))

    def point_force(self, pose, s, force_W):
        return self._wrench(_turned(pose, s), force_W)

    def _wrench(self, arm, force_W):
        return jnp.concatenate([force_W, (arm[0] * force_W[1] - arm[1] * force_W[0])[None]])

    def force_at(self, pose, point_W, force_W):
        return self._wrench(point_W - pose[:2], force_W)

    def turning(self, pose, velocity):
        return velocity[2:]

    def swept(self, omega, arm):
        return omega * _quarter_turn(arm)

    def moment(self, pose, moment_W):
        return jnp.concatenate([jnp.zeros(2, moment_W.dtype), moment_W])

    def direction(self, pose, v):
        return _turned(pose, v)

    def body_point(self, pose, point_W):
        return _turned_back(pose, point_W - pose[:2])

    def body_direction(self, pose, v_W):
        return _turned_back(pose, v_W)

    def displaced(self, pose, origin, turn):
        xp = namespace(pose, origin, turn)
        return xp.concatenate([self.point(pose, origin), pose[2:3] + 2 * xp.arctan(turn / 2)])

    def prepare(self, pose):
        xp = namespace(pose)
        return xp.concatenate([pose, xp.cos(pose[2:3]), xp.sin(pose[2:3])])

    def rates(self, pose, velocity):
        if not _prepared(pose):
            return velocity
        return jnp.concatenate([velocity, velocity[2] * jnp.stack([-pose[4], pose[3]])])

    def moves(self, pose):
        zero, one = jnp.zeros_like(pose[:1]), jnp.ones_like(pose[:1])
        turned = jnp.concatenate([zero, zero, one, -pose[4:5], pose[3:4]])
        return jnp.concatenate([jnp.eye(2, 5, dtype=pose.dtype), turned[None]])

    def coordinate_moves(self, pose):
        return self.moves(pose)

    def pull_back(self, pose, gradient):
        if not _prepared(pose):
            return gradient
        turning = gradient[2] - gradient[3] * pose[4] + gradient[4] * pose[3]
        return jnp.concatenate([gradient[:2], turning[None]])

    def point_gradient(self, s, weights):
        turned = jnp.stack([jnp.dot(weights, s), jnp.dot(weights, _quarter_turn(s))])
        return jnp.concatenate([weights, jnp.zeros(1, weights.dtype), turned])

    def normalize(self, pose):
        return pose

    def placement(self, pose):
        xp, half = namespace(pose), 0.5 * pose[2]
        turn = xp.stack([xp.cos(half), xp.zeros_like(half), xp.zeros_like(half), xp.sin(half)])
        return self.in_space(pose[:2]), turn


def _prepared(pose):
    return pose.shape[0] == 5


def _cos_sin(pose):
    """Cosine and sine of the angle, each as an array of one element, which saves a reshape."""
    if _prepared(pose):
        return pose[3:4], pose[4:5]
    xp, angle = namespace(pose), pose[2:3]
    return xp.cos(angle), xp.sin(angle)


def _turned(pose, v):
    c, s = _cos_sin(pose)
    return c * v + s * _quarter_turn(v)


def _turned_back(pose, v):
    c, s = _cos_sin(pose)
    return c * v - s * _quarter_turn(v)


def _quarter_turn(v):
    """Counter-clockwise."""
    # Not by v[::-1]: XLA simplifies reversals of a constant one by one, each in a pass over the whole program.
    return namespace(v).concatenate([-v[1:], v[:1]])


PLANE = PlanarSpace()
