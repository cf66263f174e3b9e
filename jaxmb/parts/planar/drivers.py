"""Motions prescribed as functions of time, in the plane."""

from collections.abc import Callable
from typing import ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._types import Scalar
from ...linalg.rotations import norm
from .. import fields
from ..base import AbstractConstraint, AbstractPair, AbstractPlanarPart
from .joints import relative_angle


class Driver(AbstractPlanarPart, AbstractPair, AbstractConstraint):
    """A coordinate prescribed in time. Rows 1: `quantity = motion(t, parameters)`.

    ```python
    crank = planar.Body("crank", mass=1.0, inertia=0.1)
    pin = planar.Revolute("pin", "ground", "crank", point=(0.0, 0.0))
    ramp = {"motion": lambda t, p: p["rate"] * t, "parameters": {"rate": 2.0}}
    turn = planar.Driver("turn", "ground", "crank", quantity="angle", **ramp)
    system = jaxmb.Scene([crank], joints=[pin, turn]).compile()
    ```

    It has no coordinates of its own.

    **Arguments:**

    - `name`; `body_a`, `body_b`: the two bodies; `body_a="ground"` prescribes an absolute coordinate of `body_b`.
    - `quantity`: `"angle"` [rad], `angle_b − angle_a`; `"x"` or `"y"` [m], a coordinate of point B relative to point A
        in the axes of `body_a`; `"distance"` [m], between the points.
    - `motion(t, parameters)`: its value as a function of time, twice differentiable by JAX.
    - `parameters`: numbers of the motion by name; they become parameters of the system, `"name.key"`.
    - `point_a`, `point_b` [m], shape (2,), body-fixed, default the origins of the frames.
    """

    quantity: Literal["angle", "x", "y", "distance"] = fields.choice("angle", "x", "y", "distance")
    motion: Callable[[Scalar, dict[str, Array]], Scalar] = fields.function(kw_only=True)
    parameters: fields.Numbers = fields.numbers()
    point_a: fields.Number = fields.point(body=0, optional=True)
    point_b: fields.Number = fields.point(body=1, optional=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = True
    of_time: ClassVar[bool] = True

    def validate(self):
        if self.quantity == "angle" and not (self.point_a is None and self.point_b is None):
            raise ValueError(f"{self.label}: quantity='angle' has no points; remove point_a and point_b.")

    def complete(self, space, poses):
        return self if self.quantity == "angle" else self.filled(point_a=np.zeros(2), point_b=np.zeros(2))

    def value(self, space, poses):
        """The driven quantity at given poses."""
        if self.quantity == "angle":
            return relative_angle(poses)
        point_b = space.point(poses[1], self.point_b)
        if self.quantity == "distance":
            return norm(point_b - space.point(poses[0], self.point_a))
        relative = space.body_point(poses[0], point_b) - self.point_a
        return relative[0 if self.quantity == "x" else 1]

    def given_in_time(self, space, poses, velocities, t):
        del space, poses, velocities
        return jnp.asarray(self.motion(t, self.parameters))

    def residual(self, space, poses, t):
        return jnp.reshape(self.value(space, poses) - self.motion(t, self.parameters), (1,))
