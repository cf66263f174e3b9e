"""Planar joints.

In their classes `A` and `B` are the world positions of the two points, `d = B − A`, and `n` is the normal of the axis.
"""

import itertools
from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._types import Scalar
from ...linalg.arrays import namespace
from ...linalg.rotations import rotate_2d
from .. import fields
from ..base import (
    AbstractAxisJoint,
    AbstractConstraint,
    AbstractJoint,
    AbstractPair,
    AbstractPlanarPart,
    PathKind,
    Quantities,
)
from ..elements import coincident, in_planes, perpendicular
from ..shapes import Box, Cylinder, Mesh, pin, sleeve, wheel
from ..space import nearest_to_origin, separation
from .level_curves import level_curve


def relative_angle(poses: Float[Array, "k p"]) -> Float[Array, ""]:
    """`angle_b − angle_a` [rad]."""
    return poses[1, 2] - poses[0, 2]


class Revolute(AbstractPlanarPart, AbstractJoint):
    """A pin: points A and B of two bodies coincide. Rows 2: `d = 0`, with d from A to B.

    ```python
    bar = planar.Body("bar", mass=1.0, inertia=planar.rod(1.0, 1.0), position=(0.0, -0.5), angle=-1.5)
    pin = planar.Revolute("pin", "ground", "bar", point_a=(0.0, 0.0), point_b=(-0.5, 0.0))
    system = jaxmb.Scene([bar], joints=[pin]).compile()
    ```

    Its coordinate is `angle` [rad], `angle_b − angle_a`: the difference of the angles of the bodies, which need not be
    zero at the given poses. The angle of a `spatial.Revolute` is.
    """

    rows: ClassVar[int] = 2
    quantities: ClassVar[Quantities] = {"angle": "angle"}

    @property
    def elements(self):
        return (coincident(self),)

    def residual(self, space, poses, t):
        return separation(space, self, poses)

    def coordinates(self, space, poses):
        return {"angle": relative_angle(poses)}

    def shapes(self, space, size):
        return ((0, pin(space.in_space(self.point_a), size)),)


class Fixed(AbstractPlanarPart, AbstractJoint):
    """A weld: points A and B of two bodies coincide and the relative angle is constant. Rows 3: `d = 0`, with d from A
    to B, and `angle_b − angle_a = angle`.

    ```python
    plate = planar.Body("plate", mass=1.0, inertia=0.1, position=(0.4, 0.0), angle=0.2)
    weld = planar.Fixed("weld", "ground", "plate", point=(0.0, 0.0))
    system = jaxmb.Scene([plate], joints=[weld]).compile()
    ```

    It leaves no motion and has no coordinates.

    **Arguments:**

    - `angle` [rad]: `angle_b − angle_a`, default from the given poses.
    """

    angle: fields.Number = fields.parameter(unit="rad", optional=True)
    rows: ClassVar[int] = 3

    def complete(self, space, poses):
        return self.filled(angle=relative_angle(poses))

    @property
    def elements(self):
        return coincident(self), _aligned(self.angle)

    def residual(self, space, poses, t):
        return jnp.concatenate([separation(space, self, poses), (relative_angle(poses) - self.angle)[None]])


class PointOnLine(AbstractPlanarPart, AbstractAxisJoint):
    """A pin in a straight slot: point B stays on the line through A. Rows 1: `n·d = 0`, with d from A to B and n the
    normal of the slot.

    ```python
    block = planar.Body("block", mass=1.0, inertia=0.1, position=(0.3, 0.0))
    slot = planar.PointOnLine("slot", "ground", "block", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0))
    system = jaxmb.Scene([block], joints=[slot]).compile()
    ```

    Its coordinates are `displacement` [m], from A to B along the slot, and `angle` [rad], `angle_b − angle_a`. If a
    world `point` gives both points, the displacement is zero at the given poses.
    """

    rows: ClassVar[int] = 1
    quantities: ClassVar[Quantities] = {"displacement": "length", "angle": "angle"}
    path_kind: ClassVar[PathKind] = "rod"

    @property
    def elements(self):
        return in_planes(self, [_normal(self.axis_a)])

    def residual(self, space, poses, t):
        return _offset(space, self, poses)[None]

    def coordinates(self, space, poses):
        return {"displacement": _displacement(space, self, poses), "angle": relative_angle(poses)}

    def shapes(self, space, size):
        return ((1, pin(space.in_space(self.point_b), size)),)


