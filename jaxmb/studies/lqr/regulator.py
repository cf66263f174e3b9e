"""The result of `lqr`: gains, and a part that applies them."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..._printed import preformatted
from ..._types import Scalar, State
from ...linalg.arrays import is_traced
from ...linalg.jitted import jitted
from ...parts.controller import Controller
from ...parts.coordinate_parts import shortest
from ...parts.names import unknown
from ...parts.series import Series
from ...system import AbstractSystem
from ..linear.eigen import eigen
from ..linear.perturbations import coordinate_function, internal_names, rate_function

# Coordinates and rates of bodies as components of the quantities that a controller measures.
_OF_BODIES = {
    **{
        f"{axis}{end}": (name, k)
        for end, name in (("", "position"), ("_rate", "velocity"))
        for k, axis in enumerate("xyz")
    },
    "angle": ("angle", None),
    "angle_rate": ("angular_velocity", None),
    **{f"w{axis}": ("angular_velocity", k) for k, axis in enumerate("xyz")},
}


class Measured(NamedTuple):
    """How a controller measures a state: the `quantity`, the `place` in its raveled array (None for a number), and
    whether it is an angle known up to full turns.
    """

    quantity: str
    place: int | None
    periodic: bool


def measured_as(system: AbstractSystem, state: str) -> Measured | None:
    """How a controller measures a state of `linearise`; None if it cannot."""
    name, _, index = state.partition("[")
    joint = system.joint_coordinates().get(name.removesuffix("_rate"))
    if joint is not None:
        place = int(np.ravel_multi_index(tuple(map(int, index[:-1].split(","))), joint.shape)) if index else None
        return Measured(name, place, joint.periodic and not name.endswith("_rate"))
    body, _, direction = name.rpartition(".")
    if direction in _OF_BODIES and name in {*system.coordinate_names(), *system.rate_names()}:
        quantity, place = _OF_BODIES[direction]
        return Measured(f"{body}.{quantity}", place, False)
    return None


@jitted
def values_of(system: AbstractSystem, t: Scalar, state: State, names: tuple[str, ...]) -> Float[Array, "k"]:
    """The values of the states of a linearisation at its state; zero for displacements from it."""
    internal = dict(zip(internal_names(system), () if state.z is None else state.z, strict=True))
    rates = system.rate_names()

    def of(name):
        if name in internal:
            return internal[name]
        if measured_as(system, name) is None:
            return jnp.zeros((), state.q.dtype)
        is_rate = name in rates or name.split("[")[0].endswith("_rate")
        function = rate_function if is_rate else coordinate_function
        return function(system, t, state, name)(state)

    return jnp.stack([of(name) for name in names])


class _Feedback(NamedTuple):
    """The function of a controller: `reference input − gains (measured − reference)`."""

    measured: tuple[Measured, ...]
    acts_on: tuple[str, ...]

    def __call__(self, t, measured, states, parameters):
        del states

        def now(value: Any) -> Any:
            return value(t) if callable(value) else value

        values = [jnp.ravel(measured[own.quantity])[own.place or 0] for own in self.measured]
        change = jnp.stack(values) - now(parameters["states"])
        periodic = np.array([own.periodic for own in self.measured])
        if periodic.any():
            change = jnp.where(periodic, shortest(change), change)
        forces = now(parameters["inputs"]) - now(parameters["gains"]) @ change
        return (dict(zip(self.acts_on, forces, strict=True)) if len(self.acts_on) > 1 else forces[0]), {}


class Regulator(eqx.Module):
    """Linear feedback `input = reference input − K (state − reference state)`, the result of `lqr`. `print` shows K.

    ```python
    print(regulator)  # Its gains and eigenvalues, for `regulator` from `lqr`.
    regulator.gains, regulator.eigenvalues, regulator.states
    ```

    **Fields:**

    - `gains` K (inputs, states), in SI units; along a plan (times, inputs, states), at the times `ts` [s], and linear
        between them.
    - `cost` X (states, states): the least cost from changes z of the states on is `zᵀ X z`; along a plan at the times.
    - `closed` (states, states): `A − B K` of the linear equations; along a plan at the times.
    - `reference_states`, `reference_inputs`: their values at the equilibrium; along a plan `Series`, functions of time.
    - `ts`: None at an equilibrium.
    - `states`, `inputs`: their names.
    """

    gains: Float[Array, "*times i k"]
    cost: Float[Array, "*times k k"]
    closed: Float[Array, "*times k k"]
    reference_states: Float[Array, "k"] | Series
    reference_inputs: Float[Array, "i"] | Series
    ts: Float[Array, "times"] | None
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    measured: tuple[Measured | None, ...] = eqx.field(static=True)

    @property
    def eigenvalues(self) -> Complex[Array, "*times k"]:
        """The eigenvalues of `closed` [1/s] in order of their sizes; at an equilibrium all have negative real parts.
        Simple eigenvalues are differentiable.
        """
        of_one = lambda closed: eigen(closed, jnp.ones(len(self.states), bool))[0]
        for _ in range(self.closed.ndim - 2):
            of_one = jax.vmap(of_one)
        return of_one(self.closed)

    def controller(self, name: str, acts_on: Mapping[str, str]) -> Controller:
        """The feedback as a part of a scene, in place of the forces that are the inputs.

        Angles of joints in space take the shortest way to their reference. After the end of a plan the last gains,
        states and inputs hold. The gains and references are parameters of the part, `"name.gains"`, `"name.states"` and
        `"name.inputs"`. Planned controls that are `"held"` jump at nodes: `simulate(…, jumps=plan.ts[1:-1])`.

        **Arguments:** `name` of the part; `acts_on`: for each input the coordinate that increases with it, and on which
        it acts with the force of the same number, `{"push.force": "slide.displacement"}`.

        **Raises:** `ValueError` for missing and unknown inputs, and for states that a controller cannot measure.
        """
        if not isinstance(acts_on, Mapping):
            raise ValueError(f"{name}: acts_on must be coordinates by input, {{'push.force': 'slide.displacement'}}.")
        for given in acts_on:
            if given not in self.inputs:
                raise unknown("input", given, self.inputs, name)
        if missing := [given for given in self.inputs if given not in acts_on]:
            raise ValueError(f"{name}: acts_on has no coordinate for the input {missing[0]!r}.")
        if unseen := [state for state, own in zip(self.states, self.measured, strict=True) if own is None]:
            raise ValueError(
                f"{name}: a controller cannot measure the state {unseen[0]!r}. Name coordinates of joints instead, "
                "linearise(…, coordinates=['pin.angle'])."
            )
        measured = tuple(own for own in self.measured if own is not None)
        coordinates = tuple(acts_on[given] for given in self.inputs)
        gains = self.gains if self.ts is None else Series(self.ts, self.gains)
        return Controller(
            name,
            _Feedback(measured, coordinates),
            {own.quantity: own.quantity for own in measured},
            coordinates,
            parameters={"gains": gains, "states": self.reference_states, "inputs": self.reference_inputs},
        )

    def __repr__(self) -> str:
        place = "at an equilibrium" if self.ts is None else "along a plan"
        return f"Regulator {place}: {len(self.states)} states, {len(self.inputs)} inputs"

    def _repr_html_(self) -> str:
        return preformatted(self)

    def __str__(self) -> str:
        if is_traced(self.gains) or self.gains.ndim != (2 if self.ts is None else 3):
            return repr(self)
        last = np.asarray(self.gains if self.ts is None else self.gains[-1])
        columns: Sequence[np.ndarray] = [last]
        heads = list(self.inputs)
        if self.ts is not None:
            columns = [np.asarray(self.gains[0]), last]
            heads = [f"{name} at {float(t):.4g} s" for t in (self.ts[0], self.ts[-1]) for name in self.inputs]
        numbers = np.concatenate(columns).T
        width, room = max(map(len, ("state", *self.states))), [max(len(head), 12) for head in heads]
        lines = [f"{'state':{width}}" + "".join(f"  {head:>{w}}" for head, w in zip(heads, room, strict=True))]
        for name, row in zip(self.states, numbers, strict=True):
            lines.append(f"{name:{width}}" + "".join(f"  {x:>{w}.6g}" for x, w in zip(row, room, strict=True)))
        if self.ts is None:
            values = [
                f"{x.real:.4g}" + (f" ± {x.imag:.4g}i" if x.imag else "")
                for x in np.asarray(self.eigenvalues)
                if x.imag >= 0
            ]
            lines += ["", f"closed loop [1/s]: {', '.join(values)}"]
        return "\n".join(lines)
