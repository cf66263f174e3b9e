"""Joints of space.

Every joint connects body-fixed points and axes of `body_a` and `body_b` (either may be `"ground"`). They are given in
the bodies' own frames (`point_a`, `point_b`, `axis_a`, `axis_b`), or all at once by a world point and axis at the
bodies' given poses (`point`, `axis`). Axes are unit vectors. Below, `A` and `B` are the world positions of the two
points, `d = B − A`, `a` and `b` the two axes, `u` and `v` two unit vectors fixed in `body_a` and perpendicular to `a`;
all rows are Φ = 0.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...linalg.rotations import norm
from ..base import AbstractConstraint, number, optional_number
from ..resolve import axis_pair, fill, label, point_pair, positive, unit, vector
from .axes import (
    angle,
    cosine_sine,
    direction_in_a,
    perpendiculars,
    resolve_axis,
    resolve_orientation,
    resolve_references,
    shift_in_a,
    turn_vector,
)


def _separation(space, part, poses):
    return space.point(poses[1], part.point_b) - space.point(poses[0], part.point_a)


def _across(axis_a, w):
    """The components `u·w`, `v·w` of a vector in A across the axis: zero where it is parallel to the axis."""
    return jnp.sum(perpendiculars(axis_a) * w[None, :], axis=1)


def _parallel(space, part, poses):
    return _across(part.axis_a, direction_in_a(space, poses, part.axis_b))


class Spherical(AbstractConstraint):
    """A ball: two points coincide. Rows 3: `d`.

    **Arguments:** `point_a`, `point_b` [m], shape (3,), body-fixed; or `point` [m], shape (3,), world.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 3
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return point_pair(self, space, poses)

    def residual(self, space, poses, t):
        return _separation(space, self, poses)


class Revolute(AbstractConstraint):
    """A hinge: two points coincide and two axes are parallel. Rows 5: `d`, `u·b`, `v·b`.

    **Arguments:** points as in `Spherical`; `axis_a`, `axis_b`, unit, shape (3,), direction of the hinge fixed in each
    body; or `axis`, unit, shape (3,), world.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 5
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return axis_pair(point_pair(self, space, poses), space, poses)

    def residual(self, space, poses, t):
        return jnp.concatenate([_separation(space, self, poses), _parallel(space, self, poses)])


class Universal(AbstractConstraint):
    """A Cardan joint: two points coincide and two axes stay perpendicular. Rows 4: `d`, `a·b`.

    **Arguments:** points as in `Spherical`; `axis_a`, `axis_b`, unit, shape (3,), the arms of the cross, fixed in
    `body_a` and in `body_b`; each may be given in the world instead, as `axis_a_W` and `axis_b_W`.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a_W: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_b_W: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 4
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        part = point_pair(self, space, poses)
        axes = []
        for k, field in enumerate(("axis_a", "axis_b")):
            fixed, world = getattr(part, field), getattr(part, field + "_W")
            if (fixed is None) == (world is None):
                raise ValueError(
                    f"{label(part)}: give {field} (fixed in {part.bodies[k]!r}) or {field}_W (world), and only one of "
                    "them."
                )
            if world is None:
                axes.append(unit(part, field, fixed, 3))
            else:
                axes.append(space.body_direction(poses[k], unit(part, field + "_W", world, 3)))
        if part.axis_a_W is not None and part.axis_b_W is not None:
            cosine = float(part.axis_a_W @ part.axis_b_W)
            if abs(cosine) > 1e-6:
                raise ValueError(
                    f"{label(part)}: axis_a_W and axis_b_W must be perpendicular, their product is {cosine:.6g}."
                )
        where = lambda p: (p.axis_a, p.axis_b, p.axis_a_W, p.axis_b_W)
        return eqx.tree_at(where, part, (*axes, None, None), is_leaf=lambda x: x is None)

    def residual(self, space, poses, t):
        cosine = jnp.dot(self.axis_a, direction_in_a(space, poses, self.axis_b))
        return jnp.concatenate([_separation(space, self, poses), cosine[None]])


