"""Quantities at one state by name."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
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
    motion = still(system, state, real_array("t", t, state.q.dtype))
    catalogue = system.catalogue
    measures, forces = catalogue.measures(), catalogue.force_names() if system.body_names else ()
    for name in chosen:
        if name not in measures and name not in (*_ENERGIES, *forces):
            raise unknown("quantity", name, (*measures, *_ENERGIES, *forces))
    of_forces = any(measures[name].of_forces if name in measures else name not in _ENERGIES for name in chosen)
    solved = _solved(motion) if of_forces else None
    values = {name: _value(motion, measures, name, solved) for name in chosen}
    return values[names] if isinstance(names, str) else values


def _value(motion, measures, name, solved) -> Array:
    if name in measures:
        measure = measures[name]
        return _quantity(motion, measure.view, measure.place, solved if measure.of_forces else None)
    return _energy(motion, name) if name in _ENERGIES else _wrenches(motion, name, solved)


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
