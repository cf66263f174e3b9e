"""The arguments of `assemble`, `equilibrium` and `assembly_gap`: checks, and coordinates prescribed by name.

A name denotes a coordinate of the system, or a coordinate of a joint.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._arguments import check_kind, real_array, real_shape, warn_of_degrees
from .._compat import canonical
from .._types import Scalar, State, VectorLike
from ..linalg.arrays import as_array, is_traced, replaced
from ..parts.names import UnknownNameError, unknown
from ..system import AbstractSystem
from ..system.quantities import rates_of
from .consistency import not_finite


def check_system(function: str, system: Any) -> None:
    """Raise a `ValueError` unless `system` is a compiled scene or another system, in JAX's precision."""
    cure = "compile the scene first, scene.compile()" if hasattr(system, "compile") else "scene.compile() makes one"
    check_kind(f"{function}: system", system, AbstractSystem, "a compiled scene or another system", cure)
    check_precision(function, system)


def check_precision(function: str, system: AbstractSystem) -> None:
    """Raise a `ValueError` for a system that was made before `jax_enable_x64` was switched.

    Its numbers keep the other precision, which would limit the accuracy of a motion.
    """
    old, now = system.guess.q.dtype, canonical()
    if old != now:
        raise ValueError(
            f"{function}: the system has numbers of {old}, and JAX now makes {now}: jax_enable_x64 was switched after "
            'the system was made. Set jax.config.update("jax_enable_x64", …) first, and make the system after it.'
        )


def check_no_states(function: str, system: AbstractSystem) -> None:
    """Raise a `ValueError` for a system with internal states, in functions that do not support them."""
    if system.nz:
        names = ", ".join(system.state_names())
        raise ValueError(f"{function} does not support internal states; the system has {names}.")


def checked_guess(function: str, system: AbstractSystem, guess: Any) -> State:
    """The guess as arrays; by default the system's guess."""
    if guess is None:
        return system.guess
    check_kind(f"{function}: guess", guess, State, "a State(q, u)", "assemble returns one")
    if guess.z is not None and system.nz == 0:
        raise ValueError(f"{function}: guess.z: the system has no internal states.")
    vectors = {"q": (guess.q, system.nq), "u": (guess.u, system.nu)}
    known = {key: x for key, (x, size) in vectors.items() if not is_traced(x) and np.shape(x) == (size,)}
    wrong = not_finite(system, **{key: x for key, x in known.items() if np.asarray(x).dtype.kind == "f"})
    if wrong:
        raise ValueError(f"{function}: the guess is not finite: {wrong}.")
    # A guess without internal states takes the internal states of the system's guess.
    z: Any = system.guess.z
    if guess.z is not None:
        z = _vector(f"{function}: guess.z", guess.z, z)
    # The closest state to longer or shorter Euler parameters would be another one.
    return State(
        system.with_unit_attitudes(_vector(f"{function}: guess.q", guess.q, system.guess.q)),
        _vector(f"{function}: guess.u", guess.u, system.guess.u),
        z,
        guess.angles,
    )


def counted_angles(system: AbstractSystem, guess: State, values: Mapping[str, Any]) -> Any:
    """The angles of a state [rad], which tell its full turns: of the guess, and prescribed `values`; None if all are
    within half a turn.
    """
    places = {name: k for k, name in enumerate(system.wrapped_angle_names()) if name in values} if values else {}
    within = lambda value: not is_traced(value) and abs(float(value)) <= np.pi
    if guess.angles is None and all(within(values[name]) for name in places):
        return None
    dtype = guess.q.dtype
    none = np.zeros(len(system.wrapped_angle_names()), dtype)
    angles: Any = none if guess.angles is None else guess.angles
    for name, k in places.items():
        angles = replaced(angles, np.array([k]), jnp.asarray(values[name], dtype)[None])
    return angles


def checked_time(function: str, t: Scalar, dtype: Any) -> Any:
    """The time as an array without axes."""
    return real_array(f"{function}: t", t, dtype)


def _vector(label: str, value: Any, like: Array) -> Array:
    array = real_array(label, value, like.dtype, (like.shape,))
    if isinstance(value, jax.Array):
        # Without a copy: under a trace a copy of concrete numbers would be traced.
        return value
    return array if is_traced(array) else jax.device_put(array)


