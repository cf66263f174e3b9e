"""Spatial joints that bind points of two bodies and leave their attitudes free; for notation see `joints`."""

from typing import ClassVar

import jax.numpy as jnp

from ...linalg.rotations import norm
from .. import fields
from ..base import AbstractConstraint, AbstractJoint, AbstractPair, AbstractSpatialPart
from ..shapes import ball
from ..space import both_points, separation
from .axes import across, displacement_along, offset_in_a


class Distance(AbstractSpatialPart, AbstractPair, AbstractConstraint):
    """A massless rod: two points keep their distance. Rows 1: `(d·d − length²) / (2 length)`.

    The multiplier is the rod force [N].

    **Arguments:** `point_a`, `point_b` [m], shape (3,), body-fixed; `length` [m] > 0, default that of the given poses.
    """

    point_a: fields.Number = fields.point(body=0, default=(0.0, 0.0, 0.0))
    point_b: fields.Number = fields.point(body=1, default=(0.0, 0.0, 0.0))
    length: fields.Number = fields.length(sign="positive", optional=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    def complete(self, space, poses):
        return self.filled(length=norm(separation(space, self, poses)))

    def residual(self, space, poses, t):
        d = separation(space, self, poses)
        return ((jnp.dot(d, d) - self.length**2) / (2 * self.length))[None]

    def path(self, space, poses):
        return both_points(space, self, poses)


class PointOnPlane(AbstractSpatialPart, AbstractJoint):
    """A point of B stays in a plane fixed in A, through A normal to the axis. Rows 1: `a·d`.

    **Arguments:** points as in `Spherical`; `axis_a`, unit, shape (3,), normal of the plane fixed in `body_a`, or
    `axis` in the world.
    """

    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",))
    rows: ClassVar[int] = 1

    def residual(self, space, poses, t):
        return jnp.dot(self.axis_a, offset_in_a(space, self, poses))[None]


class PointOnLine(AbstractSpatialPart, AbstractJoint):
    """A ball in a straight slot: a point of B stays on the line through A along the axis. Rows 2: `u·d`, `v·d`.

    **Arguments:** points as in `Spherical`; `axis_a`, unit, shape (3,), direction of the slot fixed in `body_a`, or
    `axis` in the world.
    """

    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",))
    rows: ClassVar[int] = 2

    def residual(self, space, poses, t):
        return across(self.axis_a, offset_in_a(space, self, poses))

    def coordinates(self, space, poses):
        return {"displacement": displacement_along(space, self, poses)}

    def path(self, space, poses):
        return both_points(space, self, poses)

    def shapes(self, space, size):
        return ((1, ball(self.point_b, size)),)
