"""Checks of the arguments of `assemble` and `equilibrium`."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from .._types import Scalar, State
from ..linalg.arrays import as_array, is_traced
from ..system import AbstractSystem
from ..system.coordinates import real_numbers


def check_system(function: str, system: Any) -> None:
    """Raise a `ValueError` for anything but a compiled scene or another system."""
    if isinstance(system, AbstractSystem):
        return
    cure = "compile the scene first, scene.compile()" if hasattr(system, "compile") else "scene.compile() makes one"
    raise ValueError(f"{function}: system must be a compiled scene or another system, got {_shown(system)}; {cure}.")


def checked_guess(function: str, system: AbstractSystem, guess: Any) -> State:
    """The guess as arrays, default the guess of the system."""
    if guess is None:
        return system.guess
    if not isinstance(guess, State):
        raise ValueError(f"{function}: guess must be a State(q, u), got {_shown(guess)}; assemble returns one.")
    return State(
        _vector(f"{function}: guess.q", guess.q, system.guess.q),
        _vector(f"{function}: guess.u", guess.u, system.guess.u),
    )


def checked_time(function: str, t: Scalar, dtype: Any) -> Any:
    """The time as an array without axes."""
    if real_numbers(f"{function}: t", t) != ():
        raise ValueError(f"{function}: t must be one number [s], got shape {np.shape(t)}.")
    return as_array(t, dtype)


def _vector(label: str, value: Any, like: Array) -> Array:
    shape = real_numbers(label, value)
    if shape != like.shape:
        raise ValueError(
            f"{label} must have shape {like.shape}, got {shape}; mb.State(q, u) holds coordinates and rates."
        )
    if isinstance(value, jax.Array):
        return value
    value = as_array(value, like.dtype)
    return value if is_traced(value) else jax.device_put(value)


def _shown(value: Any) -> str:
    return repr(value) if value is None or isinstance(value, str | float | int) else f"a {type(value).__name__}"
