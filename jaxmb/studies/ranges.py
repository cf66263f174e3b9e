"""Bounded parameters as functions of a vector, which is zero at the starting values."""

import abc
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from .._arguments import bounds_of
from ..system.quantities import component_names

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

Bounds = tuple[ArrayLike | None, ArrayLike | None]

# An estimate is at a bound if its distance from the bound is below this fraction of the start's distance, and below
# `_INDISTINCT` standard deviations.
_NEAR, _INDISTINCT = 1e-3, 0.1


class AbstractRange(eqx.Module):
    """The values that one parameter may take, as the image of a vector `z`."""

    start: AbstractVar[Array]

    @property
    def size(self) -> int:
        """Length of `z`."""
        return self.start.size

    @abc.abstractmethod
    def __call__(self, z: Float[Array, "n"]) -> Array:
        """The parameter's value; `start` at zero."""

    @abc.abstractmethod
    def locate(self, value: Array) -> Float[Array, "n"]:
        """The vector `z` of a value."""

    @abc.abstractmethod
    def at_end(self, z: Float[Array, "n"], deviations: np.ndarray) -> np.ndarray:
        """Whether each component of the value is at an end of the range, a bound or infinity, as far as the data tell.

        At a bound, the distance from it is below a thousandth of the start's distance (of the width between two
        bounds), and below a tenth of the standard deviation in `deviations`. Towards infinity, the distance has grown a
        thousandfold and is below the standard deviation.
        """

    @property
    def ends(self) -> tuple[Array, Array] | None:
        """Both bounds, each of the value's shape; None if one is missing."""
        return None

    @property
    def componentwise(self) -> bool:
        """Whether every component of the value depends on one component of `z`."""
        return self.size == self.start.size

    def free_components(self, value: Array) -> Float[Array, "n"]:
        """Components that determine the value."""
        return value.reshape(-1)

    def draw(self, random: np.random.Generator) -> Float[Array, "n"]:
        """A random vector in the range, not far from the start."""
        return jnp.asarray(random.standard_normal(self.size), self.start.dtype)


