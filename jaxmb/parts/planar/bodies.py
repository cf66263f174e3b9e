"""Bodies of the plane, and moments of inertia of common shapes."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..base import AbstractPart, number
from ..resolve import positive, vector


class Body(AbstractPart):
    """A rigid body; its frame has its origin in the mass centre.

    **Arguments:** `mass` [kg] > 0; `inertia` [kg m²] > 0 about the mass centre; `position` [m], shape (2,), of the
    mass centre, and `angle` [rad], a guess that `assemble` improves; `velocity` [m/s], shape (2,), and
    `angular_velocity` [rad/s] likewise.
    """

    name: str = eqx.field(static=True)
    mass: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    inertia: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    position: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    angle: Float[Array, ""] = eqx.field(converter=number, default=0.0, kw_only=True)
    velocity: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    angular_velocity: Float[Array, ""] = eqx.field(converter=number, default=0.0, kw_only=True)
    dimension: ClassVar[int] = 2
    rotates: ClassVar[bool] = True

    def check(self):
        positive(self, "mass", self.mass)
        positive(self, "inertia", self.inertia)
        for field, size in (("position", 2), ("velocity", 2)):
            vector(self, field, getattr(self, field), size)
        for field in ("angle", "angular_velocity", "mass", "inertia"):
            vector(self, field, getattr(self, field)[None], 1)

    def pose(self):
        return np.append(self.position, self.angle)

    def velocities(self):
        return np.append(self.velocity, self.angular_velocity)


class PointMass(AbstractPart):
    """A mass without extension: two coordinates and no angle.

    **Arguments:** `mass` [kg] > 0; `position` [m] and `velocity` [m/s], shape (2,), a guess that `assemble` improves.
    """

    name: str = eqx.field(static=True)
    mass: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    position: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    velocity: Float[Array, "2"] = eqx.field(converter=number, default=(0.0, 0.0), kw_only=True)
    dimension: ClassVar[int] = 2
    rotates: ClassVar[bool] = False

    def check(self):
        positive(self, "mass", self.mass)
        vector(self, "position", self.position, 2)
        vector(self, "velocity", self.velocity, 2)
        vector(self, "mass", self.mass[None], 1)

    def pose(self):
        return self.position

    def velocities(self):
        return self.velocity


def rod(mass: float, length: float) -> float:
    """Moment of inertia [kg m²] of a thin uniform rod about its centre, `m l² / 12`."""
    return mass * length**2 / 12


def disc(mass: float, radius: float) -> float:
    """Moment of inertia [kg m²] of a uniform disc about its axis, `m r² / 2`."""
    return mass * radius**2 / 2


def box(mass: float, width: float, height: float) -> float:
    """Moment of inertia [kg m²] of a uniform rectangle about its centre, `m (w² + h²) / 12`."""
    return mass * (width**2 + height**2) / 12
