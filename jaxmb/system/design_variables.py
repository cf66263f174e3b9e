"""Design variables: named numbers that determine several parameters of a system."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool

from .._arguments import bounds_of, real_array
from .._types import VectorLike
from ..linalg.arrays import is_traced
from ..parts.fields import as_jax

# Rounding of a value at its bound, in units of the spacing of floating-point numbers there.
_ROUNDING = 16


@dataclasses.dataclass(frozen=True)
class Variable:
    """A design variable: its value, and its bounds, scale and unit for studies.

    ```python
    length = jaxmb.Variable(1.0, bounds=(0.5, 2.0), unit="m")
    end = lambda v: {"pin.point_b": jnp.array([-0.5, 0.0]) * v["length"], "bar.inertia": v["length"] ** 2 / 12.0}
    pendulum = jaxmb.design(system, {"length": length}, end)
    ```

    **Arguments:**

    - `value`: a number, or an array of numbers.
    - `bounds`: `(low, high)`, either of them None; numbers, or arrays of the value's shape. Values beyond the bounds
        are refused, and studies search between the bounds.
    - `scale`: the size of a typical change, positive; default the distance of the bounds, or the value's size.
    - `unit`: for printing.

    **Raises:** `ValueError` for bounds that are reversed or that the value violates, and for a scale that is not
    positive.
    """

    value: Any
    bounds: tuple[ArrayLike | None, ArrayLike | None] = (None, None)
    scale: ArrayLike | None = None
    unit: str = ""

    def __post_init__(self):
        if is_traced((self.value, self.bounds, self.scale)):
            raise ValueError("A Variable takes numbers that are known; change its value with `with_parameters`.")
        value = real_array("value", self.value, np.result_type(float), None)
        if not np.all(np.isfinite(value)):
            raise ValueError(f"The value of a Variable must be finite, got {self.value!r}.")
        low, high = bounds_of("bounds", self.bounds, value.shape, value.dtype)
        if not np.all(_within(value, low, high)):
            raise ValueError(f"The value {_short(value)} is not within its bounds {_interval(low, high)}.")
        if self.scale is not None and np.any(_like("scale", self.scale, value) <= 0):
            raise ValueError(f"scale must be positive, got {self.scale!r}.")
        # Immutable, so that variables compare by value and are static in a system.
        freeze = lambda name, array: object.__setattr__(self, name, _frozen(array))
        freeze("value", value)
        object.__setattr__(self, "bounds", (_frozen(low), _frozen(high)))
        if self.scale is not None:
            freeze("scale", _like("scale", self.scale, value))

    @property
    def low(self) -> np.ndarray:
        """The lower bound, by default −∞; of the value's shape."""
        return np.asarray(self.bounds[0])

    @property
    def high(self) -> np.ndarray:
        """The upper bound, by default ∞; of the value's shape."""
        return np.asarray(self.bounds[1])


class DesignVariables(eqx.Module):
    """Design variables of a system with their present values, and the function that gives parameters from them.

    **Fields:** `values` by name; `variables`: names with their declarations; `derive(values)`: parameters by name;
    `derived`: names of these parameters.
    """

    values: dict[str, Array]
    variables: tuple[tuple[str, Variable], ...] = eqx.field(static=True)
    derive: Callable[[dict[str, Array]], Mapping[str, VectorLike]] = eqx.field(static=True)
    derived: tuple[str, ...] = eqx.field(static=True)

    def replaced(self, values: Mapping[str, VectorLike]) -> "DesignVariables":
        """The same variables, some with other values.

        **Raises:** `ValueError` for a wrong shape, and for concrete values out of bounds.
        """
        declared = dict(self.variables)
        new = dict(self.values)
        for name, value in values.items():
            array, variable = as_jax(value), declared[name]
            if array.shape != variable.low.shape:
                raise ValueError(f"Design variable {name!r} has shape {variable.low.shape}, got {array.shape}.")
            if not is_traced(array) and not np.all(_within(np.asarray(array), variable.low, variable.high)):
                raise ValueError(
                    f"Design variable {name!r} must be within {_interval(variable.low, variable.high)}, got "
                    f"{_short(np.asarray(array))}."
                )
            new[name] = array
        return DesignVariables(new, self.variables, self.derive, self.derived)

    def parameters(self) -> dict[str, Array]:
        """The parameters that follow from the present values."""
        return {name: as_jax(value) for name, value in self.derive(dict(self.values)).items()}

    def rows(self) -> list[tuple[str, str, str]]:
        """Name, value and remark of every variable, for the description of a system."""
        derived = ", ".join(self.derived)
        out = []
        for k, (name, variable) in enumerate(self.variables):
            value = self.values[name]
            shown = "traced" if is_traced(value) else _short(np.asarray(value))
            bounded = np.any(np.isfinite([variable.low, variable.high]))
            remark = [f"within {_interval(variable.low, variable.high)}"] * bool(bounded)
            alone = len(self.variables) == 1
            together = [f"gives {derived}" if alone else f"these variables together give {derived}"]
            last = k == len(self.variables) - 1
            out.append((name, f"{shown} {variable.unit}".rstrip(), "; ".join(remark + together * last)))
        return out


def variables_in_range(design: tuple[DesignVariables, ...]) -> bool | Bool[Array, ""]:
    """Whether all traced design variables are within their bounds; True without traced variables."""
    ok: Any = True
    for group in design:
        for name, variable in group.variables:
            value = group.values[name]
            if is_traced(value):
                ok = ok & jnp.all(_within(value, variable.low, variable.high))
    return ok


def description_rows(design: tuple[DesignVariables, ...]) -> list[tuple[str, str, str]]:
    """Name, value and remark of all design variables."""
    return [row for group in design for row in group.rows()]


def _within(value, low, high):
    slack = lambda bound: _ROUNDING * np.finfo(value.dtype).eps * np.abs(np.where(np.isfinite(bound), bound, 0.0))
    return (value >= (low - slack(low)).astype(value.dtype)) & (value <= (high + slack(high)).astype(value.dtype))


def _like(name: str, given: Any, value: np.ndarray) -> np.ndarray:
    array = real_array(name, given, value.dtype, ((), value.shape))
    return np.broadcast_to(array, value.shape)


def _frozen(array: Any) -> Any:
    listed = np.asarray(array).tolist()
    deep = lambda item: tuple(map(deep, item)) if isinstance(item, list) else item
    return deep(listed)


def _interval(low: np.ndarray, high: np.ndarray) -> str:
    return f"{_short(low)} … {_short(high)}"


def _short(array: np.ndarray) -> str:
    if array.ndim == 0 or (array.size > 1 and np.all(array == array.flat[0])):
        return f"{float(array.flat[0]):g}"
    return np.array2string(array, precision=6, separator=", ", threshold=6)
