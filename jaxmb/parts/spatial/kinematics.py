"""Kinematics of a body in space."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from ...linalg import rotations as rot
from ...linalg.arrays import namespace
from ...linalg.sums import unchecked_take
from ..space import AbstractSpace


def _places_of_moves():
    """The indices of the rates of a prepared pose along unit velocities: each rate is 0, 1, half an Euler parameter, an
    entry of the matrix, or the negative of these.
    """
    stored = {"half": 2, "matrix": 10}
    place = np.zeros((6, 16), int)
    place[np.arange(3), np.arange(3)] = 1
    for k in range(3):
        unit = np.eye(3)[k]
        for j in range(4):
            changed = 2 * rot.rates(np.eye(4)[j], unit)
            for i in np.flatnonzero(changed):
                place[3 + k, 3 + i] = stored["half"] + j + (0 if changed[i] > 0 else 4)
        for j in range(9):
            changed = rot.matrix_rates(np.eye(9)[j].reshape(3, 3), unit).reshape(-1)
            for i in np.flatnonzero(changed):
                place[3 + k, 7 + i] = stored["matrix"] + j + (0 if changed[i] > 0 else 9)
    return place


def _places_of_coordinate_moves():
    """The indices of the rates of a prepared pose along unit rates of its coordinates: each rate is 0, 1, twice an
    Euler parameter, or the negative of this.
    """
    place = np.zeros((7, 16), int)
    place[np.arange(7), np.arange(7)] = 1
    units = np.eye(4)
    for k in range(4):
        for j in range(4):
            # The matrix is a quadratic form of the parameters.
            both = rot.rotation_matrix(units[j] + units[k])
            changed = (both - rot.rotation_matrix(units[j]) - rot.rotation_matrix(units[k])).reshape(-1)
            for i in np.flatnonzero(changed):
                place[3 + k, 7 + i] = 2 + j + (0 if changed[i] > 0 else 4)
    return place


_MOVES, _COORDINATE_MOVES = _places_of_moves(), _places_of_coordinate_moves()


class SpatialSpace(AbstractSpace):
    """Poses (r, Euler parameters), velocities (ṙ in the world frame, angular velocity in the body frame).

    A prepared pose carries its rotation matrix as well, (r, Euler parameters, matrix row by row).
    """

    dimension: ClassVar[int] = 3
    pose_size: ClassVar[int] = 7
    velocity_size: ClassVar[int] = 6
    ground: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

    def point(self, pose, s):
        return pose[:3] + _turned(pose, s)

    def point_velocity(self, pose, velocity, s):
        return velocity[:3] + _turned(pose, rot.cross(velocity[3:], s))

    def point_force(self, pose, s, force_W):
        return jnp.concatenate([force_W, rot.cross(s, _turned_back(pose, force_W))])

    def force_at(self, pose, point_W, force_W):
        return jnp.concatenate([force_W, _turned_back(pose, rot.cross(point_W - pose[:3], force_W))])

    def turning(self, pose, velocity):
        return _turned(pose, velocity[3:])

    def swept(self, omega, arm):
        return rot.cross(omega, arm)

    def moment(self, pose, moment_W):
        return jnp.concatenate([jnp.zeros_like(moment_W), _turned_back(pose, moment_W)])

    def direction(self, pose, v):
        return _turned(pose, v)

    def body_point(self, pose, point_W):
        return _turned_back(pose, point_W - pose[:3])

    def body_direction(self, pose, v_W):
        return _turned_back(pose, v_W)

    def displaced(self, pose, origin, turn):
        xp = namespace(pose, origin, turn)
        turned = rot.normalize(xp.concatenate([xp.ones_like(turn[:1]), turn / 2]))
        return xp.concatenate([self.point(pose, origin), rot.multiply(pose[3:7], turned)])

    def prepare(self, pose):
        return namespace(pose).concatenate([pose, rot.rotation_matrix(pose[3:]).reshape(-1)])

    def rates(self, pose, velocity):
        rates = jnp.concatenate([velocity[:3], rot.rates(pose[3:7], velocity[3:])])
        if not _prepared(pose):
            return rates
        return jnp.concatenate([rates, rot.matrix_rates(_matrix(pose), velocity[3:]).reshape(-1)])

    def moves(self, pose):
        half, matrix = 0.5 * pose[3:7], pose[7:]
        zero, one = jnp.zeros_like(pose[:1]), jnp.ones_like(pose[:1])
        return unchecked_take(jnp.concatenate([zero, one, half, -half, matrix, -matrix]), _MOVES)

    def coordinate_moves(self, pose):
        twice = 2.0 * pose[3:7]
        zero, one = jnp.zeros_like(pose[:1]), jnp.ones_like(pose[:1])
        return unchecked_take(jnp.concatenate([zero, one, twice, -twice]), _COORDINATE_MOVES)

    def pull_back(self, pose, gradient):
        moment = rot.pull_back(pose[3:7], gradient[3:7])
        if _prepared(pose):
            moment = moment + rot.pull_back_matrix(_matrix(pose), gradient[7:].reshape(3, 3))
        return jnp.concatenate([gradient[:3], moment])

    def point_gradient(self, s, weights):
        return jnp.concatenate([weights, jnp.zeros(4, weights.dtype), jnp.outer(weights, s).reshape(-1)])

    def normalize(self, pose):
        return jnp.concatenate([pose[:3], rot.normalize(pose[3:])])

    def placement(self, pose):
        return pose[:3], pose[3:7]


def _prepared(pose):
    return pose.shape[0] == 16


def _matrix(pose):
    return pose[7:].reshape(3, 3) if _prepared(pose) else rot.rotation_matrix(pose[3:])


def _turned(pose, v):
    return rot.turned(_matrix(pose), v)


def _turned_back(pose, v):
    return rot.turned_back(_matrix(pose), v)


SPACE = SpatialSpace()
