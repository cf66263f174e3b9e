"""Constraints between velocities in the plane."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from ..base import AbstractVelocityConstraint, number
from ..resolve import unit, vector


class KnifeEdge(AbstractVelocityConstraint):
    """A blade, skate or wheel that does not slip sideways. Rows 1: `n·v = 0`, v the velocity of the contact point, n
    the normal of the blade.

    **Arguments:** `point` [m], shape (2,), contact point fixed in the body; `axis`, unit, shape (2,), direction of
    the blade fixed in the body.
    """

    name: str = eqx.field(static=True)
    body: str = eqx.field(static=True)
    point: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    axis: Float[Array, "2"] = eqx.field(converter=number, default=(1.0, 0.0), kw_only=True)
    rows: ClassVar[int] = 1
    linear: ClassVar[bool] = True
    homogeneous: ClassVar[bool] = True

    @property
    def bodies(self):
        return (self.body,)

    def resolve(self, space, poses):
        vector(self, "point", self.point, 2)
        unit(self, "axis", self.axis, 2)
        return self

    def residual(self, space, poses, velocities, t):
        along = space.direction(poses[0], self.axis)
        v = space.point_velocity(poses[0], velocities[0], self.point)
        return (along[0] * v[1] - along[1] * v[0])[None]
