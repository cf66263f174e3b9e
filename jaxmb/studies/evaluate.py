"""Quantities at one state by name."""

import functools
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from .._arguments import real_array
from .._types import Scalar, State
from ..formulations.laws import accelerations_at
from ..formulations.shares import least_multipliers
from ..linalg.arrays import is_traced
from ..linalg.jitted import FOR_FEW_CALLS, jitted
from ..parts.names import names_arguments, unknown
from ..simulate.arguments import checked_state
from ..system import AbstractSystem
from ..system.instant import Instant
from ..system.quantities import Solved
from ..trajectory import still
from .linear.quantities import checked_names

_NOTHING: Mapping[str, Any] = MappingProxyType({})
_ENERGIES = ("energy", "kinetic_energy", "potential_energy")


@names_arguments
def evaluate(system: AbstractSystem, state: State, names: str | Sequence[str], *, t: Scalar = 0.0) -> Any:
    """Quantities at one state, by the names that they have along a motion.

    ```python
    reach = jaxmb.evaluate(system, state, "pin.angle")
    values = jaxmb.evaluate(system, state, ["pin.angle_rate", "pin.force", "bar.acceleration", "energy"])
    values["pin.force"]
    ```

    Accelerations and forces are those of the equations of motion at the state, which need not be at rest.

    **Arguments:**

    - `system`, and a `state` on its constraints, as from `assemble`, `equilibrium` or `motion.end`.
    - `names`: one name or several.
        - Quantities, as `Trajectory.quantity` takes them: coordinates of joints, tendons and ropes with their rates and
            accelerations; `"pin.force"` and `"pin.moment"` of joints; motions of bodies and frames; internal states.
            `system.quantities()` lists them.
        - Coordinates of bodies with their rates, `"bar.x"`, `"bar.angle_rate"`.
        - `"energy"`, `"kinetic_energy"` and `"potential_energy"` [J].
        - Names of force elements: the wrenches on their bodies, as in `Trajectory.forces`.
    - `t`: the time [s], for functions of time.

    **Returns:** for one name an array, for several a dictionary of arrays, in the units and axes of a motion, without
    its axis of time. The arrays have derivatives by the state, the time and all parameters. `jax.vmap` takes batches of
    states and systems, such as `jax.vmap(lambda y: jaxmb.evaluate(system, y, "pin.angle"))(motion.ys)`.

    An angle of a joint in space is in (−π, π] unless the state carries turns. The first call for a kind of quantity
    compiles a short program, which serves all parts of this kind.

    **Raises:** `ValueError` for unknown names, with the nearest ones, and for a state of another shape.
    """
    chosen = checked_names("quantity", (names,) if isinstance(names, str) else names)
    state = checked_state(system, state)
    reading = Reading(system, state, real_array("t", t, state.q.dtype))
    for name in chosen:
        reading.check(name)
    values = {name: reading[name] for name in chosen}
    return values[names] if isinstance(names, str) else values


class Reading:
    """A system at one instant, for functions of it: `at["pin.force"]` is a quantity, as of `evaluate`, and `at["time"]`
    the time [s].

    **Fields:** the `system`, the `state` and the time `t`; `given`: further values by name.
    """

    def __init__(self, system: AbstractSystem, state: State, t: Scalar, given: Mapping[str, Array] = _NOTHING):
        self.system, self.state, self.t, self.given = system, state, t, {"time": t, **given}
        self._motion = still(system, state, t)
        self._measures = system.catalogue.measures()
        self._coordinates = {
            name: (vector, places)
            for vector, names in (("q", system.coordinate_names()), ("u", system.rate_names()))
            for name, places in names.items()
        }
        self._wrenches = system.catalogue.force_names() if system.body_names else ()

    @functools.cached_property
    def _solved(self) -> Solved:
        return _solved(self._motion)

    @property
    def names(self) -> tuple[str, ...]:
        """All names."""
        return (*self._measures, *self._coordinates, *_ENERGIES, *self._wrenches, *self.given)

    def check(self, name: str) -> None:
        """Raise a `ValueError` for an unknown name, with the nearest ones."""
        if name not in self.names:
            raise unknown("quantity", name, self.names)

    def __getitem__(self, name: str) -> Array:
        self.check(name)
        if name in self.given:
            return self.given[name]
        if name in self._measures:
            measure = self._measures[name]
            return _quantity(self._motion, measure.view, measure.place, self._solved if measure.of_forces else None)
        if name in self._coordinates:
            vector, places = self._coordinates[name]
            values = getattr(self.state, vector)[np.asarray(places)]
            return values if len(places) > 1 else values[0]
        if name in _ENERGIES:
            return _energy(self._motion, name)
        return _wrenches(self._motion, name, self._solved)


def _short(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of a motion with one time as a program, which compiles as fast as possible if all numbers are known.

    (Of a four-bar the first position, angle, energy and joint force then take 0.02, 0.06, 0.04 and 0.5 s, without a
    program of JAX's operations 0.1, 0.7, 0.5 and 6 s.)
    """
    known, traced = jitted(function, FOR_FEW_CALLS), jitted(function)
    return lambda *arguments: (traced if is_traced(arguments) else known)(*arguments)


@_short
def _quantity(motion, view, place, solved):
    states = motion.ys if solved is None else motion.bearing
    return view(motion.system, place, motion.ts, states, solved)[0]


@_short
def _energy(motion, name):
    return getattr(motion, name)[0]


@_short
def _wrenches(motion, name, solved):
    return motion.system.catalogue.applied_wrenches(name, motion.ts, motion.bearing, solved.multipliers)[0]


@_short
def _solved(motion) -> Solved:
    """Accelerations and multipliers, with an axis of time."""
    # Without `vmap`, which would turn choices of pivots into choices of every member of a batch.
    at = Instant.of(motion.system, motion.ts[0], jax.tree.map(lambda y: y[0], motion.ys))
    udot, multipliers = accelerations_at(at, motion.formulation)
    return Solved(udot[None], least_multipliers(at, multipliers)[None])