def _indistinct(distance: np.ndarray, before: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Whether the remaining distance from a bound is insignificant."""
    distance = np.abs(distance)
    return (distance < _NEAR * before) & ~(distance > _INDISTINCT * deviations)


def _lost(distance: np.ndarray, before: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Whether a value has moved away insignificantly far towards infinity."""
    distance = np.abs(distance)
    return (distance > np.abs(before) / _NEAR) & ~(distance > deviations)


class WholeLine(AbstractRange):
    """Any value: `start + scale z`."""

    start: Array
    scale: Array

    def __call__(self, z):
        return self.start + self.scale * z.reshape(self.start.shape)

    def locate(self, value):
        return ((value - self.start) / self.scale).reshape(-1)

    def at_end(self, z, deviations):
        return _lost(np.asarray(self(z) - self.start), np.asarray(self.scale), deviations)


class Box(WholeLine):
    """Values `start + scale z` between bounds that the method keeps, infinite if missing. Rounding never leads out of
    bounds.
    """

    low: Array
    high: Array

    def __call__(self, z):
        value = super().__call__(z)
        # Rounding has no derivative.
        return value + lax.stop_gradient(jnp.clip(value, self.low, self.high) - value)

    @property
    def ends(self):
        return self.low, self.high


class HalfLine(AbstractRange):
    """Values on one side of a bound: `bound + (start − bound) exp z`."""

    start: Array
    bound: Array

    def __call__(self, z):
        return self.bound + (self.start - self.bound) * jnp.exp(z.reshape(self.start.shape))

    def locate(self, value):
        return jnp.log((value - self.bound) / (self.start - self.bound)).reshape(-1)

    def at_end(self, z, deviations):
        distance, before = (np.asarray(x - self.bound) for x in (self(z), self.start))
        return _indistinct(distance, np.abs(before), deviations) | _lost(distance, before, deviations)


class Interval(AbstractRange):
    """Values between two bounds: a logistic curve of `z`."""

    start: Array
    low: Array
    high: Array

    def __call__(self, z):
        return self.low + (self.high - self.low) * jax.nn.sigmoid(self._logit(self.start) + z.reshape(self.start.shape))

    def locate(self, value):
        return (self._logit(value) - self._logit(self.start)).reshape(-1)

    def at_end(self, z, deviations):
        value, width = self(z), np.asarray(self.high - self.low)
        distance = np.asarray(jnp.minimum(value - self.low, self.high - value))
        return _indistinct(distance, width, deviations)

    @property
    def ends(self):
        return self.low, self.high

    def draw(self, random):
        # Between two bounds all values are equally likely.
        return self.locate(self.low + (self.high - self.low) * random.uniform(size=self.start.shape))

    def _logit(self, value):
        share = (value - self.low) / (self.high - self.low)
        return jnp.log(share) - jnp.log1p(-share)


class Inertia(AbstractRange):
    """Inertia matrices of mass distributions: their principal moments satisfy the triangle inequalities.

    `I = tr(Σ) 1 − Σ` with the second moments of mass `Σ = ∫ r rᵀ dm` positive definite: `Σ = C T Tᵀ Cᵀ`, where `C Cᵀ`
    is the start's Σ and T is lower triangular with `exp z` on its diagonal. About the mass centre the pseudo-inertia
    matrix is block diagonal, with blocks Σ and the mass; it is positive definite if both blocks are.

    Source: C. Rucker and P. M. Wensing, "Smooth Parameterization of Rigid-Body Inertia", IEEE Robotics and Automation
    Letters 7(2), 2022.
    """

    start: Array

    @property
    def size(self):
        return 6

    def __call__(self, z):
        factor = jnp.linalg.cholesky(second_moments(self.start)) @ self._factor(z)
        moments = factor @ factor.T
        return jnp.trace(moments) * jnp.eye(3, dtype=moments.dtype) - moments

    def _factor(self, z):
        lower = jnp.zeros_like(self.start).at[self._below].set(z)
        diagonal = jnp.diag(lower)
        return lower + jnp.diag(jnp.exp(diagonal) - diagonal)

    def locate(self, value):
        start, target = (jnp.linalg.cholesky(second_moments(inertia)) for inertia in (self.start, value))
        lower = jnp.linalg.solve(start, target)
        diagonal = jnp.diag(lower)
        return (lower + jnp.diag(jnp.log(diagonal) - diagonal))[self._below]

    def at_end(self, z, deviations):
        # The squared singular values of T are the remaining fractions of the start in some directions.
        factors = np.linalg.svd(np.asarray(self._factor(z)), compute_uv=False)
        near = factors[-1] < _NEAR or factors[0] > 1 / _NEAR
        return np.full(self.start.shape, near)

    def free_components(self, value):
        return value[self._below]

    @property
    def _below(self):
        return np.tril_indices(3)


def second_moments(inertia: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """`Σ = ½ tr(I) 1 − I` of an inertia matrix [kg m²]."""
    return 0.5 * jnp.trace(inertia) * jnp.eye(3, dtype=inertia.dtype) - inertia


class FreeParameters(eqx.Module):
    """Parameters of a system as a function of one vector."""

    names: tuple[str, ...] = eqx.field(static=True)
    ranges: tuple[AbstractRange, ...]

    @property
    def size(self) -> int:
        """Length of the vector."""
        return sum(r.size for r in self.ranges)

    def __call__(self, z: Float[Array, "n"]) -> dict[str, Array]:
        """Values by name."""
        parts = jnp.split(z, np.cumsum([r.size for r in self.ranges])[:-1])
        return {name: r(part) for name, r, part in zip(self.names, self.ranges, parts, strict=True)}

    def components(self) -> list[str]:
        """The names of all scalar components of the values: `"A.point_b[0]"`."""
        each = zip(self.names, self.ranges, strict=True)
        return [component for name, r in each for component in component_names(name, r.start.shape)]

    def flat(self, z: Float[Array, "n"]) -> Float[Array, "values"]:
        """All values, raveled one after the other."""
        return jnp.concatenate([value.reshape(-1) for value in self(z).values()])

    @property
    def start(self) -> dict[str, Array]:
        """The values at zero, by name."""
        return {name: r.start for name, r in zip(self.names, self.ranges, strict=True)}

    def at_end(self, z: Float[Array, "n"], deviations: Float[np.ndarray, "values"]) -> np.ndarray:
        """Whether each of all values, raveled one after the other, is at an end of its range."""
        out, ends = [], np.cumsum([r.start.size for r in self.ranges])
        for name, r, part in zip(self.names, self.ranges, np.split(deviations, ends[:-1]), strict=True):
            out.append(np.ravel(r.at_end(z[self.place(name)], part.reshape(r.start.shape))))
        return np.concatenate(out)

    def ends(self) -> list[tuple[float, float] | None]:
        """Both bounds of all values, raveled one after the other; None if one is missing."""
        out: list[tuple[float, float] | None] = []
        for r in self.ranges:
            ends = [None] * r.start.size
            out += ends if r.ends is None else zip(*(np.ravel(bound).tolist() for bound in r.ends), strict=True)
        return out

    def locate(self, values: Mapping[str, Array]) -> Float[Array, "n"]:
        """The vector of values by name."""
        return jnp.concatenate([r.locate(values[name]) for name, r in zip(self.names, self.ranges, strict=True)])

    def log_volume(self, z: Float[Array, "n"]) -> Float[Array, ""]:
        """`log |∂ values / ∂ z|`, for components that determine the values."""
        parts = jnp.split(z, np.cumsum([r.size for r in self.ranges])[:-1])
        each = zip(self.ranges, parts, strict=True)
        jacobians = [jax.jacfwd(lambda z, r=r: r.free_components(r(z)))(part) for r, part in each]
        return jnp.sum(jnp.stack([jnp.linalg.slogdet(matrix)[1] for matrix in jacobians]))

    def place(self, name: str) -> slice:
        """The components of a parameter in the vector."""
        number = self.names.index(name)
        first = sum(r.size for r in self.ranges[:number])
        return slice(first, first + self.ranges[number].size)


def range_of(
    name: str, start: Any, own: Array, bounds: Bounds | None, *, positive: bool, scale: Array | None = None
) -> AbstractRange:
    """The range of one parameter.

    **Arguments:** `own`: an array of the parameter's shape and type; `positive`: whether the parameter stays positive,
    or a matrix an inertia matrix; `scale`: a typical change, default the size of the start.
    """
    if isinstance(start, eqx.Module):
        raise ValueError(
            f"The start of {name!r} must be numbers, got a {type(start).__name__}; leave it out, and set the initial "
            "weights by with_parameters."
        )
    value = jnp.asarray(start, own.dtype)
    if value.shape != own.shape:
        raise ValueError(f"Parameter {name!r} has shape {own.shape}, got a start of shape {value.shape}.")
    if not np.all(np.isfinite(value)):
        raise ValueError(f"The start of {name!r} must be finite, got {start}.")
    if positive and value.ndim == 2:
        return _inertia(name, value, bounds)
    if bounds is None:
        bounds = (0.0, None) if positive else (None, None)
    low, high = map(jnp.asarray, bounds_of(f"The bounds of {name!r}", bounds, value.shape, value.dtype))
    if any(np.isfinite(side).any() and not np.isfinite(side).all() for side in (low, high)):
        raise ValueError(f"Bounds of {name!r} must be finite for all components, or for none.")
    if np.any(value <= low) or np.any(value >= high):
        raise ValueError(f"The start of {name!r} must lie strictly between {low} and {high}, got {np.asarray(value)}.")
    scale = typical_change(value) if scale is None else jnp.broadcast_to(scale, value.shape)
    return range_between(value, low, high, scale)


def typical_change(value: Array) -> Array:
    """The sizes of components; for zeros the size of the largest component, or one."""
    largest = jnp.max(jnp.abs(value), initial=0.0)
    return jnp.where(value == 0, jnp.where(largest > 0, largest, jnp.ones_like(largest)), jnp.abs(value))


def range_between(start: Array, low: Array, high: Array, scale: Array) -> AbstractRange:
    """The values between two bounds, each finite for all components or for none; `scale`: a typical change if neither
    bound is finite.
    """
    below, above = (bool(np.all(np.isfinite(bound))) for bound in (low, high))
    if below and above:
        return Interval(start, low, high)
    return HalfLine(start, low if below else high) if below or above else WholeLine(start, scale)


def _inertia(name: str, value: Array, bounds: Bounds | None) -> Inertia:
    if bounds is not None:
        raise ValueError(f"{name!r} is a matrix that stays the inertia of a body; it takes no bounds.")
    if not np.allclose(value, value.T) or np.any(np.linalg.eigvalsh(value) <= 0):
        raise ValueError(f"The start of {name!r} must be a symmetric positive definite matrix.")
    least = np.min(np.linalg.eigvalsh(second_moments(value)))
    if least <= 1e-9 * np.trace(value):
        raise ValueError(
            f"The start of {name!r} is not the inertia of a body with an extent in every direction: the largest "
            "principal moment must be smaller than the sum of the other two. Start from a slightly thicker body."
        )
    return Inertia(value)
