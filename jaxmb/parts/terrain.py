"""Terrains: height as a smooth function of the place, for contact with the ground.

```python
from jaxmb import terrain
level, hill = terrain.Flat(), terrain.Slope(0.1, level=-0.2)
bump, ramp = terrain.Bump(start=2.0, length=0.5, peak=0.1), terrain.Ramp(start=5.0, length=2.0, rise=0.3)
waves = terrain.Sinusoid(amplitude=0.05, wavelength=3.0)
measured = terrain.Spline(x=[0.0, 1.0, 2.0, 3.0], heights=[0.0, 0.1, 0.05, 0.0])
bowl = terrain.Surface(lambda place, p: p["curvature"] * place @ place / 2, parameters={"curvature": 0.1})
```

A place is the world position without the vertical: (x,) in a planar scene, where y is up, and (x, y) in a spatial one,
where z is up. A profile along x is constant along y, so it serves in both.
"""

import abc
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..linalg.arrays import is_traced
from ..linalg.rotations import norm
from . import fields, local_spline
from .base import AbstractLaw
from .kinks import clipped
from .smooth import step

__all__ = ["AbstractTerrain", "Bump", "Flat", "Ramp", "Sinusoid", "Slope", "Spline", "Surface"]

Place = Float[Array, "h"]
# The fraction of a bump or wave within which the ground rises or falls once.
_SHARE = 0.25
# A motion that ends where the ground does comes this near to it, relative to the place, and to one metre.
_NEAR = 1e-6


class AbstractTerrain(AbstractLaw):
    """Ground whose height is a function of the place; its numbers are parameters, `"contact.terrain.field"`."""

    def __check_init__(self):
        if not is_traced(self):
            fields.check_numbers(self, type(self).__name__, 2)

    @abc.abstractmethod
    def height(self, place: Place) -> Float[Array, ""]:
        """Height [m] above the world's origin at a place [m], continuously differentiable."""

    def facing(self, point: Float[Array, "d"]) -> tuple[Float[Array, "d"], Float[Array, ""] | None]:
        """The gradient of the `distance` of a point [m], and its length, None if that is one."""
        gradient = jax.grad(lambda point: distance(self, point))(point)
        return gradient, norm(gradient)

    def facing_rate(self, point: Float[Array, "d"], velocity: Float[Array, "d"]) -> Float[Array, "d"] | None:
        """The rate of that gradient as the point moves; None if it is constant."""
        return jax.jvp(jax.grad(lambda point: distance(self, point)), (point,), (velocity,))[1]

    def detail(self, place: Place) -> Float[Array, ""]:
        """Hook: a length [m] within which the ground around a place rises or falls at most once; by default infinite.
        Steps evaluate contacts at least once over this length.
        """
        return jnp.asarray(jnp.inf, place.dtype)


def distance(terrain: AbstractTerrain, point: Float[Array, "d"]) -> Float[Array, ""]:
    """Distance [m] of a point above the ground, along the normal; exact on even ground, elsewhere to first order in its
    curvature.
    """
    slope = jax.grad(terrain.height)(point[:-1])
    return (point[-1] - terrain.height(point[:-1])) / jnp.sqrt(1 + jnp.dot(slope, slope))


def outward(terrain: AbstractTerrain, point: Float[Array, "d"]) -> Float[Array, "d"]:
    """Unit outward normal of the ground below a point."""
    slope = jax.grad(terrain.height)(point[:-1])
    return jnp.ones_like(point).at[:-1].set(-slope) / jnp.sqrt(1 + jnp.dot(slope, slope))


def pace_over(terrain: AbstractTerrain, point: Float[Array, "d"], velocity: Float[Array, "d"]) -> Float[Array, ""]:
    """The rate [1/s] at which a point passes over the details of the ground below."""
    return norm(velocity[:-1]) / terrain.detail(point[:-1])


def edge_near(terrain: AbstractTerrain, points: Float[ArrayLike, "n d"]) -> str:
    """A place near concrete points at which the ground has no finite height or slope, for messages; empty without."""
    for place in np.asarray(points)[:, :-1]:
        steps = _NEAR * (1 + np.max(np.abs(place), initial=0.0)) * np.eye(place.size, dtype=place.dtype)
        for at in (place, *(place - steps), *(place + steps)):
            if not np.all(np.isfinite(np.hstack(jax.value_and_grad(terrain.height)(jnp.asarray(at))))):
                where = ", ".join(f"{x:.6g}" for x in place)
                return f"the height of its {type(terrain).__name__} or the slope is not finite at {where}"
    return ""


def _upwards(point: Float[Array, "d"]) -> Float[np.ndarray, "d"]:
    return np.eye(point.size, dtype=point.dtype)[-1]


