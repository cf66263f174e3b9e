"""Planar joints.

Every joint connects body-fixed points and axes of `body_a` and `body_b` (either may be `"ground"`). They are given in
the body frames (`point_a`, `point_b`, `axis_a`), or all at once by a world point and axis at the given poses (`point`,
`axis`). Below, `A` and `B` are the world positions of the two points, `d = B − A`, `n` the normal of the axis.

Their own coordinates are `angle` [rad], that of `body_b` less that of `body_a`, and `displacement` [m], the component
of d along the axis, zero where B is next to A. Points given by a world `point` coincide at the given poses, so that the
displacement counts from there.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._types import Scalar
from ...linalg.rotations import norm, rotate_2d
from .. import fields
from ..base import AbstractConstraint, AbstractJoint, AbstractPair, AbstractPlanarPart
from ..shapes import pin, sleeve, wheel
from ..space import both_points, nearest_to_origin, separation


def relative_angle(poses: Float[Array, "k p"]) -> Float[Array, ""]:
    """`angle_b − angle_a` [rad]."""
    return poses[1, 2] - poses[0, 2]


class Revolute(AbstractPlanarPart, AbstractJoint):
    """A pin: two points coincide. Rows 2: `d = 0`.

    Its coordinate is `angle` [rad], that of `body_b` less that of `body_a`: zero where both bodies have the same angle.

    **Arguments:** `point_a`, `point_b` [m], shape (2,), body-fixed; or `point` [m], shape (2,), world.
    """

    rows: ClassVar[int] = 2
    angles: ClassVar[frozenset[str]] = frozenset({"angle"})

    def residual(self, space, poses, t):
        return separation(space, self, poses)

    def coordinates(self, space, poses):
        return {"angle": relative_angle(poses)}

    def shapes(self, space, size):
        return ((0, pin(space.in_space(self.point_a), size)),)


class Fixed(AbstractPlanarPart, AbstractJoint):
    """A weld: two points coincide and the relative angle is constant. Rows 3: `d = 0`, `angle_b − angle_a = angle`.

    **Arguments:** points as in `Revolute`; `angle` [rad], default that of the given poses.
    """

    angle: fields.Number = fields.parameter(unit="rad", optional=True)
    rows: ClassVar[int] = 3

    def complete(self, space, poses):
        return self.filled(angle=relative_angle(poses))

    def residual(self, space, poses, t):
        return jnp.concatenate([separation(space, self, poses), (relative_angle(poses) - self.angle)[None]])


class PointOnLine(AbstractPlanarPart, AbstractJoint):
    """A pin in a straight slot: point B stays on the line through A. Rows 1: `n·d = 0`.

    Its coordinates are `displacement` [m], the distance of B from A along the slot, and `angle` as in `Revolute`. If
    the points are given by a world `point`, where they coincide, the displacement is zero at the given poses.

    **Arguments:** points as in `Revolute`; `axis_a`, unit, shape (2,), direction of the slot fixed in `body_a`, or
    `axis` in the world at the given pose.
    """

    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",))
    rows: ClassVar[int] = 1
    angles: ClassVar[frozenset[str]] = frozenset({"angle"})

    def residual(self, space, poses, t):
        return _offset(space, self, poses)[None]

    def coordinates(self, space, poses):
        return {"displacement": _displacement(space, self, poses), "angle": relative_angle(poses)}

    def path(self, space, poses):
        return both_points(space, self, poses)

    def shapes(self, space, size):
        return ((1, pin(space.in_space(self.point_b), size)),)


class Prismatic(AbstractPlanarPart, AbstractJoint):
    """A slide: B stays on the line through A and the relative angle is constant. Rows 2: `n·d = 0`, `angle_b − angle_a
    = angle`.

    Its coordinate is `displacement` [m], the distance of B from A along the axis. If the points are given by a world
    `point`, where they coincide, the displacement is zero at the given poses, wherever the body then is; give `point_a`
    and `point_b` to count from a place of your own. Where B is along the axis has no effect on the motion, and a
    picture shows the slide next to the mass centre of `body_b`.

    **Arguments:** as in `PointOnLine`; `angle` [rad], default that of the given poses.
    """

    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",))
    angle: fields.Number = fields.parameter(unit="rad", optional=True)
    rows: ClassVar[int] = 2

    def complete(self, space, poses):
        return self.filled(angle=relative_angle(poses))

    def residual(self, space, poses, t):
        return jnp.stack([_offset(space, self, poses), relative_angle(poses) - self.angle])

    def coordinates(self, space, poses):
        return {"displacement": _displacement(space, self, poses)}

    @property
    def _axis_b(self):
        return rotate_2d(-self.angle, self.axis_a)

    def pictured(self, space):
        return self.with_fields(point_b=nearest_to_origin(self.point_b, self._axis_b))

    def path(self, space, poses):
        return both_points(space, self, poses)

    def shapes(self, space, size):
        return ((1, sleeve(space.in_space(self.point_b), size, space.in_space(self._axis_b))),)


def _offset(space, part, poses):
    """`n·d`."""
    along = space.direction(poses[0], part.axis_a)
    return jnp.dot(jnp.stack([-along[1], along[0]]), separation(space, part, poses))


def _displacement(space, part, poses):
    """The component of d along the axis."""
    return jnp.dot(space.direction(poses[0], part.axis_a), separation(space, part, poses))


class Distance(AbstractPlanarPart, AbstractPair, AbstractConstraint):
    """A massless rod: two points keep their distance. Rows 1: `(d·d − length²) / (2 length) = 0`; the multiplier is
    the rod force [N].

    **Arguments:** `point_a`, `point_b` [m], shape (2,), body-fixed; `length` [m] > 0, default that of the given poses.
    """

    point_a: fields.Number = fields.point(body=0, default=(0.0, 0.0))
    point_b: fields.Number = fields.point(body=1, default=(0.0, 0.0))
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


class PointOnCurve(AbstractPlanarPart, AbstractPair, AbstractConstraint):
    """A pin in a curved slot: point B stays on a curve fixed in `body_a`. Rows 1: `curve(B in the frame of body_a,
    parameters) = 0`.

    **Arguments:** `point_b` [m], shape (2,), body-fixed; `curve(point, parameters) -> scalar`, zero on the curve and
    with a gradient there; `parameters`, numbers of the curve by name.
    """

    curve: Callable[[Float[Array, "2"], Any], Scalar] = fields.function()
    point_b: fields.Number = fields.point(body=1, default=(0.0, 0.0))
    parameters: fields.Numbers = fields.numbers()
    rows: ClassVar[int] = 1
    angles: ClassVar[frozenset[str]] = frozenset({"angle"})
    rheonomic: ClassVar[bool] = False

    def residual(self, space, poses, t):
        point = space.body_point(poses[0], space.point(poses[1], self.point_b))
        return jnp.reshape(self.curve(point, self.parameters), (1,))

    def coordinates(self, space, poses):
        return {"angle": relative_angle(poses)}


class Gear(AbstractPlanarPart, AbstractPair, AbstractConstraint):
    """A pair of gears on a carrier. Rows 1: `(angle_b − angle_c) = ratio (angle_a − angle_c) + offset`.

    **Arguments:** `ratio`, negative for an external mesh (−radius_a / radius_b); `carrier`, the body that holds both
    axles, default ground; `offset` [rad], default that of the given poses.
    """

    ratio: fields.Number = fields.parameter(sign="nonzero")
    carrier: str = fields.body_name(default="ground")
    offset: fields.Number = fields.parameter(unit="rad", optional=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    def complete(self, space, poses):
        return self.filled(offset=poses[1, 2] - poses[2, 2] - self.ratio * (poses[0, 2] - poses[2, 2]))

    def residual(self, space, poses, t):
        a, b, c = poses[0, 2], poses[1, 2], poses[2, 2]
        return (b - c - self.ratio * (a - c) - self.offset)[None]


class RackAndPinion(AbstractPlanarPart, AbstractPair, AbstractConstraint):
    """A pinion (`body_a`) that rolls along a rack (`body_b`). Rows 1: `axis·(A − B) = −radius (angle_a − angle_b) +
    offset`.

    A pinion on top of a rack along x, turning clockwise, moves towards +x of the rack.

    **Arguments:** `radius` [m] > 0 of the pinion; `point_a` [m], its centre; `point_b` [m], a point of the rack;
    `axis_b`, unit, shape (2,), direction of the rack fixed in `body_b`; `offset` [m], default that of the given
    poses.
    """

    radius: fields.Number = fields.length(sign="positive")
    axis_b: fields.Number = fields.axis(body=1, default=(1.0, 0.0))
    point_a: fields.Number = fields.point(body=0, default=(0.0, 0.0))
    point_b: fields.Number = fields.point(body=1, default=(0.0, 0.0))
    offset: fields.Number = fields.parameter(unit="m", optional=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    def complete(self, space, poses):
        return self.filled(offset=self._travel(space, poses))

    def _travel(self, space, poses):
        along = space.direction(poses[1], self.axis_b)
        return -jnp.dot(along, separation(space, self, poses)) + self.radius * (poses[0, 2] - poses[1, 2])

    def residual(self, space, poses, t):
        return (self._travel(space, poses) - self.offset)[None]

    def shapes(self, space, size):
        pinion = wheel(self.radius, 2 * size, space.in_space(self.point_a))
        return tuple((0, shape) for shape in pinion)
