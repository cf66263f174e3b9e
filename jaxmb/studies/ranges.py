"""Bijections between bounded parameters and an unconstrained vector, which is zero at the starting values."""

import abc
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._types import VectorLike
from ..parts.names import unknown
from ..system import AbstractSystem, parameters
from ..system.design import design_bounds

if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

Bounds = tuple[ArrayLike | None, ArrayLike | None]


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


class Line(AbstractRange):
    """Any value: `start + scale z`."""

    start: Array
    scale: Array

    def __call__(self, z):
        return self.start + self.scale * z.reshape(self.start.shape)


class HalfLine(AbstractRange):
    """Values on one side of a bound: `bound + (start − bound) exp z`."""

    start: Array
    bound: Array

    def __call__(self, z):
        return self.bound + (self.start - self.bound) * jnp.exp(z.reshape(self.start.shape))


class Interval(AbstractRange):
    """Values between two bounds: a logistic curve of `z`."""

    start: Array
    low: Array
    high: Array

    def __call__(self, z):
        share = (self.start - self.low) / (self.high - self.low)
        at_start = jnp.log(share) - jnp.log1p(-share)
        return self.low + (self.high - self.low) * jax.nn.sigmoid(at_start + z.reshape(self.start.shape))


class PositiveDefinite(AbstractRange):
    """Positive definite matrices: `C T Tᵀ Cᵀ` with `C Cᵀ = start`, `T` lower triangular, `exp z` on its diagonal."""

    start: Array

    @property
    def size(self):
        n = self.start.shape[0]
        return n * (n + 1) // 2

    def __call__(self, z):
        n = self.start.shape[0]
        lower = jnp.zeros_like(self.start).at[np.tril_indices(n)].set(z)
        diagonal = jnp.diag(lower)
        factor = jnp.linalg.cholesky(self.start) @ (lower + jnp.diag(jnp.exp(diagonal) - diagonal))
        return factor @ factor.T


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

    def flat(self, z: Float[Array, "n"]) -> Float[Array, "values"]:
        """All values, raveled one after the other."""
        return jnp.concatenate([value.reshape(-1) for value in self(z).values()])


def free_parameters(
    system: AbstractSystem,
    free: Mapping[str, VectorLike] | Sequence[str],
    bounds: Mapping[str, Bounds] | None,
) -> FreeParameters:
    """Free parameters with their starting values and ranges.

    **Arguments:** `free`: starting values by name, or names alone, starting from the system's own values; `bounds`:
    `(low, high)` by name, either of them None; default those of design variables. The system's `positive_parameters`,
    such as masses and moments of inertia of bodies, stay positive without bounds, or positive definite if they are
    matrices.

    **Raises:** `ValueError` for unknown names, wrong shapes, and starting values that are not strictly within their
    bounds.
    """
    known = parameters(system)
    if isinstance(free, str):
        free = (free,)
    if not free:
        raise ValueError("Nothing is free: give the names of the parameters, or their starting values by name.")
    for name in free:
        if name not in known:
            raise unknown("parameter", name, known)
    starts = free if isinstance(free, Mapping) else {name: known[name] for name in free}
    for name in bounds or {}:
        if name not in starts:
            raise unknown("free parameter with bounds", name, starts)
    bounds = design_bounds(system, bounds)
    positive = system.positive_parameters()
    ranges = [
        _range(name, value, known[name], bounds.get(name), positive=name in positive) for name, value in starts.items()
    ]
    return FreeParameters(tuple(starts), tuple(ranges))


def _range(name: str, start: Any, own: Array, bounds: Bounds | None, *, positive: bool) -> AbstractRange:
    value = jnp.asarray(start, own.dtype)
    if value.shape != own.shape:
        raise ValueError(f"Parameter {name!r} has shape {own.shape}, got a start of shape {value.shape}.")
    if not np.all(np.isfinite(value)):
        raise ValueError(f"The start of {name!r} must be finite, got {start}.")
    if positive and value.ndim == 2:
        if bounds is not None:
            raise ValueError(f"{name!r} is a matrix and stays positive definite; it takes no bounds.")
        if not np.allclose(value, value.T) or np.any(np.linalg.eigvalsh(value) <= 0):
            raise ValueError(f"The start of {name!r} must be a symmetric positive definite matrix.")
        return PositiveDefinite(value)
    if bounds is None:
        bounds = (0.0, None) if positive else (None, None)
    low, high = (_bound(name, value, bound, empty) for bound, empty in zip(bounds, (-np.inf, np.inf), strict=True))
    if np.any(value <= low) or np.any(value >= high):
        raise ValueError(f"The start of {name!r} must lie strictly between {low} and {high}, got {np.asarray(value)}.")
    if np.all(np.isfinite(low)) and np.all(np.isfinite(high)):
        return Interval(value, low, high)
    if np.all(np.isfinite(low)) or np.all(np.isfinite(high)):
        return HalfLine(value, low if np.all(np.isfinite(low)) else high)
    largest = jnp.max(jnp.abs(value))
    typical = jnp.where(largest > 0, largest, jnp.ones_like(largest))
    return Line(value, jnp.where(value == 0, typical, jnp.abs(value)))


def _bound(name: str, value: Array, bound: ArrayLike | None, empty: float) -> Array:
    bound = np.asarray(empty if bound is None else bound, dtype=value.dtype)
    if bound.shape not in ((), value.shape):
        raise ValueError(
            f"Bounds of {name!r} have shape {bound.shape}; give numbers, or arrays of shape {value.shape}."
        )
    if not (np.all(np.isfinite(bound)) or np.all(bound == empty)):
        raise ValueError(f"Bounds of {name!r} must be finite for all components, or for none.")
    return jnp.broadcast_to(jnp.asarray(bound), value.shape)
