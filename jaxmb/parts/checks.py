"""Checks of a part's numbers against the declarations of its fields."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..linalg.arrays import is_traced
from .fields import Declaration, declarations, values_of

# A direction counts as a unit vector if its length differs from one by no more than this.
_UNIT = 1e-6


def check_kinds(part: Any, label: str) -> None:
    """Raise a `ValueError` if the value of a field is not of the declared kind."""
    values = values_of(part)
    for field, declared in declarations(type(part)).items():
        value = values[field]
        if declared.is_number:
            if not _is_number(value) and not (value is None and declared.optional):
                raise ValueError(
                    f"{label}: {field}: expected a real number or an array of real numbers, got {value!r}."
                )
        elif declared.kind in ("identity", "body"):
            if not isinstance(value, str):
                raise ValueError(f"{label}: {field} must be a name, got {value!r}.")
        elif declared.kind in ("identities", "bodies"):
            given = value or declared.optional
            if not isinstance(value, tuple) or not all(isinstance(name, str) for name in value) or not given:
                what = "a body" if declared.kind == "bodies" else "a part"
                raise ValueError(f"{label}: {field} must be the name of {what} or several names, got {value!r}.")
        elif declared.kind == "choice":
            if value not in declared.of:
                raise ValueError(f"{label}: {field} must be one of {declared.of}, got {value!r}.")
        elif declared.kind in ("numbers", "internals"):
            if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
                raise ValueError(f"{label}: {field} must be a dictionary of numbers, got {value!r}.")
            for key, number in value.items():
                if not key or "." in key:
                    raise ValueError(f"{label}: names of {field} must not be empty or contain a dot, got {key!r}.")
                if not _is_number(number):
                    raise ValueError(f"{label}: {key}: expected a real number or an array, got {number!r}.")
        elif not isinstance(value, declared.of):
            raise ValueError(f"{label}: {field} must be {declared.what}, got {value!r}.")


def _is_number(value: Any) -> bool:
    # JAX transformations may put other objects in place of arrays.
    return hasattr(value, "shape") and hasattr(value, "dtype") and value.dtype.kind == "f"


def in_range(declared: Declaration, values: Float[Array, "..."]) -> Bool[Array, ""]:
    """Whether numbers that are traced, perhaps of several parts, are finite, of the declared sign, and unit vectors."""
    values, sign = lax.stop_gradient(values), declared.sign
    ok = jnp.all(jnp.isfinite(values))
    if sign == "nonzero":
        ok &= jnp.all(values != 0)
    elif sign == "positive":
        ok &= jnp.all(values > 0)
    elif sign == "non-negative":
        ok &= jnp.all(values >= 0)
    elif sign == "positive definite":
        minors = [jnp.linalg.det(values[..., :k, :k]) for k in range(1, values.shape[-1] + 1)]
        ok &= jnp.all(jnp.stack(minors) > 0)
    if declared.is_direction or declared.is_attitude:
        ok &= jnp.all(jnp.abs(jnp.linalg.norm(values, axis=-1) - 1.0) <= _UNIT)
    return ok


def check_numbers(part: Any, label: str, dimension: int, prefix: str = "") -> None:
    """Raise a `ValueError` for numbers of wrong shape or sign, non-finite ones, and directions that are not unit
    vectors, in the part and its laws.
    """
    values = values_of(part)
    for field, declared in declarations(type(part)).items():
        value, shown = values[field], prefix + field
        if declared.kind == "law":
            if value is not None:
                check_numbers(value, label, dimension, f"{shown}.")
        elif declared.kind == "numbers":
            for key, number in value.items():
                if not is_traced(number) and not np.all(np.isfinite(number)):
                    raise ValueError(f"{label}: {prefix}{key} must be finite, got {np.asarray(number)}.")
        elif declared.is_number and value is not None and not is_traced(value):
            _check_number(declared, label, shown, np.asarray(value), dimension)


def _check_number(declared: Declaration, label: str, shown: str, value: np.ndarray, dimension: int) -> None:
    if declared.shape is not None:
        shape = tuple(dimension if size == "d" else size for size in declared.shape)
        any_size = len(shape) == value.ndim and all(a in (None, b) for a, b in zip(shape, value.shape, strict=True))
        if not any_size:
            wanted = str(shape).replace("None", "any")
            raise ValueError(f"{label}: {shown} must have shape {wanted}, got {value.shape}.")
    if declared.kind == "internal":
        return  # In a compiled scene its values are in the state.
    if not np.isfinite(value).all():
        raise ValueError(f"{label}: {shown} must be finite, got {value.tolist()}.")
    sign = declared.sign
    if sign == "nonzero" and (value == 0).any():
        raise ValueError(f"{label}: {shown} must not be zero.")
    if (sign == "positive" and (value <= 0).any()) or (sign == "non-negative" and (value < 0).any()):
        raise ValueError(f"{label}: {shown} must be {sign}, got {value.tolist()}.")
    for row in np.atleast_2d(value) if declared.is_direction or declared.is_attitude else ():
        size = float(np.linalg.norm(row))
        if abs(size - 1.0) <= _UNIT:
            continue
        if declared.is_attitude:
            raise ValueError(
                f"{label}: {shown} must be unit Euler parameters (e0, e1, e2, e3), scalar first, got {row.tolist()} "
                f"of length {size:.6g}; normalise them, or make them with rotations.from_axis_angle."
            )
        cure = "divide it by its length" if size > 0 else "give a direction"
        raise ValueError(f"{label}: {shown} must be a unit vector, got {row.tolist()} of length {size:.6g}; {cure}.")