class Cylindrical(AbstractConstraint):
    """A turning slide: two axes stay on one line. Rows 4: `u·b`, `v·b`, `u·d`, `v·d`.

    **Arguments:** as in `Revolute`.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 4
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return axis_pair(point_pair(self, space, poses), space, poses)

    def residual(self, space, poses, t):
        shift = shift_in_a(space, self, poses)
        return jnp.concatenate([_parallel(space, self, poses), _across(self.axis_a, shift)])


class Screw(AbstractConstraint):
    """A screw: two axes stay on one line and a turn advances B. Rows 5: those of `Cylindrical`, and the thread.

    With the angle θ from `x_a` to `x_b` about the axis and the shift s = a·d, the last row is `pitch/2π · sin(θ − 2π (s
    − offset)/pitch) = 0`, written with products of direction components: it is periodic in θ and in s as the screw
    itself is, so any number of turns passes without a branch, and there its value is the axial error [m]. (The sine has
    a second family of zeros half a turn away, which a solution that is followed continuously never meets.)

    **Arguments:** points and axes as in `Revolute`; `pitch` [m], advance of B along the axis a turn, positive for a
    right-handed screw, not zero; `offset` [m], the shift at θ = 0, default that of the given poses; `x_a`, `x_b`, unit,
    shape (3,), body-fixed and across the axis, between which θ is measured, default zero angle at the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    pitch: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    x_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    x_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    offset: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 5
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        vector(self, "pitch", self.pitch[None], 1)
        if float(self.pitch) == 0:
            raise ValueError(f"{label(self)}: pitch must not be zero; use Revolute for a screw that does not advance.")
        part = resolve_references(axis_pair(point_pair(self, space, poses), space, poses), space, poses)
        advance = part.pitch * angle(space, part, poses) / (2 * np.pi)
        return fill(part, "offset", part.axis_a @ shift_in_a(space, part, poses) - advance)

    def residual(self, space, poses, t):
        shift = shift_in_a(space, self, poses)
        lead = self.pitch / (2 * np.pi)
        turn = (jnp.dot(self.axis_a, shift) - self.offset) / lead
        c, s = cosine_sine(space, self, poses)
        thread = lead * (s * jnp.cos(turn) - c * jnp.sin(turn))
        return jnp.concatenate([_parallel(space, self, poses), _across(self.axis_a, shift), thread[None]])


class Prismatic(AbstractConstraint):
    """A slide: B stays on the line through A without turning. Rows 5: `u·d`, `v·d`, and the turn (3).

    The turn is twice the vector part of the Euler parameters from `orientation` to the relative attitude: the rotation
    vector [rad] when small, and zero only there, whichever sign the bodies' Euler parameters have.

    **Arguments:** points as in `Spherical`; `axis_a`, unit, shape (3,), direction of the slide fixed in `body_a`, or
    `axis` in the world; `orientation`, shape (4,), unit Euler parameters of B relative to A, default those of the given
    poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    orientation: Float[Array, "4"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 5
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return resolve_orientation(resolve_axis(point_pair(self, space, poses), space, poses), poses)

    def residual(self, space, poses, t):
        return jnp.concatenate([_across(self.axis_a, shift_in_a(space, self, poses)), turn_vector(self, poses)])


class Planar(AbstractConstraint):
    """A sliding face: B stays in the plane through A normal to `a`, the axes parallel. Rows 3: `u·b`, `v·b`, `a·d`.

    **Arguments:** as in `Revolute`; the axes are the normals of the two faces.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 3
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return axis_pair(point_pair(self, space, poses), space, poses)

    def residual(self, space, poses, t):
        height = jnp.dot(self.axis_a, shift_in_a(space, self, poses))
        return jnp.concatenate([_parallel(space, self, poses), height[None]])


class Fixed(AbstractConstraint):
    """A weld: two points coincide and B does not turn in A. Rows 6: `d`, and the turn (3) as in `Prismatic`.

    **Arguments:** points as in `Spherical`; `orientation` as in `Prismatic`.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    orientation: Float[Array, "4"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 6
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return resolve_orientation(point_pair(self, space, poses), poses)

    def residual(self, space, poses, t):
        return jnp.concatenate([_separation(space, self, poses), turn_vector(self, poses)])


class Distance(AbstractConstraint):
    """A massless rod: two points keep their distance. Rows 1: `(d·d − length²) / (2 length)`.

    The multiplier is the rod force [N].

    **Arguments:** `point_a`, `point_b` [m], shape (3,), body-fixed; `length` [m] > 0, default that of the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=number, default=(0.0, 0.0, 0.0), kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=number, default=(0.0, 0.0, 0.0), kw_only=True)
    length: Float[Array, ""] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        vector(self, "point_a", self.point_a, 3)
        vector(self, "point_b", self.point_b, 3)
        part = fill(self, "length", norm(_separation(space, self, poses)))
        positive(part, "length", part.length)
        return part

    def residual(self, space, poses, t):
        d = _separation(space, self, poses)
        return ((jnp.dot(d, d) - self.length**2) / (2 * self.length))[None]


class PointOnPlane(AbstractConstraint):
    """A point of B stays in a plane fixed in A, through A normal to the axis. Rows 1: `a·d`.

    **Arguments:** points as in `Spherical`; `axis_a`, unit, shape (3,), normal of the plane fixed in `body_a`, or
    `axis` in the world.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return resolve_axis(point_pair(self, space, poses), space, poses)

    def residual(self, space, poses, t):
        return jnp.dot(self.axis_a, shift_in_a(space, self, poses))[None]


class PointOnLine(AbstractConstraint):
    """A ball in a straight slot: a point of B stays on the line through A along the axis. Rows 2: `u·d`, `v·d`.

    **Arguments:** points as in `Spherical`; `axis_a`, unit, shape (3,), direction of the slot fixed in `body_a`, or
    `axis` in the world.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 2
    rheonomic: ClassVar[bool] = False

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        return resolve_axis(point_pair(self, space, poses), space, poses)

    def residual(self, space, poses, t):
        return _across(self.axis_a, shift_in_a(space, self, poses))
