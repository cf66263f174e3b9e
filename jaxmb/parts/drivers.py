"""Motions prescribed as functions of time."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.rotations import norm
from . import fields
from .base import AbstractConstraint, AbstractPair, Poses
from .planar.joints import relative_angle
from .space import AbstractSpace, separation
from .spatial.axes import angle, cosine_sine, half_sine, measured_from_given_poses, offset_in_a

_OF_ANGLE, _OF_LENGTH = ("axis_a", "axis", "x_a", "x_b"), ("point_a", "point_b")


class AbstractDriver(AbstractConstraint):
    """A position constraint by which a quantity follows a function of time."""

    rheonomic: ClassVar[bool] = True

    @abc.abstractmethod
    def measured(self, space: AbstractSpace, poses: Poses) -> Float[Array, "rows"]:
        """The driven quantity."""

    @abc.abstractmethod
    def prescribed(self, t: Scalar) -> Any:
        """The value of the quantity at a time."""

    @abc.abstractmethod
    def unmet(self, space: AbstractSpace, poses: Poses, value: Any) -> Float[Array, "rows"]:
        """The residual for a prescribed value."""

    def residual(self, space, poses, t):
        return self.unmet(space, poses, self.prescribed(t))

    def drive_force(
        self, space: AbstractSpace, poses: Poses, t: Scalar, multipliers: Float[Array, "rows"]
    ) -> Float[Array, "rows"]:
        """The forces [N, of an angle N m] that do the power of the multipliers on the driven quantity."""
        _, pull = jax.vjp(lambda value: self.unmet(space, poses, value), jnp.asarray(self.prescribed(t)))
        return -pull(multipliers)[0].reshape(-1)


class Driver(AbstractPair, AbstractDriver):
    """A coordinate prescribed in time. Rows 1: `quantity = motion(t, parameters)`.

    ```python
    crank = planar.Body("crank", mass=1.0, inertia=0.1)
    pin = planar.Revolute("pin", "ground", "crank", point=(0.0, 0.0))
    ramp = {"motion": lambda t, p: p["rate"] * t, "parameters": {"rate": 2.0}}
    turn = planar.Driver("turn", "ground", "crank", quantity="angle", **ramp)
    system = jaxmb.Scene([crank], joints=[pin, turn]).compile()
    ```

    In space an angle is prescribed as `2 sin(ψ/2) = 0` with ψ = angle − motion in (−π, π], for any number of turns. The
    joint should let B turn about the axis only; otherwise the angle is measured between projections perpendicular to
    the axis. The driver has no coordinates.

    `motion["turn"].drive_force` is the force along the quantity [N, of an angle N m], shape (times,). It is positive
    where it increases the quantity: force × rate is the power that the driver puts into the machine.

    **Arguments:**

    - `quantity`: `"angle"` [rad], in the plane `angle_b − angle_a`, in space from `x_a` to `x_b` about `axis_a`; `"x"`,
        `"y"` or `"z"` [m], a coordinate of point B relative to point A in the axes of `body_a`; `"distance"` [m],
        between the points. With `body_a="ground"` it is an absolute coordinate of `body_b`.
    - `motion(t, parameters)`: its value as a function of time, twice differentiable by JAX.
    - `parameters`: numbers of the motion by name; they become parameters of the system, `"name.key"`.
    - `point_a`, `point_b` [m], body-fixed, default the origins of the frames: not for an angle.
    - `axis_a`, unit, shape (3,), fixed in `body_a`, or `axis` in the world: for an angle in space.
    - `x_a`, `x_b`, unit, shape (3,), body-fixed and perpendicular to this axis: the angle is measured between them; by
        default it is zero at the given poses.
    """

    quantity: Literal["angle", "x", "y", "z", "distance"] = fields.choice("angle", "x", "y", "z", "distance")
    motion: Callable[[Scalar, dict[str, Array]], Scalar] = fields.function(kw_only=True)
    parameters: fields.Numbers = fields.numbers()
    point_a: fields.Number = fields.point(body=0, optional=True)
    point_b: fields.Number = fields.point(body=1, optional=True)
    axis_a: fields.Number = fields.axis(body=0, optional=True, dimension=3)
    axis: fields.Number = fields.axis(body=None, gives=("axis_a",), needed=False, dimension=3)
    x_a: fields.Number = fields.axis(body=0, optional=True, dimension=3)
    x_b: fields.Number = fields.axis(body=1, optional=True, dimension=3)
    rows: ClassVar[int] = 1
    of_time: ClassVar[bool] = True

    def __check_init__(self):
        for field in _OF_LENGTH if self.quantity == "angle" else _OF_ANGLE:
            if getattr(self, field) is not None and self.quantity in ("angle", "x", "y", "z", "distance"):
                raise ValueError(f"{self.label}: {field} has no meaning for quantity={self.quantity!r}; remove it.")

    def complete(self, space, poses):
        d = space.dimension
        if self.quantity == "z" and d == 2:
            raise ValueError(f"{self.label}: quantity='z' belongs to spatial scenes.")
        if self.quantity != "angle":
            return self.filled(point_a=np.zeros(d), point_b=np.zeros(d))
        if d == 3 and self.axis_a is None:
            raise ValueError(f"{self.label}: give axis_a (fixed in {self.body_a!r}) or axis (world).")
        return self if d == 2 else measured_from_given_poses(self, space, poses)

    def _value(self, space, poses):
        """The driven quantity; an angle in space in (−π, π]."""
        if self.quantity == "angle":
            return relative_angle(poses) if space.dimension == 2 else angle(space, self, poses)
        if self.quantity == "distance":
            return norm(separation(space, self, poses))
        return offset_in_a(space, self, poses)["xyz".index(self.quantity)]

    def measured(self, space, poses):
        return jnp.reshape(self._value(space, poses), (1,))

    def prescribed(self, t):
        return self.motion(t, self.parameters)

    def given_in_time(self, space, poses, velocities, t):
        del space, poses, velocities
        return jnp.asarray(self.prescribed(t))

    def unmet(self, space, poses, value):
        if self.quantity == "angle" and space.dimension == 3:
            c, s = cosine_sine(space, self, poses)
            sine, cosine = s * jnp.cos(value) - c * jnp.sin(value), c * jnp.cos(value) + s * jnp.sin(value)
            return half_sine(jnp.reshape(sine, (1,)), jnp.reshape(cosine, ()))
        return jnp.reshape(self._value(space, poses) - value, (1,))
