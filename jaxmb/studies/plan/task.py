"""What a plan is asked for: controls, ends, bounds along the way and duration, checked and by name."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..._arguments import bounds_of, real_array, whole_number
from ..._types import State
from ...parts.names import unknown
from ...system import AbstractSystem, parameters, with_inputs
from ...system.quantities import component_names
from ..evaluate import Reading
from .courses import COURSES, Piece
from .lanes import Control, by_name


@dataclasses.dataclass(frozen=True)
class Limits:
    """Bounds of quantities by name, with their `shapes`; `low` and `high` of all components, equal for equations."""

    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]
    low: np.ndarray
    high: np.ndarray

    @property
    def components(self) -> list[str]:
        """The names of all components."""
        each = zip(self.names, self.shapes, strict=True)
        return [component for name, shape in each for component in component_names(name, shape)]

    def by_name(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """The bounds of each quantity."""
        shapes = list(zip(self.names, self.shapes, strict=True))
        low, high = (by_name(shapes, side) for side in (self.low, self.high))
        return {name: (low[name], high[name]) for name in low}

    @property
    def sizes(self) -> np.ndarray:
        """Units of violations: the distance of the bounds, or the larger bound, or 1."""
        ends = np.maximum(*(np.where(np.isfinite(side), np.abs(side), 0.0) for side in (self.low, self.high)))
        width = np.where(np.isfinite(self.high - self.low), self.high - self.low, 0.0)
        size = np.maximum(ends, width)
        return np.where(size > 0, size, 1.0)


class Named(NamedTuple):
    """Quantities with these `names`, a function of the instant."""

    names: tuple[str, ...]

    def __call__(self, at: Reading) -> list[Any]:
        return [at[name] for name in self.names]


@dataclasses.dataclass(frozen=True)
class Task:
    """A plan's problem.

    **Fields:** the `system`; `controls` with `control_bounds`, one pair for each; `design`: names and shapes, with
    `design_bounds`; `t0`; `duration`: its bounds; `shares`: the nodes as shares of the duration, 0 to 1; `arcs`: the
    first and the last node, and between them nodes that move, with the others evenly between them; `start` and `end`:
    a state, or limits; `path`: limits; `running` and `final`: functions of the instant, or None; `of_time`: the weight
    of the duration in the objective; `periodic`.
    """

    system: AbstractSystem
    controls: tuple[Control, ...]
    control_bounds: tuple[tuple[np.ndarray, np.ndarray], ...]
    design: tuple[tuple[str, tuple[int, ...]], ...]
    design_bounds: tuple[tuple[np.ndarray, np.ndarray], ...]
    t0: float
    duration: tuple[float, float]
    shares: np.ndarray
    arcs: tuple[int, ...]
    start: State | Limits
    end: State | Limits
    path: Limits
    running: Callable[[Reading], Any] | None
    final: Callable[[Reading], Any] | None
    of_time: float
    periodic: bool

    @property
    def intervals(self) -> int:
        """The number of intervals."""
        return len(self.shares) - 1

    @property
    def moving(self) -> bool:
        """Whether nodes move."""
        return len(self.arcs) > 2

    @property
    def timed(self) -> bool:
        """Whether times are variables."""
        return self.moving or self.duration[0] < self.duration[1]

    @property
    def passed(self) -> np.ndarray:
        """The part of each arc that has passed at each node, shape (nodes, arcs), 0 to 1."""
        begins, ends = self.shares[list(self.arcs[:-1])], self.shares[list(self.arcs[1:])]
        return np.clip((self.shares[:, None] - begins) / (ends - begins), 0.0, 1.0)


class Effort(NamedTuple):
    """The sum of the squares of the controls with these `names`."""

    names: tuple[str, ...]

    def __call__(self, at: Reading) -> Any:
        return sum(jnp.sum(jnp.square(at[name])) for name in self.names)


def checked_controls(system: AbstractSystem, given: Any, interpolation: str) -> tuple[Any, Any]:
    """The controls by name, and their bounds.

    **Raises:** `ValueError` for a name that is no parameter or cannot be an input, for reversed bounds, and for a
    control on which constraints depend.
    """
    if interpolation not in COURSES:
        raise ValueError(f"plan: interpolation must be 'held', 'linear' or 'cubic', got {interpolation!r}.")
    if not isinstance(given, Mapping):
        raise ValueError(
            f"plan: controls must be bounds by the names of parameters, {{'motor.force': (-2.0, 2.0)}}; got {given!r}."
        )
    course, existing = COURSES[interpolation], parameters(system)
    controls, bounds = [], []
    for name, pair in given.items():
        if name not in existing:
            raise unknown("control", name, existing, "plan")
        value = existing[name]
        numbers: Any = np.zeros((course.local, *value.shape), value.dtype)
        driven = with_inputs(system, {name: Piece(course.powers(numbers), 0.0, 1.0, True)})
        if driven.parameter_table.signals[name][1]:
            raise ValueError(
                f"plan: constraints depend on the control {name!r}; take a force instead, such as a JointForce on the "
                "coordinate of the driver."
            )
        pair = (None, None) if pair is None else pair
        low, high = bounds_of(f"plan: the bounds of control {name!r}", pair, value.shape, equal=True)
        if np.all(low == high):
            raise ValueError(f"plan: the control {name!r} is held by its bounds {pair}; leave it out of controls.")
        bounds.append((low, high))
        controls.append(Control(name, value.shape, course))
    return tuple(controls), tuple(bounds)


def checked_design(system: AbstractSystem, given: Any, controls: tuple[Control, ...]) -> tuple[Any, Any]:
    """The designed parameters' names and shapes, and their bounds."""
    existing, shapes, bounds = parameters(system), [], []
    for name, pair in (given or {}).items():
        if name not in existing:
            raise unknown("parameter", name, existing, "plan: design")
        if name in (control.name for control in controls):
            raise ValueError(f"plan: {name!r} is a control and a designed parameter; take one of them.")
        low, high = bounds_of(f"plan: the bounds of {name!r}", pair, existing[name].shape, equal=True)
        value = np.asarray(existing[name])
        if np.any(value < low) or np.any(value > high):
            raise ValueError(f"plan: {name!r} is {value} in the system, not within its bounds {pair}.")
        shapes.append((name, existing[name].shape))
        bounds.append((low, high))
    return tuple(shapes), tuple(bounds)


