"""Bodies of space, and moments of inertia of common shapes."""

from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ...linalg import rotations as rot
from ...linalg.arrays import namespace
from ..base import AbstractPart, number
from ..resolve import label, positive, vector
from .axes import unit_euler

Axis = Literal["x", "y", "z"]


def inertia_matrix(value: Any) -> Array:
    """An inertia matrix from itself or from its diagonal."""
    value = number(value)
    return namespace(value).diag(value) if value.shape == (3,) else value


class Body(AbstractPart):
    """A rigid body; its frame has its origin in the mass centre.

    **Arguments:**

    - `mass` [kg] > 0.
    - `inertia` [kg m²], shape (3, 3), about the mass centre in body axes, symmetric and positive definite (products of
        inertia enter as `−∫ x y dm`); or shape (3,), its diagonal, in principal axes.
    - `position` [m], shape (3,), of the mass centre, and `orientation`, shape (4,), unit Euler parameters (scalar
        first) from body to world: a guess that `assemble` improves.
    - `velocity` [m/s], shape (3,), of the mass centre in the world frame, and `angular_velocity` [rad/s], shape (3,),
        in the body frame, likewise.
    """

    name: str = eqx.field(static=True)
    mass: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    inertia: Float[Array, "3 3"] = eqx.field(converter=inertia_matrix, kw_only=True)
    position: Float[Array, "3"] = eqx.field(converter=number, default=(0.0, 0.0, 0.0), kw_only=True)
    orientation: Float[Array, "4"] = eqx.field(converter=number, default=(1.0, 0.0, 0.0, 0.0), kw_only=True)
    velocity: Float[Array, "3"] = eqx.field(converter=number, default=(0.0, 0.0, 0.0), kw_only=True)
    angular_velocity: Float[Array, "3"] = eqx.field(converter=number, default=(0.0, 0.0, 0.0), kw_only=True)
    dimension: ClassVar[int] = 3
    rotates: ClassVar[bool] = True

    def check(self):
        vector(self, "mass", self.mass[None], 1)
        positive(self, "mass", self.mass)
        _check_inertia(self)
        for field in ("position", "velocity", "angular_velocity"):
            vector(self, field, getattr(self, field), 3)
        unit_euler(self, "orientation", self.orientation)

    def pose(self):
        return np.append(self.position, rot.normalize(self.orientation))

    def velocities(self):
        return np.append(self.velocity, self.angular_velocity)


def _check_inertia(body: Body) -> None:
    inertia = np.asarray(body.inertia)
    if inertia.shape != (3, 3):
        raise ValueError(f"{label(body)}: inertia must have shape (3, 3) or (3,), got {inertia.shape}.")
    if not np.all(np.isfinite(inertia)):
        raise ValueError(f"{label(body)}: inertia must be finite, got {inertia.tolist()}.")
    if not np.allclose(inertia, inertia.T, rtol=0.0, atol=1e-9 * np.max(np.abs(inertia))):
        raise ValueError(f"{label(body)}: inertia must be symmetric, got {inertia.tolist()}; use (J + J.T) / 2.")
    moments = np.linalg.eigvalsh(inertia)
    # Moments this far below the largest are rounding of a zero, not a thin body.
    if moments[0] <= 1e-14 * np.max(np.abs(moments)):
        raise ValueError(
            f"{label(body)}: inertia must be positive definite, got principal moments {moments.tolist()} kg m²; a "
            "body without extension across an axis needs some: give a rod its radius, or use PointMass."
        )
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
        raise ValueError(
            f"{label(body)}: inertia violates the triangle inequality, no principal moment may exceed the sum of the "
            f"other two, got {moments.tolist()} kg m²; check that it is about the mass centre, in body axes, with "
            "products of inertia of the right sign."
        )


class PointMass(AbstractPart):
    """A mass without extension: three coordinates and no orientation.

    **Arguments:** `mass` [kg] > 0; `position` [m] and `velocity` [m/s], shape (3,), a guess that `assemble` improves.
    """

    name: str = eqx.field(static=True)
    mass: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    position: Float[Array, "3"] = eqx.field(converter=number, default=(0.0, 0.0, 0.0), kw_only=True)
    velocity: Float[Array, "3"] = eqx.field(converter=number, default=(0.0, 0.0, 0.0), kw_only=True)
    dimension: ClassVar[int] = 3
    rotates: ClassVar[bool] = False

    def check(self):
        vector(self, "mass", self.mass[None], 1)
        positive(self, "mass", self.mass)
        vector(self, "position", self.position, 3)
        vector(self, "velocity", self.velocity, 3)

    def pose(self):
        return self.position

    def velocities(self):
        return self.velocity


def _axial(along: Any, across: Any, axis: Axis) -> Float[Array, "3 3"]:
    if axis not in get_args(Axis):
        raise ValueError(f"axis must be one of {get_args(Axis)}, got {axis!r}.")
    moments = [number(across)] * 3
    moments["xyz".index(axis)] = number(along)
    xp = namespace(*moments)
    return xp.diag(xp.stack(moments))


def rod(mass: float, length: float, axis: Axis = "x", *, radius: float = 0.0) -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a uniform round rod along `axis` about its centre; `m l² / 12` across and zero along for a
    thin one.

    A thin rod has no inertia about its own axis, and so cannot be a `Body`: give it a `radius`.
    """
    return cylinder(mass, radius, length, axis)


def disc(mass: float, radius: float, axis: Axis = "z") -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a thin uniform disc whose axle is `axis`: `m r² / 2` about it, `m r² / 4` about a diameter."""
    return _axial(mass * radius**2 / 2, mass * radius**2 / 4, axis)


def box(mass: float, x: float, y: float, z: float) -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a uniform box with edges of lengths `x`, `y`, `z` [m] along the axes, about its centre."""
    x2, y2, z2 = number(x) ** 2, number(y) ** 2, number(z) ** 2
    moments = number(mass) / 12 * namespace(x2, y2, z2).stack([y2 + z2, z2 + x2, x2 + y2])
    return namespace(moments).diag(moments)


def sphere(mass: float, radius: float) -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a uniform solid sphere about its centre, `2 m r² / 5`."""
    moment = 2 * number(mass) * number(radius) ** 2 / 5
    return moment * np.eye(3, dtype=moment.dtype)


def cylinder(mass: float, radius: float, length: float, axis: Axis = "z") -> Float[Array, "3 3"]:
    """Inertia [kg m²] of a uniform solid cylinder along `axis` about its centre: `m r² / 2` along, `m (3 r² + l²) / 12`
    across.
    """
    return _axial(mass * radius**2 / 2, mass * (3 * radius**2 + length**2) / 12, axis)
