"""The parameters of a system by name, `"part.field"`, and its design variables."""

from collections.abc import Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from .._types import VectorLike
from ..linalg.arrays import is_traced, replaced
from ..parts.fields import as_jax
from ..parts.module_weights import weights_of, with_weights
from ..parts.names import unknown
from .system import AbstractSystem

System = TypeVar("System", bound=AbstractSystem)


def parameters(system: AbstractSystem) -> dict[str, Array]:
    """Every parameter of a system by name.

    ```python
    jaxmb.parameters(system)["bar.mass"], list(jaxmb.parameters(system))
    ```

    **Returns:** a dictionary `{"crank.mass": …, "A.point_b": …, "gravity.acceleration": …}`, in SI units and the
    shapes of the parts' fields. Numbers of a user function are listed by their keys, `"drive.speed"`, and variables of
    `design` by their names. The weights of a module, `"friction.net"`, are a vector; see `modules`.
    """
    leaves = {}
    for name, paths in system.parameter_paths().items():
        where, index = paths[0]
        value = where(system)
        leaves[name] = value if index is None else _of(value, index)
    for group in system.design:
        leaves |= group.values
    return leaves


def modules(system: AbstractSystem) -> dict[str, eqx.Module]:
    """The modules of a system, such as neural networks, whose weights are a parameter, by the parameter's name.

    ```python
    net = jaxmb.modules(jaxmb.with_parameters(system, fit.parameters))["friction.net"]
    ```

    **Returns:** the modules with their weights, as `with_parameters` takes them.
    """
    values = parameters(system)
    return {name: with_weights(like, values[name]) for name, like in system.parameter_table.modules().items()}


def with_parameters(system: System, values: Mapping[str, VectorLike | eqx.Module]) -> System:
    """Replace some parameters of a system; differentiable, and usable under `jit` and `vmap`.

    ```python
    heavier = jaxmb.with_parameters(system, {"bar.mass": 2.0, "bar.inertia": 2.0 / 12.0})
    ```

    Ranks and index sets are kept: if a change makes implied rows independent, `compile` the scene anew. The guess of
    the bodies' frames is kept as well: if `"rod.centre"` moves a mass centre, its guess moves too. The length of a bar
    appears in the points of its joints and in its inertia: change all of them, or give it one name by `design`. The
    scene's size, the unit of its tolerances, follows if its lengths change it by more than a factor of ten.

    **Arguments:** `values`: new numbers by name, as in `parameters`, of the same shapes. The weights of a module are
    given by a vector, or by a module that differs in its weights only. New design variables change all parameters that
    follow from them.

    **Returns:** the system with the new parameters.

    **Raises:** `ValueError` for an unknown name (with the nearest names), a wrong shape, another module, numbers that
    `compile` would refuse, design variables out of bounds, and a parameter that follows from design variables. Under
    `jit`, `vmap` or a derivative values cannot be checked at once; `simulate` then ends with
    `RESULTS.invalid_parameters`, before the first step.
    """
    paths = system.parameter_paths()
    variables = {name: group for group in system.design for name in group.values}
    for name in values:
        if name not in paths and name not in variables:
            raise unknown("parameter", name, [*paths, *variables])
        for group in system.design:
            if name in group.derived:
                several = "s" * (len(group.variables) > 1)
                names = ", ".join(variable for variable, _ in group.variables)
                raise ValueError(
                    f"Parameter {name!r} follows from the design variable{several} {names}; set "
                    f"{'those' if several else 'that'} instead."
                )
    given: dict[str, Any] = dict(values)
    design, before, inputs = [], system, system.parameter_table.input_names()
    # Design variables may follow from later design variables.
    for group in reversed(system.design):
        mine = {name: given.pop(name) for name in group.values if name in given}
        if mine:
            group = group.replaced(mine)
            given |= group.parameters()
        design.insert(0, group)
    for name, value in given.items():
        if name in inputs:
            raise ValueError(
                f"{name!r} is an input of this system, a function of time, which its value would not change; give "
                "another input instead."
            )
        value = _as_array(system, name, value)
        for where, index in paths[name]:
            old = where(system)
            shape = old.shape if index is None else old.shape[1:]
            if value.shape != shape:
                raise ValueError(f"Parameter {name!r} has shape {shape}, got {value.shape}.")
            system = eqx.tree_at(where, system, value if index is None else replaced(old, index, value))
    system = system.parameter_table.with_frames_of(before)
    system = system.parameter_table.with_size(before, given)
    if design:
        system = eqx.tree_at(lambda s: s.design, system, tuple(design))
    system.parameter_table.check(given)
    return system


def _as_array(system: AbstractSystem, name: str, value: Any) -> Array:
    """A number as an array, or the weights of a module as a vector."""
    if not isinstance(value, eqx.Module):
        try:
            return as_jax(value)
        except (ValueError, TypeError) as error:
            raise ValueError(f"Parameter {name!r}: {error}.") from None
    like = system.parameter_table.modules().get(name)
    if like is None:
        kind = type(value).__name__
        raise ValueError(f"Parameter {name!r} is a number or an array, not the weights of a module; got a {kind}.")
    try:
        return weights_of(value, like)
    except ValueError as error:
        raise ValueError(
            f"Parameter {name!r}: {error}. Only the weights of a module are numbers; for another module compile the "
            "scene anew."
        ) from None


def _of(values: Array, index: int) -> Array:
    return values[index] if is_traced(values) else jax.device_put(np.array(np.asarray(values)[index]))
