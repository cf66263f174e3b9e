"""A machine with a few numbers that vary between bounds, and its motion for any of their values."""

import dataclasses
import functools
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._arguments import bounds_of
from .._results import RESULTS
from .._types import State
from ..bodies.units import named, parameter_unit
from ..parts.names import unknown
from ..simulate import simulate
from ..states.assembly import assemble
from ..system import AbstractSystem, parameters, with_inputs, with_parameters
from ..system.quantities import component_names, rates_of
from ..trajectory import Trajectory, still

# The number of steps from the start to other values, by which a mechanism keeps to one of its ways of assembly; the
# sine of an angle below which coordinates depend on each other.
_STEPS, _DEPENDENT = 12, 1e-6


class Slider(NamedTuple):
    """A number that varies; `kind`: parameter, input, coordinate or rate; `base` and `place`: its array, and the
    place in it."""

    name: str
    kind: str
    base: str
    place: tuple[int, ...]
    start: float
    low: float
    high: float
    unit: str


@dataclasses.dataclass(frozen=True)
class Variation:
    """The motion of a machine as a function of the values of its sliders.

    **Fields:** `system`; `start`: the state for the sliders' first values; `held`: coordinates that `assemble` fixes
    and that have no slider; `rates` at the start, by name; `options` of `simulate`, None for a pose.
    """

    system: Any
    start: State
    sliders: tuple[Slider, ...]
    held: Mapping[str, Any]
    rates: Mapping[str, Any]
    options: Mapping[str, Any] | None

    @classmethod
    def of(
        cls,
        system: Any,
        bounds: Mapping[str, Any],
        *,
        state: State | None,
        fix: Mapping[str, Any] | None,
        rates: Mapping[str, Any] | None,
        options: Mapping[str, Any] | None,
    ) -> "Variation":
        """The sliders of the given bounds, and of the coordinates of joints that determine the pose."""
        start, fix = assemble(system, state, fix=fix, rates=rates), dict(fix or {})
        known = _known(system, start)
        for name in bounds:
            if name not in known:
                raise unknown("parameter, input, coordinate or rate", name, known, "explore")
        turned = [name for name in (*bounds, *fix) if name in known and known[name].kind == "coordinate"]
        wanted, turned = turned, _independent(system, start, list(dict.fromkeys(turned)))
        for name in wanted:
            if name not in turned:
                raise ValueError(f"explore: {name!r} follows from {', '.join(turned)}; leave it out.")
        if rates is None:
            # Joints start as fast as in the given state.
            rates = {name: known[f"{name}_rate"].start for name in turned if f"{name}_rate" in known}
        rates = {name: value for name, value in rates.items() if not {name, f"{name}_rate"} & bounds.keys()}
        sliders = tuple(
            _bounded(known[name], bounds.get(name), float(system.length)) for name in dict.fromkeys([*bounds, *turned])
        )
        held = {name: value for name, value in fix.items() if name not in turned}
        return cls(system, start, sliders, held, rates, options)

    def motion(self, values: Mapping[str, float]) -> Trajectory:
        """The motion for values by name, default the first ones; a pose is a motion with one time.

        **Raises:** `ValueError` that says why there is no motion.
        """
        numbers = {slider.name: jnp.asarray(values.get(slider.name, slider.start)) for slider in self.sliders}
        motion = self._compiled(numbers)
        if not all(np.all(np.isfinite(y)) for y in jax.tree.leaves(motion.ys)):
            raise ValueError(self._reason(numbers, motion))
        return motion

    @functools.cached_property
    def _compiled(self):
        return eqx.filter_jit(lambda numbers: self._moved(numbers))

    def _moved(self, numbers: Mapping[str, Any]) -> Trajectory:
        def step(state, share):
            between = {s.name: s.start + share * (numbers[s.name] - s.start) for s in self.sliders}
            found = self._assembled(between, state, throw=False)[1]
            return State(found.q, self.start.u, found.z, found.angles), None

        near, _ = lax.scan(step, self.start, jnp.arange(1, _STEPS) / _STEPS)
        system, state = self._assembled(numbers, near, throw=False)
        return still(system, state) if self.options is None else simulate(system, state, throw=False, **self.options)

    def _assembled(self, numbers: Mapping[str, Any], guess: State, throw: bool | None = None) -> tuple[Any, State]:
        arrays: dict[tuple[str, str], Any] = {}
        for s in self.sliders:
            array = arrays.get((s.kind, s.base), parameters(self.system).get(s.base, 0.0))
            arrays[s.kind, s.base] = jnp.asarray(array).at[s.place].set(numbers[s.name])
        of_kind = lambda kind: {base: value for (given, base), value in arrays.items() if given == kind}
        system = with_parameters(self.system, of_kind("parameter"))
        inputs = {base: lambda t, value=value: value + 0 * t for base, value in of_kind("input").items()}
        system = with_inputs(system, inputs) if inputs else system
        fix, rates = {**self.held, **of_kind("coordinate")}, {**self.rates, **of_kind("rate")}
        return system, assemble(system, guess, fix=fix, rates=rates, throw=throw)

    def _reason(self, numbers: Mapping[str, Any], motion: Trajectory) -> str:
        try:
            self._assembled(numbers, self.start)
        except ValueError as error:
            return str(error).split("\n")[0]
        if not bool(motion.result == RESULTS.successful):
            return str(RESULTS[motion.result])  # pyright: ignore[reportInvalidTypeArguments]
        return "The mechanism cannot be moved from the start to these values."