def checked_limits(system: AbstractSystem, where: str, given: Any, others: Mapping[str, Any]) -> Limits:
    """Limits of quantities by name, `(low, high)`, or a number that they equal.

    **Arguments:** `others`: the shapes of controls and designed parameters by name.
    """
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(f"plan: {where} must be a state, or values or bounds by name; got {given!r}.")
    shapes, lows, highs = [], [], []
    for name, value in (given or {}).items():
        shape = _shape(system, name, others, where)
        is_pair = isinstance(value, tuple) and len(value) == 2
        if where != "path" and shape == (2,):
            # Two numbers at an end are the value of a vector of two.
            is_pair = is_pair and any(np.ndim(x) or x is None for x in value)
        pair = value if is_pair else (value, value)
        low, high = bounds_of(f"plan: {where} of {name!r}", pair, shape, equal=True)
        shapes.append(shape)
        lows.append(low.reshape(-1))
        highs.append(high.reshape(-1))
    flat = lambda parts: np.concatenate([np.zeros(0), *parts])
    return Limits(tuple(given or {}), tuple(shapes), flat(lows), flat(highs))


def _shape(system, name, others, where):
    state = State(jnp.zeros(system.nq), jnp.zeros(system.nu), jnp.zeros(system.nz) if system.nz else None)
    reading = Reading(system, state, 0.0, dict(others))
    if name not in reading.names:
        raise unknown("quantity", name, reading.names, f"plan: {where}")
    if name in others:
        return np.shape(others[name])
    return jax.eval_shape(lambda y: Reading(system, y, 0.0)[name], state).shape


def checked_duration(given: Any) -> tuple[float, float]:
    """The bounds of the duration [s], equal for a number."""
    pair = given if isinstance(given, tuple) else (given, given)
    low, high = (float(x) for x in bounds_of("plan: duration", pair, (), equal=True))
    if not (low > 0 and np.isfinite(high)):
        raise ValueError(
            f"plan: duration must be a positive number of seconds, or two of them (low, high); got {given!r}."
        )
    return low, high


def checked_shares(intervals: Any) -> np.ndarray:
    """The nodes as shares of the duration, from the number of intervals or from ascending shares."""
    if np.ndim(intervals) == 0:
        return np.linspace(
            0.0, 1.0, whole_number("plan: intervals", intervals, 1, ", or ascending shares from 0 to 1") + 1
        )
    shares = np.asarray(real_array("plan: intervals", intervals, float, None))
    if shares.ndim != 1 or shares.size < 2 or shares[0] != 0 or shares[-1] != 1 or np.any(np.diff(shares) <= 0):
        raise ValueError(f"plan: intervals must be a number, or ascending shares from 0 to 1; got {intervals!r}.")
    return shares
