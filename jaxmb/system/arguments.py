"""Checks of arguments that users pass, with messages that name the argument."""

from typing import Any

import numpy as np

from ..linalg.arrays import as_array, is_traced


def check_kind(name: str, value: Any, kind: type, expected: str, cure: str) -> None:
    """Raise a `ValueError` unless an argument is an instance of a class."""
    if isinstance(value, kind):
        return
    given = f"the class {value.__name__}" if isinstance(value, type) else repr(value)
    if "\n" in given or len(given) > 60:
        given = f"an object of type {type(value).__name__}"
    raise ValueError(f"{name} must be {expected}, got {given}; {cure}.")


def real_array(name: str, value: Any, dtype: Any, shapes: tuple[tuple[int, ...], ...] | None = ((),)) -> Any:
    """An argument as an array of the given dtype, a NumPy array unless it is traced.

    **Arguments:** `shapes`: the allowed shapes, default that of a number; None for any.

    **Raises:** `ValueError` for anything but real numbers, another shape, and NaN.
    """
    if is_traced(value):
        return as_array(value, dtype)
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    if array.dtype.kind not in "fiub" or (shapes is not None and array.shape not in shapes):
        kinds = ("a real number" if shape == () else f"an array of shape {shape}" for shape in shapes or ())
        raise ValueError(f"{name} must be {' or '.join(kinds) or 'an array of real numbers'}, got {value!r}.")
    if np.any(np.isnan(array)):
        raise ValueError(f"{name} must not be NaN, got {value!r}.")
    return as_array(array, dtype)