def _beyond(place: Place, start: Float[Array, ""], end: Float[Array, ""]) -> Float[Array, ""]:
    """How far a place lies before the start or behind the end of an uneven stretch along x."""
    return jnp.maximum(jnp.maximum(start - place[0], place[0] - end), 0.0)


class Flat(AbstractTerrain):
    """Level ground.

    **Arguments:** `level` [m].
    """

    level: fields.Number = fields.parameter(unit="m", default=0.0, kw_only=False)

    def height(self, place):
        return self.level

    def facing(self, point):
        return jnp.asarray(_upwards(point)), None

    def facing_rate(self, point, velocity):
        return None


class Bump(AbstractTerrain):
    """A single bump, `peak sin²(π s)` with `s = (x − start) / length` in (0, 1); C¹, and smooth except at its ends.

    **Arguments:** `start` [m], where it begins; `length` [m] > 0; `peak` [m], its height, negative for a ditch.
    """

    start: fields.Number = fields.parameter(unit="m")
    length: fields.Number = fields.parameter(unit="m", sign="positive")
    peak: fields.Number = fields.parameter(unit="m")

    def height(self, place):
        s = clipped((place[0] - self.start) / self.length, 0.0, 1.0)
        return self.peak * jnp.sin(jnp.pi * s) ** 2

    def detail(self, place):
        return _beyond(place, self.start, self.start + self.length) + _SHARE * self.length


class Sinusoid(AbstractTerrain):
    """Waves along x, `amplitude sin(2π x / wavelength + phase)`.

    **Arguments:** `amplitude` [m]; `wavelength` [m] > 0; `phase` [rad].
    """

    amplitude: fields.Number = fields.parameter(unit="m")
    wavelength: fields.Number = fields.parameter(unit="m", sign="positive")
    phase: fields.Number = fields.parameter(unit="rad", default=0.0)

    def height(self, place):
        return self.amplitude * jnp.sin(2 * jnp.pi * place[0] / self.wavelength + self.phase)

    def detail(self, place):
        return _SHARE * self.wavelength


class Slope(AbstractTerrain):
    """A plane that rises along x.

    **Arguments:** `gradient` [m/m]; `level` [m], at x = 0.
    """

    gradient: fields.Number = fields.parameter(unit="m/m", kw_only=False)
    level: fields.Number = fields.parameter(unit="m", default=0.0)

    def height(self, place):
        return self.level + self.gradient * place[0]

    def facing(self, point):
        along: Any = np.eye(1, point.size)[0]
        normal = _upwards(point) - self.gradient * along
        return normal.astype(point.dtype) / jnp.sqrt(1 + self.gradient**2), None

    def facing_rate(self, point, velocity):
        return None


class Ramp(AbstractTerrain):
    """A transition between two levels, by a polynomial of degree five; C².

    **Arguments:** `start` [m], where it begins; `length` [m] > 0; `rise` [m], negative for a descent; its steepest
    gradient is `1.875 rise / length`, in the middle.
    """

    start: fields.Number = fields.parameter(unit="m")
    length: fields.Number = fields.parameter(unit="m", sign="positive")
    rise: fields.Number = fields.parameter(unit="m")

    def height(self, place):
        return self.rise * step((place[0] - self.start) / self.length)

    def detail(self, place):
        return _beyond(place, self.start, self.start + self.length) + _SHARE * self.length


class Spline(AbstractTerrain):
    """A profile through measured points; C² and local: a height depends on the six nearest points only.

    Between two points the profile is a polynomial of degree five. Its slope and curvature at each point are taken from
    the parabola through the point and its two neighbours, and reduced where the profile would overshoot: where the
    points rise it never falls. Beyond the first and the last point it continues as a straight line.

    **Arguments:** `x` [m], shape (n,), ascending, n ≥ 3; `heights` [m], shape (n,).
    """

    x: fields.Number = fields.parameter(shape=None, unit="m", converter=fields.as_jax)
    heights: fields.Number = fields.parameter(shape=None, unit="m", converter=fields.as_jax)

    def __check_init__(self):
        local_spline.check("Spline", ("x", "heights"), self.x, self.heights)

    def height(self, place):
        return local_spline.value(self.x, self.heights, place[0])

    def detail(self, place):
        return _beyond(place, self.x[0], self.x[-1]) + jnp.min(jnp.diff(self.x))


class Surface(AbstractTerrain):
    """Ground from a function, `function(place, parameters)`.

    **Arguments:** `function(place, parameters)`: height [m] at a place, twice differentiable by JAX; `parameters`:
    numbers by name, parameters of the system `"contact.terrain.key"`.
    """

    function: Callable[[Place, dict[str, Array]], Float[Array, ""]] = fields.function()
    parameters: fields.Numbers = fields.numbers()

    def height(self, place):
        return jnp.reshape(self.function(place, self.parameters), ())
