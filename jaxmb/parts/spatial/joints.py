"""Spatial joints.

In their classes `A` and `B` are the world positions of the two points, `d = B − A`, and `a` and `b` the two axes. `u`
and `v` are unit vectors fixed in `body_a` and perpendicular to `a`; all rows are Φ = 0.

Parallel axes point the same way. Their rows are the tilt: the components along u and v of `2 sin(θ/2)` times the unit
vector of `b` across `a`, with the angle θ between the axes. The tilt vanishes only if the axes agree, not if they are
opposite.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from ...linalg.rotations import conjugate, cross, dot, from_axis_angle, multiply, rotate, unrotate
from .. import fields
from ..base import AbstractAxisJoint, AbstractJoint, AbstractSpatialPart, PathKind, Quantities
from ..coordinate_parts import turns
from ..elements import coincident, in_planes, perpendicular
from ..shapes import Cylinder, ball, pin, sleeve
from ..space import nearest_to_origin, separation
from .axes import (
    across,
    aligned,
    angle,
    cosine_sine,
    direction_in_a,
    displacement_along,
    half_sine,
    joints_through_b,
    measured_from_given_poses,
    offset_in_a,
    offset_rate_in_a,
    parallel,
    perpendiculars,
    relative_orientation,
    rotation_error,
    rotation_vector,
    turn_about,
    turning_rate,
    with_given_orientation,
)


def _parallel(space, part, poses):
    b = direction_in_a(space, poses, part.axis_b)
    return half_sine(across(part.axis_a, b), dot(part.axis_a, b))


class AbstractOriented(AbstractSpatialPart, AbstractJoint):
    """A joint with a given relative attitude.

    **Arguments:**

    - `orientation`, shape (4,), unit Euler parameters: the attitude of `body_b` relative to `body_a` that is kept, or
        at zero coordinates; default from the given poses.
    """

    orientation: fields.Number = fields.attitude(optional=True)

    def complete(self, space, poses):
        return with_given_orientation(self, poses)


class Spherical(AbstractOriented):
    """A ball: points A and B of two bodies coincide. Rows 3: `d = 0`, with d from A to B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    ball = spatial.Spherical("ball", "ground", "arm", point=(0.0, 0.0, 0.0))
    system = jaxmb.Scene([arm], joints=[ball]).compile()
    ```

    Its coordinate is `rotation` [rad], shape (3,): the rotation vector, in the axes of `body_a`, of the shortest turn
    from `orientation` to the relative attitude; zero at the given poses, unless `orientation` is given. It is not
    smooth at half a turn.
    """

    rows: ClassVar[int] = 3
    quantities: ClassVar[Quantities] = {"rotation": "rotation"}

    @property
    def elements(self):
        return (coincident(self),)

    def residual(self, space, poses, t):
        return separation(space, self, poses)

    def coordinates(self, space, poses):
        return {"rotation": rotation_vector(self, poses)}

    def elementary_joints(self, space, poses):
        return joints_through_b(space, self, poses, rotation=np.zeros(3))

    def shapes(self, space, size):
        return ((0, ball(self.point_a, size)),)


class AbstractAxial(AbstractSpatialPart, AbstractJoint):
    """A joint with an axis in each body, about which the bodies turn.

    **Arguments:**

    - `axis_a`, `axis_b`, unit, shape (3,): the axis fixed in `body_a` and in `body_b`; or `axis`, unit, shape (3,):
        both in the world at the given poses.
    - `x_a`, `x_b`, unit, shape (3,), fixed in `body_a` and in `body_b` and perpendicular to the axis: the directions
        between which the angle is measured; default two that coincide at the given poses.
    """

    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis_b: fields.Number = fields.axis(body=1, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a", "axis_b"))
    x_a: fields.Number = fields.axis(body=0, optional=True)
    x_b: fields.Number = fields.axis(body=1, optional=True)
    quantities: ClassVar[Quantities] = {"angle": "angle"}

    def complete(self, space, poses):
        return measured_from_given_poses(self, space, poses)


class Revolute(AbstractAxial):
    """A hinge: points A and B of two bodies coincide and two axes are parallel. Rows 5: d from A to B (3), and the tilt
    (2): with the angle θ between the axes, `2 sin(θ/2)` times the unit vector of the axis of B across the axis of A.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    system = jaxmb.Scene([arm], joints=[hinge]).compile()
    ```

    Its coordinate is `angle` [rad], the turn of `body_b` in `body_a` about the axis, from `x_a` to `x_b`: zero at the
    given poses, unless these are given. The angle of a `planar.Revolute` is the difference of the angles of its bodies.
    """

    rows: ClassVar[int] = 5

    @property
    def elements(self):
        return coincident(self), *parallel(self)

    def residual(self, space, poses, t):
        return jnp.concatenate([separation(space, self, poses), _parallel(space, self, poses)])

    def coordinates(self, space, poses):
        return {"angle": angle(space, self, poses)}

    def coordinate_rates(self, space, poses, velocities):
        return {"angle": turning_rate(space, self, poses, velocities)}

    def elementary_joints(self, space, poses):
        return joints_through_b(space, self, poses, angle=space.direction(poses[0], self.axis_a))

    def shapes(self, space, size):
        return ((0, pin(self.point_a, size, self.axis_a)),)


class Universal(AbstractSpatialPart, AbstractJoint):
    """A Cardan joint: points A and B of two bodies coincide and two axes stay perpendicular. Rows 4: d from A to B (3),
    and the product of the two axes (1).

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    axes = {"axis_a_W": (0.0, 1.0, 0.0), "axis_b_W": (0.0, 0.0, 1.0)}
    cross = spatial.Universal("cross", "ground", "arm", point=(0.0, 0.0, 0.0), **axes)
    system = jaxmb.Scene([arm], joints=[cross]).compile()
    ```

    Its coordinates [rad] are `angle_a`, the turn of the cross in `body_a` about `axis_a`, and `angle_b`, the turn of
    `body_b` on the cross about `axis_b`; both are zero at the given poses. The relative attitude is the product of the
    turn by `angle_a`, the attitude at zero, and the turn by `angle_b`. The angles are smooth in every position of the
    joint.

    **Arguments:**

    - `axis_a`, `axis_b`, unit, shape (3,): the arms of the cross, fixed in `body_a` and in `body_b`; each may be given
        in the world at the given poses instead, as `axis_a_W` and `axis_b_W`.
    - `x_a`, `x_b`, unit, shape (3,): at zero angles, the direction in `body_a` of `axis_b`, and the direction in
        `body_b` of `axis_a`; default from the given poses.
    """

    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis_b: fields.Number = fields.axis(body=1, optional=True)
    axis_a_W: fields.Number = fields.axis(body=None, gives=("axis_a",))
    axis_b_W: fields.Number = fields.axis(body=None, gives=("axis_b",))
    x_a: fields.Number = fields.axis(body=0, optional=True)
    x_b: fields.Number = fields.axis(body=1, optional=True)
    rows: ClassVar[int] = 4
    quantities: ClassVar[Quantities] = {"angle_a": "angle", "angle_b": "angle"}

    def validate(self):
        if self.axis_a_W is not None and self.axis_b_W is not None:
            cosine = float(self.axis_a_W @ self.axis_b_W)
            if abs(cosine) > 1e-6:
                raise ValueError(
                    f"{self.label}: axis_a_W and axis_b_W must be perpendicular, but their product is {cosine:.6g}."
                )

    @property
    def elements(self):
        return coincident(self), perpendicular(self.axis_a, self.axis_b)

    def residual(self, space, poses, t):
        cosine = dot(self.axis_a, direction_in_a(space, poses, self.axis_b))
        return jnp.concatenate([separation(space, self, poses), cosine[None]])

    def complete(self, space, poses):
        # The direction of each axis in the other body, perpendicular to the other body's axis.
        return self.filled(
            x_a=direction_in_a(space, poses, self.axis_b), x_b=direction_in_a(space, poses[::-1], self.axis_a)
        )

    def coordinates(self, space, poses):
        arm_b, arm_a = direction_in_a(space, poses, self.axis_b), direction_in_a(space, poses[::-1], self.axis_a)
        return {
            "angle_a": turn_about(self.axis_a, self.x_a, arm_b),
            "angle_b": -turn_about(self.axis_b, self.x_b, arm_a),
        }

    def elementary_joints(self, space, poses):
        first, last = space.direction(poses[0], self.axis_a), space.direction(poses[1], self.axis_b)
        return joints_through_b(space, self, poses, angle_a=first, angle_b=last)

    def shapes(self, space, size):
        return (0, pin(self.point_a, size, self.axis_a)), (1, pin(self.point_b, size, self.axis_b))


class Gimbal(AbstractOriented):
    """Three hinges in succession about perpendicular axes through one point: a ball with angles. Rows 3: d from A to B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    axes = {"axis_1_W": (1.0, 0.0, 0.0), "axis_2_W": (0.0, 1.0, 0.0), "axis_3_W": (0.0, 0.0, 1.0)}
    gimbal = spatial.Gimbal("gimbal", "ground", "arm", point=(0.0, 0.0, 0.0), **axes)
    system = jaxmb.Scene([arm], joints=[gimbal]).compile()
    ```

    Its coordinates are `angle_1`, `angle_2` and `angle_3` [rad], the turns about the three axes; the first is fixed in
    `body_a`, the third in `body_b`. All are zero at the given poses, unless `orientation` is given. The second lies in
    [−π/2, π/2]; the angles are smooth except at the ends of this range.

    **Arguments:**

    - `axis_1`, `axis_2`, `axis_3`, unit, shape (3,), perpendicular to each other: the axes at zero angles, in the axes
        of `body_a`; or in the world at the given poses, `axis_1_W`, `axis_2_W`, `axis_3_W`.
    """

    axis_1: fields.Number = fields.axis(body=0, optional=True)
    axis_2: fields.Number = fields.axis(body=0, optional=True)
    axis_3: fields.Number = fields.axis(body=0, optional=True)
    axis_1_W: fields.Number = fields.axis(body=None, gives=("axis_1",))
    axis_2_W: fields.Number = fields.axis(body=None, gives=("axis_2",))
    axis_3_W: fields.Number = fields.axis(body=None, gives=("axis_3",))
    rows: ClassVar[int] = 3
    quantities: ClassVar[Quantities] = {"angle_1": "angle", "angle_2": "angle", "angle_3": "angle"}

    def complete(self, space, poses):
        triad = np.stack([self.axis_1, self.axis_2, self.axis_3])
        if np.max(np.abs(triad @ triad.T - np.eye(3))) > 1e-6:
            raise ValueError(f"{self.label}: the three axes must be perpendicular to each other, got {triad.tolist()}.")
        return super().complete(space, poses)

    @property
    def elements(self):
        return (coincident(self),)

    def residual(self, space, poses, t):
        return separation(space, self, poses)

    def coordinates(self, space, poses):
        triad = jnp.stack([self.axis_1, self.axis_2, self.axis_3])
        # The axes, turned with B.
        turned = multiply(relative_orientation(poses), conjugate(self.orientation))
        turned_axes = jnp.stack([rotate(turned, axis) for axis in triad], axis=1)
        c = jnp.sum(triad[:, :, None] * turned_axes[None], axis=1)
        # With a left-handed triad the turns about its axes, and so all sines, have the other sign.
        hand = jnp.where(dot(cross(self.axis_1, self.axis_2), self.axis_3) > 0, 1.0, -1.0)
        return {
            "angle_1": jnp.arctan2(-hand * c[1, 2], c[2, 2]),
            "angle_2": jnp.arctan2(hand * c[0, 2], jnp.sqrt(c[1, 2] ** 2 + c[2, 2] ** 2)),
            "angle_3": jnp.arctan2(-hand * c[0, 1], c[0, 0]),
        }

    def elementary_joints(self, space, poses):
        first = from_axis_angle(self.axis_1, self.coordinates(space, jnp.asarray(poses))["angle_1"])
        axes = (
            self.axis_1,
            rotate(first, self.axis_2),
            direction_in_a(space, poses, unrotate(self.orientation, self.axis_3)),
        )
        directions = {f"angle_{k}": space.direction(poses[0], axis) for k, axis in enumerate(axes, 1)}
        return joints_through_b(space, self, poses, **directions)


class AbstractSliding(AbstractAxial):
    """A joint whose two axes stay on one line, along which one body also slides."""

    quantities: ClassVar[Quantities] = {"angle": "angle", "displacement": "length"}
    path_kind: ClassVar[PathKind] = "rod"

    def coordinates(self, space, poses):
        return {"angle": angle(space, self, poses), "displacement": displacement_along(space, self, poses)}

    def _rates(self, space, poses, velocities):
        shifting = dot(self.axis_a, offset_rate_in_a(space, self, poses, velocities))
        return {"angle": turning_rate(space, self, poses, velocities), "displacement": shifting}

    def pictured(self, space):
        return self.with_fields(point_b=nearest_to_origin(self.point_b, self.axis_b))

    def shapes(self, space, size):
        return ((1, sleeve(self.point_b, size, self.axis_b)),)


class Cylindrical(AbstractSliding):
    """A pin that turns and slides: two axes stay on one line. Rows 4: the tilt (2) as in `Revolute`, and the components
    across the axis (2) of d from A to B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    sleeve = spatial.Cylindrical("sleeve", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    system = jaxmb.Scene([arm], joints=[sleeve]).compile()
    ```

    Its coordinates are `angle` [rad], the turn of `body_b` in `body_a` about the axis, from `x_a` to `x_b`: zero at the
    given poses, unless these are given; and `displacement` [m], from A to B along the axis, zero at the given poses if
    a world `point` gives both.
    """

    rows: ClassVar[int] = 4
    slides: ClassVar[tuple[str, ...]] = ("angle", "displacement")

    @property
    def elements(self):
        return *parallel(self), *in_planes(self, perpendiculars(self.axis_a))

    def residual(self, space, poses, t):
        shift = offset_in_a(space, self, poses)
        return jnp.concatenate([_parallel(space, self, poses), across(self.axis_a, shift)])

    def coordinate_rates(self, space, poses, velocities):
        return self._rates(space, poses, velocities)

    def elementary_joints(self, space, poses):
        axis = space.direction(poses[0], self.axis_a)
        return joints_through_b(space, self, poses, displacement=axis, angle=axis)


class Screw(AbstractSliding):
    """A screw: two axes stay on one line and turning advances B. Rows 5: the rows of `Cylindrical` (4), and the thread
    (1).

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    screw = spatial.Screw("screw", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), pitch=0.02)
    system = jaxmb.Scene([arm], joints=[screw]).compile()
    ```

    Its coordinates are `angle` [rad], the turn of `body_b` in `body_a` about the axis, from `x_a` to `x_b`: zero at the
    given poses, unless these are given; and `displacement` [m], from A to B along the axis, zero at the given poses if
    a world `point` gives both. The displacement tells the full turns of the angle, in every state.

    With the angle θ, the displacement s and ψ = θ − 2π (s − offset)/pitch, the last row is `pitch/2π · 2 sin(ψ/2) = 0`
    with ψ in (−π, π]. It is periodic in θ and in s, like the screw, and holds for any number of turns; near zero its
    value is the axial error [m].

    Friction in the thread is `jaxmb.DryFriction("thread", "screw.angle", coefficient=c, radius=r)`, and in a collar
    under the same load a second one with its radius. With the coefficient μ of the thread, its mean radius r and
    its slope `tan λ = pitch / (2π r)`, c is `μ (1 + tan²λ) / (1 ∓ μ tan λ)`, with the minus where the load is
    raised; between both lies `μ (1 + tan²λ)`. For a trapezoidal thread with the angle α of its flanks, μ is divided
    by `cos(α/2)`. The screw locks itself where c is at least tan λ.

    **Arguments:**

    - `pitch` [m], not zero: the advance of B along the axis per turn, positive for a right-handed screw.
    - `offset` [m]: the displacement at zero angle, default from the given poses.
    """

    pitch: fields.Number = fields.parameter(unit="m", sign="nonzero")
    offset: fields.Number = fields.parameter(unit="m", optional=True)
    rows: ClassVar[int] = 5

    @property
    def periodic(self):
        return frozenset()

    def complete(self, space, poses):
        part = measured_from_given_poses(self, space, poses)
        advance = part.pitch * angle(space, part, poses) / (2 * np.pi)
        return part.filled(offset=part.axis_a @ offset_in_a(space, part, poses) - advance)

    def coordinates(self, space, poses):
        out = super().coordinates(space, poses)
        near = (out["displacement"] - self.offset) * (2 * np.pi) / self.pitch
        return out | {"angle": out["angle"] + turns(near - out["angle"])}

    def coordinate_rates(self, space, poses, velocities):
        return self._rates(space, poses, velocities)

    def followed(self, space, poses):
        return displacement_along(space, self, poses)

    def shapes(self, space, size):
        return ((0, sleeve(self.point_a, size, self.axis_a)),)

    def shapes_along(self, space, size, followed):
        # The rod is in B, and passes the nut at all times.
        start = self.point_b + (min(0.0, *-followed) - 4 * size) * self.axis_b
        end = self.point_b + (max(0.0, *-followed) + 4 * size) * self.axis_b
        return ((1, Cylinder.between(start, end, size)),)

    def residual(self, space, poses, t):
        shift = offset_in_a(space, self, poses)
        lead = self.pitch / (2 * np.pi)
        turn = (dot(self.axis_a, shift) - self.offset) / lead
        c, s = cosine_sine(space, self, poses)
        cosine, sine = c * jnp.cos(turn) + s * jnp.sin(turn), s * jnp.cos(turn) - c * jnp.sin(turn)
        thread = lead * half_sine(sine[None], cosine)
        return jnp.concatenate([_parallel(space, self, poses), across(self.axis_a, shift), thread])


class Prismatic(AbstractOriented, AbstractAxisJoint):
    """A slide: point B stays on the line through A without turning. Rows 5: the components across the axis (2) of d
    from A to B, and the rotation (3).

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    slide = spatial.Prismatic("slide", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    system = jaxmb.Scene([arm], joints=[slide]).compile()
    ```

    The rotation is twice the vector part of the Euler parameters from `orientation` to the relative attitude: the
    rotation vector [rad] if small, and zero only if they agree, for either sign of the bodies' Euler parameters.

    Its coordinate is `displacement` [m], from A to B along the axis. If a world `point` gives both points, it is zero
    at the given poses, wherever the body is; give `point_a` and `point_b` for another origin. The place of B along the
    axis does not affect the motion, and a picture shows the slide next to the mass centre of `body_b`.
    """

    rows: ClassVar[int] = 5
    quantities: ClassVar[Quantities] = {"displacement": "length"}
    path_kind: ClassVar[PathKind] = "rod"

    @property
    def elements(self):
        return *in_planes(self, perpendiculars(self.axis_a)), *aligned(self)

    def residual(self, space, poses, t):
        return jnp.concatenate([across(self.axis_a, offset_in_a(space, self, poses)), rotation_error(self, poses)])

    def coordinates(self, space, poses):
        return {"displacement": displacement_along(space, self, poses)}

    def coordinate_rates(self, space, poses, velocities):
        return {"displacement": dot(self.axis_a, offset_rate_in_a(space, self, poses, velocities))}

    def elementary_joints(self, space, poses):
        return joints_through_b(space, self, poses, displacement=space.direction(poses[0], self.axis_a))

    def pictured(self, space):
        return self.with_fields(point_b=nearest_to_origin(self.point_b, unrotate(self.orientation, self.axis_a)))

    def shapes(self, space, size):
        return ((1, sleeve(self.point_b, size, unrotate(self.orientation, self.axis_a))),)


class Planar(AbstractAxial):
    """A sliding face: point B stays in the plane through A normal to the axis, the axes parallel. Rows 3: the tilt (2)
    as in `Revolute`, and the component along the axis (1) of d from A to B.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    face = spatial.Planar("face", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    system = jaxmb.Scene([arm], joints=[face]).compile()
    ```

    Its coordinates are `angle` [rad], the turn of `body_b` in `body_a` about the axis, from `x_a` to `x_b`: zero at the
    given poses, unless these are given; and `displacement` [m], shape (2,), the components of d along `x_a` and along
    the cross product of `axis_a` and `x_a`: zero at the given poses if a world `point` gives both.
    """

    rows: ClassVar[int] = 3
    quantities: ClassVar[Quantities] = {"displacement": "length", "angle": "angle"}
    slides: ClassVar[tuple[str, ...]] = ("displacement",)

    @property
    def elements(self):
        return *parallel(self), *in_planes(self, [self.axis_a])

    def residual(self, space, poses, t):
        height = dot(self.axis_a, offset_in_a(space, self, poses))
        return jnp.concatenate([_parallel(space, self, poses), height[None]])

    def coordinates(self, space, poses):
        shift, y_a = offset_in_a(space, self, poses), cross(self.axis_a, self.x_a)
        displacement = jnp.stack([dot(self.x_a, shift), dot(y_a, shift)])
        return {"displacement": displacement, "angle": angle(space, self, poses)}

    def coordinate_rates(self, space, poses, velocities):
        shifting, y_a = offset_rate_in_a(space, self, poses, velocities), cross(self.axis_a, self.x_a)
        displacement = jnp.stack([dot(self.x_a, shifting), dot(y_a, shifting)])
        return {"displacement": displacement, "angle": turning_rate(space, self, poses, velocities)}

    def elementary_joints(self, space, poses):
        ways = {"x": self.x_a, "y": cross(self.axis_a, self.x_a)}
        (turn,) = joints_through_b(space, self, poses, angle=space.direction(poses[0], self.axis_a))
        shift = offset_in_a(space, self, poses)
        slides = (
            turn._replace(kind="slide", name=name, axis=space.direction(poses[0], way), value=dot(way, shift))
            for name, way in ways.items()
        )
        return [*slides, turn]


class Fixed(AbstractOriented):
    """A weld: points A and B of two bodies coincide and B does not turn in A. Rows 6: d from A to B (3), and the
    rotation (3) as in `Prismatic`.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    weld = spatial.Fixed("weld", "ground", "arm", point=(0.0, 0.0, 0.0))
    system = jaxmb.Scene([arm], joints=[weld]).compile()
    ```

    It leaves no motion and has no coordinates.
    """

    rows: ClassVar[int] = 6

    @property
    def elements(self):
        return coincident(self), *aligned(self)

    def residual(self, space, poses, t):
        return jnp.concatenate([separation(space, self, poses), rotation_error(self, poses)])

    def elementary_joints(self, space, poses):
        return []