def prescribe(
    what: str, names: Mapping[str, list[int]], values: Mapping[str, VectorLike], vector: Float[Array, "n"]
) -> tuple[Float[Array, "n"], Bool[np.ndarray, "n"]]:
    """Write values by name into a vector.

    **Returns:** the vector, and a static mask of the entries that were prescribed.

    **Raises:** `ValueError` for unknown names, wrong shapes, values that are not real numbers, and entries with two
    values.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"A {what} is prescribed by name, {{'crank.angle': 0.3}}; got {values!r}.")
    fixed = np.zeros(vector.shape[0], bool)
    for name, value in values.items():
        if name not in names:
            raise unknown(what, name, names)
        index = names[name]
        shape = real_shape(f"{what.capitalize()} {name!r}", value)
        if shape not in ((), (len(index),)) or (shape == () and len(index) > 1):
            raise ValueError(f"{what.capitalize()} {name!r} has {len(index)} components, got shape {shape}.")
        if fixed[index].any():
            raise ValueError(f"{what.capitalize()} {name!r} is prescribed twice, by another name as well.")
        value = as_array(value, vector.dtype)
        vector = replaced(vector, np.array(index), value)
        fixed[index] = True
    return vector, fixed


def split_names(
    what: str, system: AbstractSystem, names: Mapping[str, Any], values: Mapping[str, VectorLike] | None
) -> tuple[dict[str, VectorLike], dict[str, Any]]:
    """Split prescribed values: `names` of the system, and coordinates of joints, whose values become arrays.

    **Raises:** `ValueError` for names of neither kind and for values of the wrong shape.
    """
    if values is None or not isinstance(values, Mapping) or all(name in names for name in values):
        return ({} if values is None else values), {}  # pyright: ignore[reportReturnType]
    joint_coordinates, dtype = system.joint_coordinates(), jnp.result_type(float)
    of_joints = {}
    for name, value in values.items():
        if name not in names:
            if name not in joint_coordinates:
                raise unknown(what, name, (*names, *joint_coordinates, *system.state_names()))
            of_joints[name] = jnp.asarray(
                real_array(f"{what.capitalize()} {name!r}", value, dtype, (joint_coordinates[name].shape,))
            )
    return {name: value for name, value in values.items() if name in names}, of_joints


def split_coordinates(
    system: AbstractSystem, values: Mapping[str, VectorLike] | None
) -> tuple[dict[str, VectorLike], dict[str, Any]]:
    """`split_names` of coordinates, with a warning about angles beyond a full turn, which may be in degrees.

    Angles of joints may count turns, so the warning is for multiples of five only.

    **Raises:** `ValueError` for a rate, and as `split_names`.
    """
    if values is None:
        return {}, {}
    if isinstance(values, Mapping):
        coordinates, rates = system.coordinate_names(), rates_of(system.rate_names())
        for name in values:
            base = str(name).removesuffix("_rate")
            if name not in coordinates and (name in rates or (base != name and base in system.joint_coordinates())):
                raise UnknownNameError(
                    f"{name!r} is a rate, and fix holds coordinates: assemble takes it as rates={{{base!r}: …}}."
                )
    of_system, of_joints = split_names("coordinate", system, system.coordinate_names(), values)
    if isinstance(of_system, Mapping):
        for name, value in (*of_system.items(), *of_joints.items()):
            is_angle = name.rpartition(".")[2].startswith("angle")
            if not is_angle or is_traced(value) or real_shape(f"Coordinate {name!r}", value) != ():
                continue
            if name in of_system or float(np.asarray(value)) % 5 == 0:
                # The caller of this function is `assemble` or its like, which the user calls.
                warn_of_degrees(f"fix={{{name!r}: …}}", value, stacklevel=4)
    return of_system, of_joints


def split_rates(
    system: AbstractSystem, values: Mapping[str, VectorLike] | None
) -> tuple[dict[str, VectorLike], dict[str, Any]]:
    """`split_names` of rates, also by the names of their coordinates.

    **Returns:** values of the system's rates, and of rates of joints, by the names of the joints' coordinates.

    **Raises:** `ValueError` for a rate that is named twice, and as `split_names`.
    """
    if values is None:
        return {}, {}
    names = rates_of(system.rate_names())
    if isinstance(values, Mapping):
        twice = [name for name in values if f"{name}_rate" in values]
        if twice:
            raise ValueError(f"{twice[0]!r} and '{twice[0]}_rate' are the same rate; prescribe one of them.")
        # Names of joints' coordinates cost a trace of each joint, which most calls can spare.
        if any(name not in names for name in values):
            of_joints = {f"{name}_rate": name for name in system.joint_coordinates()}
            values = {of_joints.get(name, name): value for name, value in values.items()}
    return split_names("rate", system, names, values)


def split_internal_states(
    system: AbstractSystem, z: Float[Array, "nz"] | None, values: Mapping[str, VectorLike] | None
) -> tuple[Float[Array, "nz"] | None, Mapping[str, VectorLike] | None]:
    """Internal states with some of them prescribed by name, and the remaining prescribed values.

    **Raises:** `ValueError` for values of the wrong shape, and for values that are not finite.
    """
    if z is None or not isinstance(values, Mapping):
        return z, values
    names = system.state_names()
    given = {name: value for name, value in values.items() if name in names}
    z, _ = prescribe("internal state", names, given, z)
    if not is_traced(z) and not np.all(np.isfinite(z)):
        raise ValueError(f"The guess or the fixed internal states are not finite: {np.asarray(z)}.")
    return z, {name: value for name, value in values.items() if name not in given}


def holding(system: AbstractSystem, values: Mapping[str, Any], rates: Mapping[str, Any], t: Scalar) -> AbstractSystem:
    """The system with coordinates of joints held at `values` at time t; they change at `rates`, zero by default."""
    if not values:
        return system
    rates = {name: rates.get(name, jnp.zeros_like(value)) for name, value in values.items()}
    return system.holding(values, rates, t)