def _known(system: AbstractSystem, start: State) -> dict[str, Slider]:
    """All numbers that may vary, by name, without bounds."""
    out: dict[str, Slider] = {}

    def add(kind, base, value, unit):
        for name, index in zip(component_names(base, value.shape), np.ndindex(value.shape), strict=True):
            out.setdefault(name, Slider(name, kind, base, index, float(value[index]), -np.inf, np.inf, unit))

    motion, quantities, coordinates = still(system, start), system.quantities(), system.coordinate_names()
    signals = system.parameter_table.signals
    for base, value in parameters(system).items():
        value = signals[base][0](motion.ts[0]) if base in signals else value
        add("input" if base in signals else "parameter", base, np.asarray(value), parameter_unit(system, base))
    for base, index in coordinates.items():
        if len(index) == 1 and not base.endswith(".mode"):
            add("coordinate", base, np.asarray(start.q)[index[0]], named(system, base).unit)
    for base, joint in system.joint_coordinates().items():
        if joint.shape == ():
            add("coordinate", base, np.asarray(motion.quantity(base))[0], named(system, base).unit)
            if f"{base}_rate" in quantities:
                value = np.asarray(motion.quantity(f"{base}_rate"))[0]
                add("rate", f"{base}_rate", value, named(system, f"{base}_rate").unit)
    for base, index in rates_of(system.rate_names()).items():
        if len(index) == 1 and base not in out:
            add("rate", base, np.asarray(start.u)[index[0]], named(system, base).unit)
    return out


def _bounded(slider: Slider, given: Any, size: float) -> Slider:
    """A slider with bounds; by default an angle goes once round, and other coordinates as far as the system's size."""
    name, start = slider.name, slider.start
    reach = np.pi if slider.unit == "rad" else size
    label = f"explore: the bounds of {name!r}"
    low, high = map(float, bounds_of(label, (start - reach, start + reach) if given is None else given, ()))
    if not (np.isfinite(low) and np.isfinite(high)):
        raise ValueError(f"{label} must be two numbers, got {given}.")
    if not low <= start <= high:
        raise ValueError(f"{label}, ({low:g}, {high:g}), do not contain its value, {start:.6g} {slider.unit}.")
    return slider._replace(low=low, high=high)


def _independent(system: Any, start: State, given: Collection[str]) -> list[str]:
    """The first scalar coordinates of joints that determine the pose, together with the `given` coordinates."""
    t, places = jnp.zeros((), start.q.dtype), system.coordinate_names()
    joints = {name: joint for name, joint in system.joint_coordinates().items() if joint.shape == ()}
    names = [*given, *(name for name in joints if name not in given)]
    value = lambda q, name: (
        q[places[name][0]] if name in places else system.catalogue.joint_coordinate(joints[name], t, q)
    )
    slopes = jax.jit(jax.jacfwd(lambda q: jnp.stack([value(q, name) for name in names])))(start.q) if names else []
    scale = np.asarray(system.coordinate_scale())
    _, sizes, rows = np.linalg.svd(np.asarray(system.coordinate_jacobian(t, start.q)) * scale, full_matrices=True)
    free = rows[np.count_nonzero(sizes > _DEPENDENT * np.max(sizes, initial=0.0)) :]
    chosen, base = [], np.zeros((0, len(free)))
    for name, slope in zip(names, np.asarray(slopes), strict=True):
        along = free @ (scale * slope)
        left = along - base.T @ (base @ along)
        if np.linalg.norm(left) > _DEPENDENT * np.linalg.norm(scale * slope):
            chosen, base = [*chosen, name], np.concatenate([base, [left / np.linalg.norm(left)]])
    return chosen