class Prismatic(AbstractPlanarPart, AbstractAxisJoint):
    """A slide: point B stays on the line through A and the relative angle is constant. Rows 2: `n·d = 0`, with d from A
    to B and n the normal of the line, and `angle_b − angle_a = angle`.

    ```python
    piston = planar.Body("piston", mass=1.0, inertia=0.1, position=(0.3, 0.0))
    slide = planar.Prismatic("slide", "ground", "piston", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0))
    system = jaxmb.Scene([piston], joints=[slide]).compile()
    ```

    Its coordinate is `displacement` [m], from A to B along the axis. If a world `point` gives both points, it is zero
    at the given poses, wherever the body is; give `point_a` and `point_b` for another origin. The place of B along the
    axis does not affect the motion, and a picture shows the slide next to the mass centre of `body_b`.

    **Arguments:**

    - `angle` [rad]: `angle_b − angle_a`, default from the given poses.
    """

    angle: fields.Number = fields.parameter(unit="rad", optional=True)
    rows: ClassVar[int] = 2
    quantities: ClassVar[Quantities] = {"displacement": "length"}
    path_kind: ClassVar[PathKind] = "rod"

    def complete(self, space, poses):
        return self.filled(angle=relative_angle(poses))

    @property
    def elements(self):
        return *in_planes(self, [_normal(self.axis_a)]), _aligned(self.angle)

    def residual(self, space, poses, t):
        return jnp.stack([_offset(space, self, poses), relative_angle(poses) - self.angle])

    def coordinates(self, space, poses):
        return {"displacement": _displacement(space, self, poses)}

    @property
    def _axis_b(self):
        return rotate_2d(-self.angle, self.axis_a)

    def pictured(self, space):
        return self.with_fields(point_b=nearest_to_origin(self.point_b, self._axis_b))

    def shapes(self, space, size):
        return ((1, sleeve(space.in_space(self.point_b), size, space.in_space(self._axis_b))),)


def _offset(space, part, poses):
    """`n·d`."""
    return jnp.dot(_normal(space.direction(poses[0], part.axis_a)), separation(space, part, poses))


def _normal(axis):
    return namespace(axis).stack([-axis[1], axis[0]])


def _aligned(angle):
    """The relative angle is `angle`: the sine of the difference vanishes."""
    x: Any = np.array([1.0, 0.0])
    y = np.array([0.0, 1.0])
    along = rotate_2d(-angle, x)
    return perpendicular(y, along, (x, along))


def _displacement(space, part, poses):
    """The component of d along the axis."""
    return jnp.dot(space.direction(poses[0], part.axis_a), separation(space, part, poses))


class PointOnCurve(AbstractPlanarPart, AbstractPair, AbstractConstraint):
    """A pin in a curved slot: point B stays on a curve fixed in `body_a`. Rows 1: `curve(B in the frame of body_a,
    parameters) = 0`.

    ```python
    bead = planar.Body("bead", mass=1.0, inertia=0.1, position=(0.5, 0.0))
    circle = lambda point, p: point @ point - p["radius"] ** 2
    ring = planar.PointOnCurve("ring", "ground", "bead", circle, parameters={"radius": 0.5})
    system = jaxmb.Scene([bead], joints=[ring]).compile()
    ```

    Its coordinate is `angle` [rad], `angle_b − angle_a`.

    **Arguments:**

    - `curve(point, parameters) -> scalar`: zero on the curve and with a gradient there; the point has shape (2,).
    - `point_b` [m], shape (2,): B fixed in `body_b`, default the origin of its frame.
    - `parameters`: numbers of the curve by name; they become parameters of the system, `"name.key"`.
    """

    curve: Callable[[Float[Array, "2"], Any], Scalar] = fields.function()
    point_b: fields.Number = fields.point(body=1, default=(0.0, 0.0))
    parameters: fields.Numbers = fields.numbers()
    rows: ClassVar[int] = 1
    quantities: ClassVar[Quantities] = {"angle": "angle"}
    rheonomic: ClassVar[bool] = False

    def residual(self, space, poses, t):
        return jnp.reshape(self.curve(self.followed(space, poses), self.parameters), (1,))

    def coordinates(self, space, poses):
        return {"angle": relative_angle(poses)}

    def followed(self, space, poses):
        """B on the curve, in the frame of `body_a`."""
        return space.body_point(poses[0], space.point(poses[1], self.point_b))

    def shapes(self, space, size):
        return ((1, pin(space.in_space(self.point_b), size)),)

    def shapes_along(self, space, size, followed):
        line, closed = level_curve(self.curve, self.parameters, followed, size)
        if closed:
            return ((0, Mesh.plate(line, size)),)
        points = np.column_stack([line, np.zeros(len(line))])
        return tuple((0, Cylinder.between(*ends, 0.5 * size)) for ends in itertools.pairwise(points))


