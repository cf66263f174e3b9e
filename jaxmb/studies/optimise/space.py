"""The named parameters of a design as one vector without units, within bounds."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..._arguments import real_array
from ..._types import VectorLike
from ...linalg.arrays import is_traced
from ...parts.names import unknown
from ...system import AbstractSystem, parameters
from ...system.design import Bounds, design_bounds
from ...system.quantities import component_names
from ..ranges import FreeParameters, range_between
from ..sobol import sobol_points

# A parameter is at a bound if it is closer than this, relative to its scale.
_NEAR = 1e-6


class Space(eqx.Module):
    """Parameters by name as an affine function of a vector z: `start + scale z`, component by component.

    **Fields:** `names`, `shapes`; `start`, `scale`, `low`, `high`: all components one after the other.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    start: Float[Array, "n"]
    scale: Float[Array, "n"]
    low: Float[Array, "n"]
    high: Float[Array, "n"]

    def __call__(self, z: Float[Array, "n"]) -> dict[str, Array]:
        """Values by name, never out of bounds by rounding."""
        value = self.start + self.scale * z
        # Rounding has no derivative.
        return self.named(value + lax.stop_gradient(jnp.clip(value, self.low, self.high) - value))

    @property
    def size(self) -> int:
        """Number of components."""
        return self.start.size

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """The bounds of z."""
        start, scale = np.asarray(self.start), np.asarray(self.scale)
        return (np.asarray(self.low) - start) / scale, (np.asarray(self.high) - start) / scale

    def named(self, flat: Float[Array, "n"]) -> dict[str, Array]:
        """Components by name, in the parameters' shapes."""
        parts = jnp.split(flat, np.cumsum([int(np.prod(shape)) for shape in self.shapes])[:-1])
        return {name: part.reshape(shape) for name, shape, part in zip(self.names, self.shapes, parts, strict=True)}

    def components(self) -> list[str]:
        """The names of all components: `"A.point_b[0]"`."""
        return [
            name for own, shape in zip(self.names, self.shapes, strict=True) for name in component_names(own, shape)
        ]

    def at_bounds(self, z: np.ndarray) -> list[str]:
        """The names of components that are at a bound."""
        near = np.min(np.abs(np.array(self.box) - z), axis=0) < _NEAR
        return [name for name, own in zip(self.components(), near, strict=True) if own]

    def unbounded(self) -> FreeParameters:
        """The same parameters as a function of a vector that may take any value; zero at the start.

        **Raises:** `ValueError` for a start that is not strictly within bounds, and for a parameter with bounds for
        some of its components only.
        """
        ranges = []
        fields = (self.named(x) for x in (self.start, self.scale, self.low, self.high))
        for name, start, scale, low, high in zip(self.names, *(own.values() for own in fields), strict=True):
            sides = [np.isfinite(np.asarray(bound)) for bound in (low, high)]
            if any(side.any() and not side.all() for side in sides):
                raise ValueError(f"This method needs bounds for all components of {name!r}, or for none.")
            if np.any(start <= low) or np.any(start >= high):
                raise ValueError(f"This method keeps bounds by a change of variables: start {name!r} strictly within.")
            ranges.append(range_between(start, low, high, scale))
        return FreeParameters(self.names, tuple(ranges))

    def sample(self, count: int, seed: int) -> Float[Array, "count n"]:
        """Vectors z of points that fill the bounds evenly, from a scrambled Sobol sequence.

        **Raises:** `ValueError` for a parameter without both bounds.
        """
        low, high = self.box
        for name, a, b in zip(self.components(), low, high, strict=True):
            if not np.isfinite(a) or not np.isfinite(b):
                raise ValueError(f"Several starts are spread between bounds: give {name!r} both of them.")
        return jnp.asarray(low + (high - low) * sobol_points(count, self.size, seed))


def space(
    start: Mapping[str, VectorLike] | Sequence[str],
    bounds: Mapping[str, Bounds] | None,
    system: AbstractSystem | None,
) -> Space:
    """The space of some named parameters.

    **Arguments:** `start`: values by name, or names alone of parameters of the system; `bounds`: `(low, high)` by name,
    default those of the system's design variables, as are scales.

    **Raises:** `ValueError` for unknown names, values that are no finite numbers, bounds that are reversed, and starts
    out of bounds.
    """
    known = {} if system is None else parameters(system)
    if isinstance(start, str):
        start = (start,)
    if not isinstance(start, Mapping):
        if system is None:
            raise ValueError(
                f"Give starting values by name, or with names alone the system= they are from; got {start!r}."
            )
        for name in start:
            if name not in known:
                raise unknown("parameter", name, known)
        start = {name: known[name] for name in start}
    if not start:
        raise ValueError("There is nothing to optimise: start is empty.")
    for name in bounds or {}:
        if name not in start:
            raise unknown("parameter with bounds", name, start)
    bounds = dict(bounds or {}) if system is None else design_bounds(system, bounds)
    declared = {} if system is None else {name: own for layer in system.design for name, own in layer.variables}
    columns = []
    for name, given in start.items():
        if is_traced(given):
            raise ValueError(f"The start of {name!r} must be a known number, not one that is traced.")
        value = real_array(f"The start of {name!r}", given, np.result_type(jnp.result_type(float)), None)
        if name in known and value.shape != known[name].shape:
            raise ValueError(f"Parameter {name!r} has shape {known[name].shape}, got a start of shape {value.shape}.")
        if not np.all(np.isfinite(value)):
            raise ValueError(f"The start of {name!r} must be finite, got {given}.")
        low, high = _bounds(name, bounds.get(name, (None, None)), value)
        own = declared[name].scale if name in declared else None
        columns.append((value.shape, *map(np.ravel, (value, _scale(value, low, high, own), low, high))))
    shapes, *flat = zip(*columns, strict=True)
    return Space(tuple(start), tuple(shapes), *(jnp.asarray(np.concatenate(own)) for own in flat))


def _bounds(name: str, given: Any, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if not isinstance(given, Sequence) or len(given) != 2:
        raise ValueError(f"The bounds of {name!r} must be a pair (low, high), either of them None; got {given!r}.")
    shapes = ((), value.shape)
    sides = [
        np.broadcast_to(
            real_array(f"A bound of {name!r}", empty if bound is None else bound, value.dtype, shapes), value.shape
        )
        for bound, empty in zip(given, (-np.inf, np.inf), strict=True)
    ]
    low, high = sides
    if np.any(low >= high):
        raise ValueError(f"The bounds of {name!r} must be (low, high) with low < high, got {given}.")
    if np.any(value < low) or np.any(value > high):
        raise ValueError(f"The start of {name!r}, {value}, is not within its bounds {given}.")
    return low, high


def _scale(value: np.ndarray, low: np.ndarray, high: np.ndarray, own: Any) -> np.ndarray:
    if own is not None:
        return np.broadcast_to(np.asarray(own, value.dtype), value.shape)
    largest = np.max(np.abs(value), initial=0.0)
    typical = np.where(value == 0, largest if largest > 0 else 1.0, np.abs(value))
    bounded = np.isfinite(low) & np.isfinite(high)
    return np.where(bounded, np.where(bounded, high, 1.0) - np.where(bounded, low, 0.0), typical)
