"""Joints of the plane.

Every joint connects body-fixed points and axes of `body_a` and `body_b` (either may be `"ground"`). They are given in
the bodies' own frames (`point_a`, `point_b`, `axis_a`), or all at once by a world point and axis at the bodies' given
poses (`point`, `axis`). Below, `A` and `B` are the world positions of the two points, `d = B − A`, `n` the normal of
the axis.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._types import Scalar
from ...linalg.rotations import norm
from ..base import AbstractConstraint, number, optional_number
from ..functions import numbers
from ..resolve import fill, label, point_pair, positive, unit, vector


def _separation(space, part, poses):
    return space.point(poses[1], part.point_b) - space.point(poses[0], part.point_a)


def _normal(v):
    return jnp.stack([-v[1], v[0]])


class Revolute(AbstractConstraint):
    """A pin: two points coincide. Rows 2: `d = 0`.

    **Arguments:** `point_a`, `point_b` [m], shape (2,), body-fixed; or `point` [m], shape (2,), world.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 2
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return point_pair(self, space, poses)

    def residual(self, space, poses, t):
        return _separation(space, self, poses)


class Fixed(AbstractConstraint):
    """A weld: two points coincide and the relative angle is constant. Rows 3: `d = 0`, `angle_b − angle_a = angle`.

    **Arguments:** points as in `Revolute`; `angle` [rad], default that of the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    angle: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 3
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return fill(point_pair(self, space, poses), "angle", poses[1, 2] - poses[0, 2])

    def residual(self, space, poses, t):
        angle = poses[1, 2] - poses[0, 2] - self.angle
        return jnp.concatenate([_separation(space, self, poses), angle[None]])


class PointOnLine(AbstractConstraint):
    """A pin in a straight slot: point B stays on the line through A. Rows 1: `n·d = 0`.

    **Arguments:** points as in `Revolute`; `axis_a`, unit, shape (2,), direction of the slot fixed in `body_a`, or
    `axis` in the world at the given pose.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return _resolve_slide(self, space, poses)

    def residual(self, space, poses, t):
        return _offset(space, self, poses)[None]


class Prismatic(AbstractConstraint):
    """A slide: B stays on the line through A and the relative angle is constant. Rows 2: `n·d = 0`, `angle_b − angle_a
    = angle`.

    **Arguments:** as in `PointOnLine`; `angle` [rad], default that of the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    angle: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 2
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return fill(_resolve_slide(self, space, poses), "angle", poses[1, 2] - poses[0, 2])

    def residual(self, space, poses, t):
        return jnp.stack([_offset(space, self, poses), poses[1, 2] - poses[0, 2] - self.angle])


def _resolve_slide(part, space, poses):
    part = point_pair(part, space, poses)
    if (part.axis is None) == (part.axis_a is None):
        raise ValueError(
            f"{label(part)}: give axis_a (fixed in {part.body_a!r}) or axis (world), and only one of them."
        )
    if part.axis is None:
        axis = unit(part, "axis_a", part.axis_a, 2)
    else:
        axis = space.body_direction(poses[0], unit(part, "axis", part.axis, 2))
    return eqx.tree_at(lambda p: (p.axis_a, p.axis), part, (axis, None), is_leaf=lambda x: x is None)


def _offset(space, part, poses):
    return jnp.dot(_normal(space.direction(poses[0], part.axis_a)), _separation(space, part, poses))


class Distance(AbstractConstraint):
    """A massless rod: two points keep their distance. Rows 1: `(d·d − length²) / (2 length) = 0`; the multiplier is
    the rod force [N].

    **Arguments:** `point_a`, `point_b` [m], shape (2,), body-fixed; `length` [m] > 0, default that of the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    point_b: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    length: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        vector(self, "point_a", self.point_a, 2)
        vector(self, "point_b", self.point_b, 2)
        part = fill(self, "length", norm(_separation(space, self, poses)))
        positive(part, "length", part.length)
        return part

    def residual(self, space, poses, t):
        d = _separation(space, self, poses)
        return ((jnp.dot(d, d) - self.length**2) / (2 * self.length))[None]


class PointOnCurve(AbstractConstraint):
    """A pin in a curved slot: point B stays on a curve fixed in `body_a`. Rows 1: `curve(B in the frame of body_a,
    parameters) = 0`.

    **Arguments:** `point_b` [m], shape (2,), body-fixed; `curve(point, parameters) -> scalar`, zero on the curve and
    with a gradient there; `parameters`, numbers of the curve by name.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    curve: Callable[[Float[Array, "2"], Any], Scalar] = eqx.field(static=True)
    point_b: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    parameters: dict[str, Array] = eqx.field(converter=numbers, default_factory=dict, kw_only=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        vector(self, "point_b", self.point_b, 2)
        return self

    def residual(self, space, poses, t):
        point = space.body_point(poses[0], space.point(poses[1], self.point_b))
        return jnp.reshape(self.curve(point, self.parameters), (1,))


class Gear(AbstractConstraint):
    """A pair of gears on a carrier. Rows 1: `(angle_b − angle_c) = ratio (angle_a − angle_c) + offset`.

    **Arguments:** `ratio`, negative for gears that mesh outside (−radius_a / radius_b); `carrier`, the body that
    holds both axles, default ground; `offset` [rad], default that of the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    ratio: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    carrier: str = eqx.field(static=True, default="ground", kw_only=True)
    offset: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b, self.carrier)

    def resolve(self, space, poses):
        if float(self.ratio) == 0:
            raise ValueError(f"{label(self)}: ratio must not be zero.")
        return fill(self, "offset", poses[1, 2] - poses[2, 2] - self.ratio * (poses[0, 2] - poses[2, 2]))

    def residual(self, space, poses, t):
        a, b, c = poses[0, 2], poses[1, 2], poses[2, 2]
        return (b - c - self.ratio * (a - c) - self.offset)[None]


class RackAndPinion(AbstractConstraint):
    """A pinion (`body_a`) that rolls along a rack (`body_b`). Rows 1: `axis·(A − B) = −radius (angle_a − angle_b) +
    offset`.

    A pinion on top of a rack along x, turning clockwise, moves towards +x of the rack.

    **Arguments:** `radius` [m] > 0 of the pinion; `point_a` [m], its centre; `point_b` [m], a point of the rack;
    `axis_b`, unit, shape (2,), direction of the rack fixed in `body_b`; `offset` [m], default that of the given
    poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    radius: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    axis_b: Float[Array, "2"] = eqx.field(converter=number, default=(1.0, 0.0), kw_only=True)
    point_a: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    point_b: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    offset: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        positive(self, "radius", self.radius)
        unit(self, "axis_b", self.axis_b, 2)
        vector(self, "point_a", self.point_a, 2)
        vector(self, "point_b", self.point_b, 2)
        return fill(self, "offset", self._travel(space, poses))

    def _travel(self, space, poses):
        along = space.direction(poses[1], self.axis_b)
        return -jnp.dot(along, _separation(space, self, poses)) + self.radius * (poses[0, 2] - poses[1, 2])

    def residual(self, space, poses, t):
        return (self._travel(space, poses) - self.offset)[None]
