"""Wheels and balls that roll on a plane in space.

The plane is fixed in the world, given by a point and its normal `e`, which points to the side of the body.
"""

from typing import ClassVar

import jax.numpy as jnp

from ...linalg.rotations import cross, dot, norm
from .. import fields
from ..base import AbstractCompound, AbstractConstraint, AbstractSpatialPart, AbstractVelocityConstraint
from ..shapes import Ground, along, marked_ball, wheel
from ..space import with_drift
from .axes import perpendiculars


class AbstractRolling(AbstractSpatialPart):
    """Fields of bodies that roll on a plane.

    **Arguments:**

    - `name`; `body`: the body that rolls, or a frame in it, by name.
    - `radius` [m] > 0; `centre` [m], shape (3,), of the disc or sphere, fixed in the body, default the origin of its
        frame.
    - `point` [m] and `normal` (unit), shape (3,), of the plane in the world, default the plane z = 0. As an input,
        `"rolling.point"` moves the plane.
    """

    name: str = fields.name()
    body: str = fields.body_name()
    radius: fields.Number = fields.length(sign="positive")
    centre: fields.Number = fields.point(body=0, sizes=False, default=(0.0, 0.0, 0.0))
    normal: fields.Number = fields.axis(body=None, default=(0.0, 0.0, 1.0))
    point: fields.Number = fields.point(body=None, default=(0.0, 0.0, 0.0))


class AbstractDisc(AbstractRolling):
    """A thin disc that rolls on a plane.

    **Arguments:** `axis`, unit, shape (3,): the axle fixed in the body, default its z axis.
    """

    axis: fields.Number = fields.axis(body=0, default=(0.0, 0.0, 1.0))


def _uphill(space, part, pose):
    """The plane's normal less its component along the axle, times n·n: `m = (n·n) e − (n·e) n`; with n·n and |m|."""
    n = space.direction(pose, part.axis)
    square = dot(n, n)
    m = square * part.normal - dot(n, part.normal) * n
    return m, square, norm(m)


def _lowest_rim_point(space, part, pose):
    """From the centre of a disc to the lowest point of its rim over the plane [m], `ρ = −r m/|m|`.

    The direction does not depend on the lengths of e and n. A disc that lies flat has no lowest point: ρ = 0.
    """
    m, _, length = _uphill(space, part, pose)
    return -part.radius * m / jnp.where(length > 0, length, 1.0)


def _from_plane(space, part, pose):
    """World vector [m] from the plane's point to the centre."""
    return space.point(pose, part.centre) - part.point


def _tangential(normal, v):
    return jnp.sum(perpendiculars(normal) * v[None, :], axis=1)


class RollingDisc(AbstractDisc, AbstractCompound):
    """A thin disc that rolls on a plane without slipping: contact (1 row on positions), rolling (2 on velocities).

    ```python
    coin = spatial.Body("coin", mass=1.0, inertia=spatial.disc(1.0, 0.1, "y"), position=(0.0, 0.0, 0.1))
    rolling = spatial.RollingDisc("rolling", "coin", radius=0.1, axis=(0.0, 1.0, 0.0))
    system = jaxmb.Scene([coin], joints=[rolling]).compile()
    ```

    The contact point is the lowest point of the rim, at `ρ = −r (e − (e·n) n) / |e − (e·n) n|` from the centre, with
    the normal e of the plane and the axle n. A disc that lies flat has no contact point: such a pose is refused, and a
    motion that comes to it ends there as a singular configuration. The part has no coordinates.
    """

    def components(self):
        disc = {"radius": self.radius, "axis": self.axis, "centre": self.centre}
        disc |= {"point": self.point, "normal": self.normal}
        return (DiscOnPlane(self.name, self.body, **disc), DiscRolling(self.name, self.body, **disc))


