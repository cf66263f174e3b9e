"""Motions prescribed as functions of time."""

from collections.abc import Callable
from typing import ClassVar, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._types import Scalar
from ...linalg.rotations import norm
from ..base import AbstractConstraint, optional_number
from ..functions import numbers
from ..resolve import fill, label, vector

Quantity = Literal["angle", "x", "y", "distance"]


class Driver(AbstractConstraint):
    """A coordinate prescribed in time. Rows 1: `quantity = motion(t, parameters)`.

    **Arguments:**

    - `body_a`, `body_b`: the two bodies; `body_a="ground"` prescribes an absolute coordinate of `body_b`.
    - `quantity`: `"angle"` [rad], `angle_b − angle_a`; `"x"` or `"y"` [m], a coordinate of point B less that of point
        A along the axes of `body_a`; `"distance"` [m], between the points.
    - `motion(t, parameters)`: its value as a function of time, twice differentiable by JAX.
    - `parameters`: numbers of the motion by name; they become parameters of the system, `"name.key"`.
    - `point_a`, `point_b` [m], body-fixed, default the mass centres.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    quantity: Quantity = eqx.field(static=True, kw_only=True)
    motion: Callable[[Scalar, dict[str, Array]], Scalar] = eqx.field(static=True, kw_only=True)
    parameters: dict[str, Array] = eqx.field(converter=numbers, default_factory=dict, kw_only=True)
    point_a: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "2"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = True

    def __check_init__(self):
        if self.quantity not in get_args(Quantity):
            raise ValueError(f"{label(self)}: quantity must be one of {get_args(Quantity)}, got {self.quantity!r}.")

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        if self.quantity == "angle":
            if self.point_a is not None or self.point_b is not None:
                raise ValueError(f"{label(self)}: quantity='angle' has no points; leave out point_a and point_b.")
            return self
        part = self
        for field in ("point_a", "point_b"):
            part = fill(part, field, np.zeros(2))
            vector(part, field, getattr(part, field), 2)
        return part

    def value(self, space, poses):
        """The driven quantity at given poses."""
        if self.quantity == "angle":
            return poses[1, 2] - poses[0, 2]
        point_b = space.point(poses[1], self.point_b)
        if self.quantity == "distance":
            return norm(point_b - space.point(poses[0], self.point_a))
        relative = space.body_point(poses[0], point_b) - self.point_a
        return relative[0 if self.quantity == "x" else 1]

    def residual(self, space, poses, t):
        return jnp.reshape(self.value(space, poses) - self.motion(t, self.parameters), (1,))
