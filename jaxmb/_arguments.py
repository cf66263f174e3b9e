"""Checks of users' arguments, with messages that name the argument."""

import importlib
import warnings
from types import UnionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .linalg.arrays import as_array, is_traced


def check_kind(name: str, value: Any, kind: type | UnionType, expected: str, cure: str) -> None:
    """Raise a `ValueError` unless an argument is an instance of a class."""
    if isinstance(value, kind):
        return
    given = f"the class {value.__name__}" if isinstance(value, type) else repr(value)
    if "\n" in given or len(given) > 60:
        given = f"an object of type {type(value).__name__}"
    raise ValueError(f"{name} must be {expected}, got {given}; {cure}.")


def real_array(name: str, value: Any, dtype: Any, shapes: tuple[tuple[int, ...], ...] | None = ((),)) -> Any:
    """An argument as an array of the given dtype, a NumPy array unless it is traced.

    **Arguments:** `shapes`: the allowed shapes, default a number's; None for any.

    **Raises:** `ValueError` for anything but real numbers, another shape, and NaN.
    """
    shape = real_shape(name, value, "a real number" if shapes == ((),) else "an array of real numbers")
    if shapes is not None and shape not in shapes:
        if shapes == ((),):
            raise ValueError(f"{name} must be a real number, got an array of shape {shape}.")
        raise ValueError(f"{name} must have shape {' or '.join(map(str, shapes))}, got {shape}.")
    array = as_array(value, dtype)
    # NaN alone differs from itself; `np.isnan` takes four times as long, and every call passes here.
    if not is_traced(array) and (array != array).any():
        raise ValueError(f"{name} must not be NaN, got {value!r}.")
    return array


def real_shape(name: str, value: Any, expected: str = "a real number or an array of them") -> tuple[int, ...]:
    """The shape of real numbers.

    **Raises:** `ValueError` for text, None, complex numbers and ragged lists.
    """
    try:
        array = jax.eval_shape(jnp.asarray, value) if is_traced(value) else np.asarray(value)
    except (TypeError, ValueError):
        array = np.asarray(None)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name} must be {expected}, got {value!r}.")
    return array.shape


def bounds_of(
    label: str, given: Any, shape: tuple[int, ...], dtype: Any = float, equal: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Both bounds of a value as arrays of its shape, infinite where there is none.

    **Arguments:** `given`: `(low, high)`, either of them None; whether the two may be `equal`.

    **Raises:** `ValueError` for anything but a pair of numbers or arrays of the shape, and for reversed bounds.
    """
    sides: Any = () if isinstance(given, str) else given
    try:
        low, high = sides
    except (TypeError, ValueError):
        raise ValueError(f"{label} must be a pair (low, high), either of them None; got {given!r}.") from None
    shapes = ((), shape) if shape else ((),)
    low = real_array(f"{label}: low", -np.inf if low is None else low, dtype, shapes)
    high = real_array(f"{label}: high", np.inf if high is None else high, dtype, shapes)
    if np.any(low > high) or (not equal and np.any(low == high)):
        raise ValueError(f"{label} must be (low, high) with low {'≤' if equal else '<'} high, got {given}.")
    return np.broadcast_to(low, shape), np.broadcast_to(high, shape)


def whole_number(name: str, value: Any, least: int = 1, otherwise: str = "") -> int:
    """An integer argument, of Python or NumPy, as a Python integer.

    **Arguments:** `otherwise`: the alternative to name in the message: `", or None"`.

    **Raises:** `ValueError` for another kind of value, True and False among them, and for a value below the least.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}{otherwise}, got {value!r}.")
    return int(value)


def probability(name: str, value: Any) -> float:
    """An argument between zero and one, both excluded.

    **Raises:** `ValueError` for any other value; for a percentage it names the fraction.
    """
    number = float(real_array(name, value, np.dtype(float)))
    if not 0 < number < 1:
        meant = f": for {number:g} % give {number / 100:g}" if 1 < number < 100 else ""
        raise ValueError(f"{name} must be a probability between 0 and 1, got {value!r}{meant}.")
    return number


def warn_of_degrees(label: str, angle: Any, stacklevel: int) -> None:
    """Warn of an angle [rad] of more than a full turn; `stacklevel`: the user's place, counted from the caller."""
    if not is_traced(angle) and abs(float(angle)) > 2 * np.pi:
        warnings.warn(
            f"{label}: the angle {angle:g} rad is more than a full turn; angles are in radians, "
            f"np.deg2rad({angle:g}) is {np.deg2rad(float(angle)):.4g}.",
            stacklevel=stacklevel + 1,
        )


def package_for_tables(name: str, install: str) -> Any:
    """A package for tables, imported at its first use."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(f'This table needs {name}; install it with: pip install "{install}"') from None
