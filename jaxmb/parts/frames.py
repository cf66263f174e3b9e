"""Named frames fixed in bodies, which parts may act on and whose motion may be observed."""

import abc
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from ..linalg.arrays import namespace
from . import fields
from .base import GROUND, AbstractBody, AbstractPart
from .names import unknown
from .space import AbstractSpace, Point, Pose, Velocity, Wrench


class AbstractFrame(AbstractPart):
    """A frame fixed in a body or in another frame; a scene fills in its `base`, the other frame, or None.

    A part that names a frame in place of a body sees the pose and the velocity of the frame. Points and axes given with
    the part are in the frame's axes, from its origin.
    """

    name: str = fields.name()
    body: str = fields.body_name()
    base: Any = fields.part(AbstractPart)

    @abc.abstractmethod
    def own_pose(self, space: AbstractSpace, pose: Pose) -> Pose:
        """The frame's pose from its base's, with or without prepared quantities."""

    @abc.abstractmethod
    def own_velocity(self, space: AbstractSpace, pose: Pose, velocity: Velocity) -> Velocity:
        """The frame's velocity from pose and velocity of its base."""

    @abc.abstractmethod
    def own_wrench(self, space: AbstractSpace, pose: Pose, wrench: Wrench) -> Wrench:
        """The wrench on the base that is equivalent to a wrench on the frame."""

    @abc.abstractmethod
    def own_point(self, point: Point) -> Point:
        """The point of the base [m] at a point of the frame."""

    @property
    def of_body(self) -> str:
        """The name of the body that the frame is fixed in."""
        return self.body if self.base is None else self.base.of_body

    # From the body itself.

    def pose(self, space: AbstractSpace, pose: Pose) -> Pose:
        """The frame's pose from the body's; with prepared quantities if the body's has them."""
        placed = self.own_pose(space, pose if self.base is None else self.base.pose(space, pose))
        return space.prepare(placed) if pose.shape[0] > placed.shape[0] else placed

    def velocity(self, space: AbstractSpace, pose: Pose, velocity: Velocity) -> Velocity:
        """The frame's velocity from pose and velocity of the body."""
        if self.base is not None:
            pose, velocity = self.base.pose(space, pose), self.base.velocity(space, pose, velocity)
        return self.own_velocity(space, pose, velocity)

    def wrench(self, space: AbstractSpace, pose: Pose, wrench: Wrench) -> Wrench:
        """The wrench on the body that is equivalent to a wrench on the frame."""
        if self.base is None:
            return self.own_wrench(space, pose, wrench)
        return self.base.wrench(space, pose, self.own_wrench(space, self.base.pose(space, pose), wrench))

    def wrench_on_frame(self, space: AbstractSpace, pose: Pose, wrench: Wrench) -> Wrench:
        """The wrench on the frame that is equivalent to a wrench on the body."""
        if self.base is not None:
            pose, wrench = self.base.pose(space, pose), self.base.wrench_on_frame(space, pose, wrench)
        d = space.dimension
        at_origin = space.point_force(pose, self.own_point(jnp.zeros(d, wrench.dtype)), wrench[:d])
        # Moments transform like angular velocities.
        moment = jnp.concatenate([jnp.zeros_like(wrench[:d]), wrench[d:] - at_origin[d:]])
        return jnp.concatenate([wrench[:d], self.own_velocity(space, pose, moment)[d:]])

    def point(self, point: Point) -> Point:
        """The point of the body [m] at a point of the frame."""
        in_base = self.own_point(point)
        return in_base if self.base is None else self.base.point(in_base)


class LinkFrame(AbstractFrame):
    """The frame of a body whose mass centre is not its origin.

    **Arguments:** `centre` [m]: the mass centre in the frame, whose axes are the body's.
    """

    centre: fields.Number = fields.parameter(shape=("d",), unit="m")

    def own_pose(self, space, pose):
        # Prepared quantities belong to the attitude, which is the body's.
        xp = namespace(pose, self.centre)
        return xp.concatenate([space.point(pose, -self.centre), pose[space.dimension :]])

    def own_velocity(self, space, pose, velocity):
        d = space.dimension
        return jnp.concatenate([space.point_velocity(pose, velocity, -self.centre), velocity[d:]])

    def own_wrench(self, space, pose, wrench):
        d = space.dimension
        moment = jnp.concatenate([jnp.zeros_like(wrench[:d]), wrench[d:]])
        return space.point_force(pose, -self.centre, wrench[:d]) + moment

    def own_point(self, point):
        return point - self.centre


def frames_by_name(frames: Sequence[AbstractFrame], bodies: Sequence[AbstractBody]) -> dict[str, AbstractFrame]:
    """Checked frames with their bases, by name; each body whose mass centre is not its origin has a frame under its own
    name.

    **Raises:** `ValueError` for frames on unknown bodies, and frames that are fixed in themselves.
    """
    given, bodies_by_name = {frame.name: frame for frame in frames}, {body.name: body for body in bodies}
    out: dict[str, Any] = {
        name: LinkFrame(name=name, body=name, centre=centre)
        for name, body in bodies_by_name.items()
        if (centre := body.mass_centre) is not None
    }

    def based(name, path):
        if name in out or name not in given:
            return
        frame = given[name]
        if name in path:
            raise ValueError(f"{frame.label} is fixed in itself, by way of {', '.join(map(repr, path))}.")
        if frame.body not in (*given, *bodies_by_name, GROUND):
            raise unknown("body", frame.body, [*bodies_by_name, GROUND, *given], frame.label)
        based(frame.body, (*path, name))
        frame.check(bodies[0].dimension)
        out[name] = frame.with_fields(base=out.get(frame.body))

    for name in given:
        based(name, ())
    return out
