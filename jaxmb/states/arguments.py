"""Checks of what a user gives to `assemble` and `equilibrium`."""

from typing import Any

import jax
from jaxtyping import Array

from .._arguments import check_kind, real_array
from .._types import Scalar, State
from ..linalg.arrays import is_traced
from ..system import AbstractSystem


def check_system(function: str, system: Any) -> None:
    """Raise a `ValueError` for anything but a compiled scene or another system."""
    cure = "compile the scene first, scene.compile()" if hasattr(system, "compile") else "scene.compile() makes one"
    check_kind(f"{function}: system", system, AbstractSystem, "a compiled scene or another system", cure)


def check_no_states(function: str, system: AbstractSystem) -> None:
    """Raise a `ValueError` for a system with internal states, where they are not supported."""
    if system.nz:
        names = ", ".join(system.state_names())
        raise ValueError(f"{function} does not support internal states; the system has {names}.")


def checked_guess(function: str, system: AbstractSystem, guess: Any) -> State:
    """The guess as arrays, or the system's own where none is given."""
    if guess is None:
        return system.guess
    check_kind(f"{function}: guess", guess, State, "a State(q, u)", "assemble returns one")
    if guess.z is not None and system.nz == 0:
        raise ValueError(f"{function}: guess.z: the system has no internal states.")
    # A guess without internal states takes those of the system's own.
    z: Any = system.guess.z
    if guess.z is not None:
        z = _vector(f"{function}: guess.z", guess.z, z)
    return State(
        _vector(f"{function}: guess.q", guess.q, system.guess.q),
        _vector(f"{function}: guess.u", guess.u, system.guess.u),
        z,
    )


def checked_time(function: str, t: Scalar, dtype: Any) -> Any:
    """The time as an array without axes."""
    return real_array(f"{function}: t", t, dtype)


def _vector(label: str, value: Any, like: Array) -> Array:
    array = real_array(label, value, like.dtype, (like.shape,))
    if isinstance(value, jax.Array):
        # As it is: under a trace a copy of known numbers would be traced as well.
        return value
    return array if is_traced(array) else jax.device_put(array)
