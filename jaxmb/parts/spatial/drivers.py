"""Motions prescribed as functions of time, in space."""

from collections.abc import Callable
from typing import ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._types import Scalar
from ...linalg.rotations import norm
from .. import fields
from ..base import AbstractConstraint, AbstractPair, AbstractSpatialPart
from .axes import angle, cosine_sine, half_sine, measured_from_given_poses, offset_in_a


class Driver(AbstractSpatialPart, AbstractPair, AbstractConstraint):
    """A coordinate prescribed in time. Rows 1: `quantity = motion(t, parameters)`.

    ```python
    arm = spatial.Body("arm", mass=1.0, inertia=spatial.box(1.0, 1.0, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    hinge = spatial.Revolute("hinge", "ground", "arm", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    ramp = {"motion": lambda t, p: p["rate"] * t, "parameters": {"rate": 2.0}}
    turn = spatial.Driver("turn", "ground", "arm", quantity="angle", axis=(0.0, 0.0, 1.0), **ramp)
    system = jaxmb.Scene([arm], joints=[hinge, turn]).compile()
    ```

    An angle is prescribed as `2 sin(ψ/2) = 0` with ψ = angle − motion in (−π, π], written with products of direction
    components, which holds for any number of turns. The joint should let B turn about the axis only; otherwise the
    angle is that of the projections perpendicular to the axis. The driver has no coordinates of its own.

    **Arguments:**

    - `name`; `body_a`, `body_b`: the two bodies; `body_a="ground"` prescribes an absolute coordinate of `body_b`.
    - `quantity`: `"angle"` [rad], from `x_a` to `x_b` about `axis_a`; `"x"`, `"y"` or `"z"` [m], a coordinate of point
        B relative to point A in the axes of `body_a`; `"distance"` [m], between the points.
    - `motion(t, parameters)`: its value as a function of time, twice differentiable by JAX.
    - `parameters`: numbers of the motion by name; they become parameters of the system, `"name.key"`.
    - `point_a`, `point_b` [m], shape (3,), body-fixed, default the origins of the frames: for a coordinate or distance
        only.
    - `axis_a`, unit, shape (3,), fixed in `body_a`, or `axis` in the world: for an angle only.
    - `x_a`, `x_b`, unit, shape (3,), body-fixed and perpendicular to the axis: an angle is measured between them; by
        default it is zero at the given poses.
    """

    quantity: Literal["angle", "x", "y", "z", "distance"] = fields.choice("angle", "x", "y", "z", "distance")
    motion: Callable[[Scalar, dict[str, Array]], Scalar] = fields.function(kw_only=True)
    parameters: fields.Numbers = fields.numbers()
    point_a: fields.Number = fields.point(body=0, optional=True)
    point_b: fields.Number = fields.point(body=1, optional=True)
    axis_a: fields.Number = fields.axis(body=0, optional=True)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",), needed=False)
    x_a: fields.Number = fields.axis(body=0, optional=True)
    x_b: fields.Number = fields.axis(body=1, optional=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = True
    of_time: ClassVar[bool] = True

    def __check_init__(self):
        turn, length = ("axis_a", "axis", "x_a", "x_b"), ("point_a", "point_b")
        for field in length if self.quantity == "angle" else turn:
            if getattr(self, field) is not None and self.quantity in ("angle", "x", "y", "z", "distance"):
                raise ValueError(f"{self.label}: {field} has no meaning for quantity={self.quantity!r}; remove it.")

    def validate(self):
        if self.quantity == "angle" and self.axis is None and self.axis_a is None:
            raise ValueError(f"{self.label}: give axis_a (fixed in {self.body_a!r}) or axis (world).")

    def complete(self, space, poses):
        if self.quantity == "angle":
            return measured_from_given_poses(self, space, poses)
        return self.filled(point_a=np.zeros(3), point_b=np.zeros(3))

    def value(self, space, poses):
        """The driven quantity at given poses; an angle in (−π, π]."""
        if self.quantity == "angle":
            return angle(space, self, poses)
        shift = offset_in_a(space, self, poses)
        if self.quantity == "distance":
            return norm(shift)
        return shift["xyz".index(self.quantity)]

    def given_in_time(self, space, poses, velocities, t):
        del space, poses, velocities
        return jnp.asarray(self.motion(t, self.parameters))

    def residual(self, space, poses, t):
        motion = self.motion(t, self.parameters)
        if self.quantity == "angle":
            c, s = cosine_sine(space, self, poses)
            sine, cosine = s * jnp.cos(motion) - c * jnp.sin(motion), c * jnp.cos(motion) + s * jnp.sin(motion)
            return half_sine(jnp.reshape(sine, (1,)), jnp.reshape(cosine, ()))
        return jnp.reshape(self.value(space, poses) - motion, (1,))
