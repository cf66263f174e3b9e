"""The parameters of a system by name, `"part.field"`."""

from collections.abc import Mapping
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from .._types import VectorLike
from ..linalg.arrays import is_traced, replaced
from ..parts.fields import as_jax
from ..parts.names import unknown
from .equation import AbstractSystem

System = TypeVar("System", bound=AbstractSystem)


def parameters(system: AbstractSystem) -> dict[str, Array]:
    """Every parameter of a system by name.

    **Returns:** a dictionary `{"crank.mass": …, "A.point_b": …, "gravity.acceleration": …}`, in SI units and the
    shapes of the parts' fields. Numbers of a user function keep their own key, `"drive.speed"`.
    """
    leaves = {}
    for name, paths in system.parameter_paths().items():
        where, index = paths[0]
        value = where(system)
        leaves[name] = value if index is None else _of(value, index)
    return leaves


def with_parameters(system: System, values: Mapping[str, VectorLike]) -> System:
    """The same system with some parameters replaced; differentiable, and usable under `jit` and `vmap`.

    Ranks and index sets are kept: if a change makes implied rows independent, `compile` the scene anew.

    **Arguments:** `values`: new numbers by name, as in `parameters`; shapes must be those of the old ones.

    **Raises:** `ValueError` for an unknown name (with the nearest ones), a wrong shape, and numbers with which the
    scene would not compile. Under `jit`, `vmap` or a derivative the numbers are not known yet; `simulate` then ends
    with `RESULTS.invalid_parameters`, before the first step.
    """
    paths = system.parameter_paths()
    for name, value in values.items():
        if name not in paths:
            raise unknown("parameter", name, paths)
        if name in system.signals():
            raise ValueError(
                f"{name!r} is an input of this system, a function of time, which its value would not change; give "
                "another input instead."
            )
        value = as_jax(value)
        for where, index in paths[name]:
            old = where(system)
            shape = old.shape if index is None else old.shape[1:]
            if value.shape != shape:
                raise ValueError(f"Parameter {name!r} has shape {shape}, got {value.shape}.")
            system = eqx.tree_at(where, system, value if index is None else replaced(old, index, value))
    system.check_parameters(values)
    return system


def _of(values: Array, index: int) -> Array:
    return values[index] if is_traced(values) else jax.device_put(np.array(np.asarray(values)[index]))
