"""Quantities of a motion, and the names of rates.

Rates have the same names everywhere: in `rates=`, `free_initial`, `Sensor`, measured data, states of `linearise`, and
`trajectory["hip"].angle_rate`. The name of a coordinate's rate is the coordinate's name with `_rate`:
`"hip.angle_rate"` of a joint, `"crank.angle_rate"` and `"crank.x_rate"` of a body, `"theta_rate"` of a
`LagrangianSystem`. The velocities of a body are `"crank.velocity"` and `"crank.angular_velocity"`; in space
`"frame.wx"`, `"frame.wy"` and `"frame.wz"` are components of the angular velocity in body axes. Only `rates=` takes
names of coordinates too, as in `rates={"crank.angle": 2.0}`.
"""

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..linalg.jitted import jitted


class Solved(NamedTuple):
    """Accelerations u̇ and multipliers λ along a motion, from the equations of motion; axis 0 is time."""

    accelerations: Float[Array, "times nu"]
    multipliers: Float[Array, "times rows"]


class Quantity(NamedTuple):
    """A quantity of a motion, such as the position of a body or the force of a joint.

    **Fields:** `shape` at one time; `value(ts, ys, solved)`: values along a motion, axis 0 is time; `of_forces`:
    whether the values depend on the accelerations or multipliers in `solved`, which is None otherwise; `of_spans`:
    whether its components belong to the spans of a rope.
    """

    shape: tuple[int, ...]
    value: Callable[[Any, Any, Any], Array]
    of_forces: bool = False
    of_spans: bool = False


class Measure(NamedTuple):
    """A quantity of all systems of one structure.

    **Fields:** `shape` at one time; `view(system, place, ts, ys, solved)`, made by `view_of_motion`; `place`: static
    values that choose a quantity of the view, and the indices of the part as arrays; `of_forces` and `of_spans` as in
    `Quantity`.
    """

    shape: tuple[int, ...]
    view: Callable[..., Array]
    place: Any
    of_forces: bool = False
    of_spans: bool = False


class Quantities(Mapping[str, Quantity]):
    """The quantities of a system by name, from the measures of its structure."""

    def __init__(self, system: Any, measures: Mapping[str, Measure]):
        self._system, self._measures = system, measures

    def __getitem__(self, name: str) -> Quantity:
        if not isinstance(name, str):
            raise TypeError(f"A quantity has a name, a string; got {name!r}. Give several names one after the other.")
        shape, view, place, *kind = self._measures[name]
        return Quantity(shape, functools.partial(view, self._system, place), *kind)

    def __iter__(self) -> Iterator[str]:
        return iter(self._measures)

    def __len__(self) -> int:
        return len(self._measures)


def view_of_motion(view: Callable[..., Any]) -> Callable[..., Any]:
    """Compile `view(system, place, ts, ys, …)` of a motion, and vectorise it over batches of motions.

    The axes of a batch come first in all arrays, except arrays in `place`. Other values in `place` are static. The
    indices of a part are arrays in `place`, so that all parts of one kind share a program.
    """

    def of_all(system, place, ts, *arrays):
        if ts.ndim <= 1:
            return view(system, place, ts, *arrays)
        return eqx.filter_vmap(lambda system, *batched: of_all(system, place, *batched))(system, ts, *arrays)

    return jitted(functools.wraps(view)(of_all))


@view_of_motion
def entries_along(system: Any, place: tuple[str, Any, tuple[int, ...]], ts: Any, ys: Any, solved: Any) -> Array:
    """Entries along a motion; `place`: one of q, u, z or accelerations, the first index, and the entries' shape."""
    del system, ts
    where, first, shape = place
    values = solved.accelerations if where == "accelerations" else getattr(ys, where)
    return lax.dynamic_slice_in_dim(values, first, math.prod(shape), axis=1).reshape(-1, *shape)


class BodyMotion(NamedTuple):
    """Motion of one body; axis 0 is time.

    **Fields:** `position` [m] of the mass centre and `velocity` [m/s], world axes, shape (times, 2) or (times, 3); in
    the plane `angle` [rad] and `angular_velocity` [rad/s], shape (times,); in space `orientation` (Euler parameters,
    (times, 4)) and `angular_velocity` [rad/s] in the body frame, (times, 3). A point mass has no attitude: None.

    The derivatives of both velocities are quantities: `trajectory.quantity("crank.acceleration")` [m/s²] and
    `"crank.angular_acceleration"` [rad/s²].
    """

    position: Array
    velocity: Array
    angle: Array | None
    orientation: Array | None
    angular_velocity: Array | None

    def __repr__(self) -> str:
        units = {"position": "m", "velocity": "m/s", "angle": "rad", "angular_velocity": "rad/s"}
        return f"BodyMotion: {with_shapes(self._asdict(), units)}"

    def __dir__(self) -> list[str]:
        return list(self._fields)

    def __getattr__(self, name: str) -> Any:
        of_forces = '; for accelerations: trajectory.quantity("NAME.acceleration")' if "accel" in name else ""
        raise AttributeError(f"The motion of a body has {', '.join(self._fields)}; got {name!r}{of_forces}.")


class Reaction(NamedTuple):
    """The force that a joint exerts on its last body that is not the ground; the other body receives the opposite.

    **Fields:** `force` [N], world axes; `moment` [N m], world axes, a scalar in the plane: about the joint's point on
    the body, or about the mass centre for a joint without points; `multipliers` of the joint's rows.
    """

    force: Float[Array, "*times d"]
    moment: Float[Array, "..."]
    multipliers: Float[Array, "*times rows"]

    def __repr__(self) -> str:
        return f"Reaction: {with_shapes(self._asdict(), {'force': 'N', 'moment': 'N m'})}"


def with_shapes(values: Mapping[str, Any], units: Mapping[str, str]) -> str:
    """Names of arrays with shapes and units, in one line for `print`, without values that are None."""
    shapes = {name: getattr(value, "shape", value) for name, value in values.items() if value is not None}
    return ", ".join(f"{name} {shape} {units.get(name, '')}".rstrip() for name, shape in shapes.items())


def single_names(names: Mapping[str, list[int]], count: int) -> list[str]:
    """The name of every entry of a vector, from the names of its parts."""
    out = {index[0]: name for name, index in names.items() if len(index) == 1}
    return [out[k] for k in range(count)]


def rates_of(names: Mapping[str, list[int]]) -> dict[str, list[int]]:
    """The names that `rates=` takes, from `names` of a system's rates.

    They are the names of rates, the names of coordinates, and for planar bodies `angular_velocity`, as in space.
    """
    turns = {
        f"{body}.angular_velocity": index
        for body, end, index in ((*name.rpartition(".angle_rate")[:2], index) for name, index in names.items())
        if end and f"{body}.velocity" in names
    }
    return turns | {name.removesuffix("_rate"): index for name, index in names.items()} | dict(names)


def directions(names: Mapping[str, list[int]]) -> dict[int, str]:
    """The direction of every velocity, from `names` of a system's rates: `"rod.x"`, `"rod.wx"`, `"theta"`."""
    return {index[0]: name.removesuffix("_rate") for name, index in names.items() if len(index) == 1}


def component_names(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names of the components of an array, `"A.force[0]"`; for a number, its name."""
    return [name + (f"[{', '.join(map(str, index))}]" if index else "") for index in np.ndindex(shape)]
