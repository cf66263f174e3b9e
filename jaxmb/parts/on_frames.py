"""Parts that act on frames instead of bodies: their kernels see the poses of the frames."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from ..linalg.arrays import namespace
from . import fields
from .base import (
    AbstractConstraint,
    AbstractDynamicForce,
    AbstractForce,
    AbstractLink,
    AbstractNonIdeal,
    AbstractPart,
    AbstractPotentialForce,
    AbstractTendon,
    AbstractVelocityConstraint,
)
from .frames import AbstractFrame
from .space import AbstractSpace


def framed(space: AbstractSpace, frames: tuple[AbstractFrame | None, ...], poses: Any) -> Any:
    """Poses of frames from those of their bodies, shape (k, p); unchanged where there is no frame."""
    own = [pose if frame is None else frame.pose(space, pose) for frame, pose in zip(frames, poses, strict=True)]
    return namespace(*own).stack(own)


def on_frames(part: AbstractLink, frames: tuple[AbstractFrame | None, ...]) -> AbstractLink:
    """A part with every number filled in, on the frames of its bodies, if there are any."""
    given = {str(k): frame for k, frame in enumerate(frames) if frame is not None}
    if not given:
        return part
    return part.wrapped(lambda own: _on(own, given))


def _on(part: AbstractLink, frames: dict[str, AbstractFrame]) -> AbstractLink:
    if isinstance(part, AbstractConstraint):
        return ConstraintOnFrames(part=part, frames=frames)
    if isinstance(part, AbstractVelocityConstraint):
        return VelocityConstraintOnFrames(part=part, frames=frames)
    if isinstance(part, AbstractDynamicForce):
        return DynamicForceOnFrames(part=part, frames=frames)
    if isinstance(part, AbstractForce):
        return ForceOnFrames(part=part, frames=frames)
    if isinstance(part, AbstractTendon):
        return TendonOnFrames(part=part, frames=frames)
    raise ValueError(f"{part.label} has friction of its own parts and cannot be on frames; name its bodies.")


def law_on_frames(law: AbstractNonIdeal, frames: tuple[AbstractFrame | None, ...]) -> AbstractNonIdeal:
    """A law of a joint with every number filled in, on the frames of the joint's bodies, if there are any."""
    given = {str(k): frame for k, frame in enumerate(frames) if frame is not None}
    return NonIdealOnFrames(part=law, frames=given) if given else law


class AbstractFramedPart(AbstractPart):
    """A `part` on `frames`, by the number of the body."""

    part: Any = fields.part(AbstractPart)
    frames: Any = fields.parts()

    @property
    def name(self):
        return self.part.name

    @property
    def dimensions(self):
        return self.part.dimensions

    @property
    def kind(self):
        return self.part.kind

    @property
    def label(self):
        return self.part.label

    def check(self, dimension=None):
        self.part.check(dimension)

    def named(self, name):
        return self.with_fields(part=self.part.named(name))

    def _poses(self, space, poses):
        rows = [self.frames[str(k)].pose(space, x) if str(k) in self.frames else x for k, x in enumerate(poses)]
        return jnp.stack(rows)

    def _velocities(self, space, poses, velocities):
        own = lambda k, x, v: self.frames[str(k)].velocity(space, x, v) if str(k) in self.frames else v
        return jnp.stack([own(k, x, v) for k, (x, v) in enumerate(zip(poses, velocities, strict=True))])

    def _to_bodies(self, space, poses, wrenches):
        to_body = lambda k, x, w: self.frames[str(k)].wrench(space, x, w) if str(k) in self.frames else w
        return jnp.stack([to_body(k, x, w) for k, (x, w) in enumerate(zip(poses, wrenches, strict=True))])


class AbstractOnFrames(AbstractFramedPart, AbstractLink):
    """A link on frames."""

    @property
    def bodies(self):
        return self.part.bodies

    def anchor(self, k):
        point, frame = self.part.anchor(k), self.frames.get(str(k))
        return point if frame is None or point is None else frame.point(point)

    def pictured(self, space):
        return self.with_fields(part=self.part.pictured(space))

    @property
    def path_kind(self):
        return self.part.path_kind

    def path(self, space, poses):
        return self.part.path(space, self._poses(space, poses))

    def shapes(self, space, size):
        rest = np.asarray(space.ground)
        moved = lambda k, shape: shape.moved(*space.placement(self.frames[str(k)].pose(space, rest)))
        return tuple(
            (k, moved(k, shape) if str(k) in self.frames else shape) for k, shape in self.part.shapes(space, size)
        )


class ConstraintOnFrames(AbstractOnFrames, AbstractConstraint):
    """A position constraint on frames."""

    @property
    def rows(self):
        return self.part.rows

    @property
    def rheonomic(self):
        return self.part.rheonomic

    @property
    def angles(self):
        return self.part.angles

    def residual(self, space, poses, t):
        return self.part.residual(space, self._poses(space, poses), t)

    def coordinates(self, space, poses):
        return self.part.coordinates(space, self._poses(space, poses))


class TendonOnFrames(AbstractOnFrames, AbstractTendon):
    """A tendon on frames."""

    def length(self, space, poses):
        return self.part.length(space, self._poses(space, poses))


class VelocityConstraintOnFrames(AbstractOnFrames, AbstractVelocityConstraint):
    """A velocity constraint on frames."""

    @property
    def rows(self):
        return self.part.rows

    @property
    def linear(self):
        return self.part.linear

    @property
    def homogeneous(self):
        return self.part.homogeneous

    def residual(self, space, poses, velocities, t):
        return self.part.residual(space, self._poses(space, poses), self._velocities(space, poses, velocities), t)


class AbstractForceOnFrames(AbstractOnFrames, AbstractPotentialForce):
    """A force law on frames."""

    @property
    def conservative(self):
        return self.part.conservative

    def energy(self, space, poses, t):
        return self.part.energy(space, self._poses(space, poses), t)

    def wrenches(self, space, poses, velocities, t):
        own = self.part.wrenches(space, self._poses(space, poses), self._velocities(space, poses, velocities), t)
        return self._to_bodies(space, poses, own)


class DynamicForceOnFrames(AbstractForceOnFrames, AbstractDynamicForce):
    """A force law with internal states on frames."""

    def state_rates(self, space, poses, velocities, t):
        return self.part.state_rates(space, self._poses(space, poses), self._velocities(space, poses, velocities), t)

    def state_sizes(self):
        return self.part.state_sizes()


class ForceOnFrames(AbstractForceOnFrames):
    """A force law on frames without internal states."""


class NonIdealOnFrames(AbstractFramedPart, AbstractNonIdeal):
    """A non-ideal force of a joint on frames."""

    @property
    def joint(self):
        return self.part.joint

    def wrenches(self, space, poses, velocities, reactions, t):
        on_frame = lambda k, x, w: self.frames[str(k)].wrench_on_frame(space, x, w) if str(k) in self.frames else w
        own = jnp.stack([on_frame(k, x, w) for k, (x, w) in enumerate(zip(poses, reactions, strict=True))])
        at = self._poses(space, poses), self._velocities(space, poses, velocities)
        return self._to_bodies(space, poses, self.part.wrenches(space, *at, own, t))