class DiscOnPlane(AbstractDisc, AbstractConstraint):
    """A disc that touches a plane. Rows 1: `e·(C + ρ − point) = 0`, C its centre."""

    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False
    lost_heading: ClassVar[str | None] = "the disc {name} lies flat on its plane, and has no contact point"

    def heading(self, space, poses):
        # As in `_uphill`, of unit vectors.
        n = space.direction(poses[0], self.axis)
        return self.normal - dot(self.normal, n) * n

    def residual(self, space, poses, t):
        _, square, length = _uphill(space, self, poses[0])
        # The lowest point is ρ from the centre, with `e·ρ = −r |m| / n·n`.
        return (dot(self.normal, _from_plane(space, self, poses[0])) - self.radius * length / square)[None]

    def shapes(self, space, size):
        disc = ((0, shape) for shape in wheel(self.radius, size, self.centre, self.axis))
        return (*disc, (None, Ground(position=self.point, orientation=along(self.normal))))


class DiscRolling(AbstractDisc, AbstractVelocityConstraint):
    """A disc whose contact point does not slip. Rows 2: `Ċ + ω × ρ` in the plane."""

    rows: ClassVar[int] = 2
    linear: ClassVar[bool] = True
    homogeneous: ClassVar[bool] = True

    def may_vary(self, keys):
        return keys[0] not in ("radius", "axis")

    def residual(self, space, poses, velocities, t):
        rho = space.body_direction(poses[0], _lowest_rim_point(space, self, poses[0]))
        slip = space.point_velocity(poses[0], velocities[0], self.centre + rho)
        return _tangential(self.normal, with_drift(self, slip, lambda part: _from_plane(space, part, poses[0])))


class RollingSphere(AbstractRolling, AbstractCompound):
    """A sphere that rolls on a plane without slipping: contact (1 row on positions), rolling (2 on velocities).

    ```python
    ball = spatial.Body("ball", mass=1.0, inertia=spatial.sphere(1.0, 0.1), position=(0.0, 0.0, 0.1))
    rolling = spatial.RollingSphere("rolling", "ball", radius=0.1)
    system = jaxmb.Scene([ball], joints=[rolling]).compile()
    ```

    It has no coordinates.

    **Arguments:** `spin` [rad/s], of a turntable: the rate at which the plane turns about its normal through `point`,
    default a plane at rest.
    """

    spin: fields.Number = fields.parameter(unit="rad/s", optional=True)

    def components(self):
        ball = {"radius": self.radius, "centre": self.centre, "point": self.point, "normal": self.normal}
        return (
            SphereContact(self.name, self.body, **ball),
            SphereRolling(self.name, self.body, spin=self.spin, **ball),
        )


class SphereContact(AbstractRolling, AbstractConstraint):
    """A sphere that touches a plane. Rows 1: `e·(C − point) = radius`, C the centre."""

    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    def residual(self, space, poses, t):
        height = dot(self.normal, space.point(poses[0], self.centre) - self.point)
        return (height - self.radius * norm(self.normal))[None]

    def shapes(self, space, size):
        ground = Ground(position=self.point, orientation=along(self.normal))
        return *((0, shape) for shape in marked_ball(self.radius, self.centre)), (None, ground)


class SphereRolling(AbstractRolling, AbstractVelocityConstraint):
    """A sphere that moves with the plane at the point of contact. Rows 2: `Ċ − r ω × e − spin e × (C − point)` in the
    plane.

    With a turntable the rows do not vanish at rest.
    """

    spin: fields.Number = fields.parameter(unit="rad/s", optional=True)
    rows: ClassVar[int] = 2
    linear: ClassVar[bool] = True

    @property
    def homogeneous(self):
        return self.spin is None

    def residual(self, space, poses, velocities, t):
        e = self.normal / norm(self.normal)
        rho = space.body_direction(poses[0], -self.radius * e)
        slip = space.point_velocity(poses[0], velocities[0], self.centre + rho)
        slip = with_drift(self, slip, lambda part: _from_plane(space, part, poses[0]))
        if self.spin is not None:
            slip = slip - self.spin * cross(e, space.point(poses[0], self.centre) - self.point)
        return _tangential(self.normal, slip)