class Gear(AbstractPlanarPart, AbstractPair, AbstractConstraint):
    """A pair of gears on a carrier. Rows 1: `(angle_b − angle_c) = ratio (angle_a − angle_c) + offset`, with the angle
    of the carrier, `angle_c`.

    ```python
    wheels = [planar.Body(name, mass=1.0, inertia=0.1, position=(x, 0.0)) for name, x in (("a", 0.0), ("b", 0.3))]
    axles = [planar.Revolute(f"{own.name} axle", "ground", own.name, point=own.position) for own in wheels]
    mesh = planar.Gear("mesh", "a", "b", ratio=-0.5)
    system = jaxmb.Scene(wheels, joints=[*axles, mesh]).compile()
    ```

    It has no coordinates; the joints of the axles have angles. A gear with losses is a `jaxmb.JointCoupling` of these
    angles with a `jaxmb.DryFriction`.

    **Arguments:**

    - `name`, of the pair; `body_a`, `body_b`: the two gears by name; another joint holds each on its axle.
    - `ratio`, not zero: speed of `body_b` over speed of `body_a`, both relative to the carrier; negative for an
        external mesh (−radius_a / radius_b).
    - `carrier`: the body that holds both axles, default the ground.
    - `offset` [rad], default from the given poses.
    """

    ratio: fields.Number = fields.parameter(unit="1", sign="nonzero")
    carrier: str = fields.body_name(default="ground")
    offset: fields.Number = fields.parameter(unit="rad", optional=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = False

    def complete(self, space, poses):
        return self.filled(offset=poses[1, 2] - poses[2, 2] - self.ratio * (poses[0, 2] - poses[2, 2]))

    def pitch_radii(self, distance):
        if self.ratio == 1:
            return None
        radius_b = -np.sign(self.ratio) * distance / (1 - self.ratio)
        return -self.ratio * radius_b, radius_b

    def residual(self, space, poses, t):
        a, b, c = poses[0, 2], poses[1, 2], poses[2, 2]
        return (b - c - self.ratio * (a - c) - self.offset)[None]


class RackAndPinion(AbstractPlanarPart, AbstractPair, AbstractConstraint):
    """A pinion (`body_a`) that rolls along a rack (`body_b`). Rows 1: `axis·(A − B) = −radius (angle_a − angle_b) +
    offset`, with the axis of the rack.

    ```python
    pinion = planar.Body("pinion", mass=1.0, inertia=0.1, position=(0.0, 0.2))
    axle = planar.Revolute("axle", "ground", "pinion", point=(0.0, 0.2))
    rack = planar.Body("rack", mass=1.0, inertia=0.1)
    rail = planar.Prismatic("rail", "ground", "rack", point=(0.0, 0.0), axis=(1.0, 0.0))
    mesh = planar.RackAndPinion("mesh", "pinion", "rack", radius=0.2)
    system = jaxmb.Scene([pinion, rack], joints=[axle, rail, mesh]).compile()
    ```

    A pinion on top of a rack along x, turning clockwise, moves towards +x of the rack. The pair has no coordinates; the
    joints of axle and rail have them.

    **Arguments:**

    - `name`, of the pair; `body_a`, `body_b`: the pinion and the rack by name; either may be `"ground"`.
    - `radius` [m] > 0 of the pinion; `point_a` [m], shape (2,): its centre A, fixed in `body_a`.
    - `point_b` [m], shape (2,): a point B of the rack; `axis_b`, unit, shape (2,): its direction; both fixed in
        `body_b`.
    - `offset` [m], default from the given poses.
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

    def followed(self, space, poses):
        """The centre of the pinion on the rack."""
        return space.body_point(poses[1], space.point(poses[0], self.point_a))

    def shapes_along(self, space, size, followed):
        x, y = self.axis_b
        along, below = followed @ self.axis_b, followed[0] @ np.array([-y, x]) - self.radius - size
        start, end = along.min() - 2 * self.radius, along.max() + 2 * self.radius
        middle = 0.5 * (start + end) * self.axis_b + below * np.array([-y, x])
        turn = np.arctan2(y, x) / 2
        rack = Box(
            (end - start, 2 * size, 2 * size),
            position=(*middle, 0.0),
            orientation=(np.cos(turn), 0.0, 0.0, np.sin(turn)),
        )
        return ((1, rack),)
