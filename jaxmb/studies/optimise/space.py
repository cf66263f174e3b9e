"""The named parameters of a design as one vector without units, within bounds."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._arguments import bounds_of, real_array
from ..._types import VectorLike
from ...linalg.arrays import is_traced
from ...parts.names import unknown
from ...system import AbstractSystem, parameters
from ...system.design import Bounds, design_bounds
from ..ranges import Box, FreeParameters, range_between, typical_change
from ..sobol import sobol_points

# A parameter closer to a bound than this, relative to its scale, is at the bound.
_NEAR = 1e-6


class Space(FreeParameters):
    """Parameters by name as an affine function of a vector z within a box, component by component."""

    ranges: tuple[Box, ...]

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """The bounds of z."""
        low, high = ({n: r.ends[side] for n, r in zip(self.names, self.ranges, strict=True)} for side in (0, 1))
        return np.asarray(self.locate(low)), np.asarray(self.locate(high))

    def at_bounds(self, z: np.ndarray) -> list[str]:
        """The names of components at a bound."""
        near = np.min(np.abs(np.array(self.box) - z), axis=0) < _NEAR
        return [name for name, is_near in zip(self.components(), near, strict=True) if is_near]

    def unbounded(self, z: Float[Array, "n"]) -> FreeParameters:
        """The same parameters as a function of an unbounded vector, zero at `z`.

        **Raises:** `ValueError` for a start that is not strictly within bounds, and for a parameter with bounds for
        some of its components only.
        """
        ranges = []
        for (name, start), bounds in zip(self(z).items(), self.ranges, strict=True):
            sides = [np.isfinite(np.asarray(bound)) for bound in bounds.ends]
            if any(side.any() and not side.all() for side in sides):
                raise ValueError(f"This method needs bounds for all components of {name!r}, or for none.")
            if np.any(start <= bounds.low) or np.any(start >= bounds.high):
                raise ValueError(
                    f"This method keeps bounds by a change of variables: start {name!r} strictly within them."
                )
            ranges.append(range_between(start, bounds.low, bounds.high, bounds.scale))
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

    **Arguments:** `start`: values by name, or names alone of parameters of the system; `bounds`: `(low, high)` by name.
    Default bounds and scales are from the system's design variables.

    **Raises:** `ValueError` for unknown names, values that are not finite numbers, reversed bounds, and starts out of
    bounds.
    """
    present = {} if system is None else parameters(system)
    if isinstance(start, str):
        start = (start,)
    if not isinstance(start, Mapping):
        if system is None:
            raise ValueError(f"Give starting values by name, or names alone with their system=; got {start!r}.")
        for name in start:
            if name not in present:
                raise unknown("parameter", name, present)
        start = {name: present[name] for name in start}
    if not start:
        raise ValueError("There is nothing to optimise: start is empty.")
    for name in bounds or {}:
        if name not in start:
            raise unknown("parameter with bounds", name, start)
    bounds = dict(bounds or {}) if system is None else design_bounds(system, bounds)
    declared = (
        {} if system is None else {name: variable for layer in system.design for name, variable in layer.variables}
    )
    ranges = []
    for name, given in start.items():
        if is_traced(given):
            raise ValueError(f"The start of {name!r} must be a concrete number, not a traced one.")
        value = real_array(f"The start of {name!r}", given, np.result_type(jnp.result_type(float)), None)
        if name in present and value.shape != present[name].shape:
            raise ValueError(f"Parameter {name!r} has shape {present[name].shape}, got a start of shape {value.shape}.")
        if not np.all(np.isfinite(value)):
            raise ValueError(f"The start of {name!r} must be finite, got {given}.")
        limits = bounds.get(name, (None, None))
        low, high = bounds_of(f"The bounds of {name!r}", limits, value.shape, value.dtype)
        if np.any(value < low) or np.any(value > high):
            raise ValueError(f"The start of {name!r}, {value}, is not within its bounds {limits}.")
        given_scale = declared[name].scale if name in declared else None
        scale = (
            _scale(value, low, high)
            if given_scale is None
            else np.broadcast_to(np.asarray(given_scale, value.dtype), value.shape)
        )
        ranges.append(Box(*map(jnp.asarray, (value, scale, low, high))))
    return Space(tuple(start), tuple(ranges))


def _scale(value: np.ndarray, low: np.ndarray, high: np.ndarray) -> Any:
    """The distance between the bounds. If a bound is missing, the size of the start."""
    bounded = np.isfinite(low) & np.isfinite(high)
    return np.where(
        bounded, np.where(bounded, high, 1.0) - np.where(bounded, low, 0.0), typical_change(jnp.asarray(value))
    )
