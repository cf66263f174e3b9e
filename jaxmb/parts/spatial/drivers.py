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
from .axes import angle, cosine_sine, resolve_axis, resolve_references, shift_in_a

Quantity = Literal["angle", "x", "y", "z", "distance"]


class Driver(AbstractConstraint):
    """A coordinate prescribed in time. Rows 1: `quantity = motion(t, parameters)`.

    An angle is prescribed as `sin(angle − motion) = 0`, written with products of direction components, so that any
    number of turns passes without a branch. It should be that of a joint which lets B turn about the axis only;
    otherwise it is the angle of the projections across the axis.

    **Arguments:**

    - `body_a`, `body_b`: the two bodies; `body_a="ground"` prescribes an absolute coordinate of `body_b`.
    - `quantity`: `"angle"` [rad], from `x_a` to `x_b` about `axis_a`; `"x"`, `"y"` or `"z"` [m], a coordinate of point
        B less that of point A along the axes of `body_a`; `"distance"` [m], between the points.
    - `motion(t, parameters)`: its value as a function of time, twice differentiable by JAX.
    - `parameters`: numbers of the motion by name; they become parameters of the system, `"name.key"`.
    - `point_a`, `point_b` [m], shape (3,), body-fixed, default the mass centres: for a coordinate or distance only.
    - `axis_a`, unit, shape (3,), fixed in `body_a`, or `axis` in the world: for an angle only.
    - `x_a`, `x_b`, unit, shape (3,), body-fixed and across the axis, between which an angle is measured; default such
        that it is zero at the given poses.
    """

    name: str = eqx.field(static=True)
    body_a: str = eqx.field(static=True)
    body_b: str = eqx.field(static=True)
    quantity: Quantity = eqx.field(static=True, kw_only=True)
    motion: Callable[[Scalar, dict[str, Array]], Scalar] = eqx.field(static=True, kw_only=True)
    parameters: dict[str, Array] = eqx.field(converter=numbers, default_factory=dict, kw_only=True)
    point_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    point_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    axis: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    x_a: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    x_b: Float[Array, "3"] = eqx.field(converter=optional_number, default=None, kw_only=True)
    rows: ClassVar[int] = 1
    rheonomic: ClassVar[bool] = True

    def __check_init__(self):
        if self.quantity not in get_args(Quantity):
            raise ValueError(f"{label(self)}: quantity must be one of {get_args(Quantity)}, got {self.quantity!r}.")
        turn, length = ("axis_a", "axis", "x_a", "x_b"), ("point_a", "point_b")
        for field in length if self.quantity == "angle" else turn:
            if getattr(self, field) is not None:
                raise ValueError(f"{label(self)}: {field} has no meaning for quantity={self.quantity!r}; leave it out.")

    @property
    def bodies(self):
        return (self.body_a, self.body_b)

    def resolve(self, space, poses):
        if self.quantity == "angle":
            return resolve_references(resolve_axis(self, space, poses), space, poses)
        part = self
        for field in ("point_a", "point_b"):
            part = fill(part, field, np.zeros(3))
            vector(part, field, getattr(part, field), 3)
        return part

    def value(self, space, poses):
        """The driven quantity at given poses; an angle in (−π, π]."""
        if self.quantity == "angle":
            return angle(space, self, poses)
        shift = shift_in_a(space, self, poses)
        if self.quantity == "distance":
            return norm(shift)
        return shift["xyz".index(self.quantity)]

    def residual(self, space, poses, t):
        motion = self.motion(t, self.parameters)
        if self.quantity == "angle":
            c, s = cosine_sine(space, self, poses)
            row = s * jnp.cos(motion) - c * jnp.sin(motion)
        else:
            row = self.value(space, poses) - motion
        return jnp.reshape(row, (1,))
