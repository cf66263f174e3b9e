"""The numbers of a system by name, `"part.field"`."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._names import unknown
from .._types import VectorLike
from .rigid_bodies import RigidBodySystem


def parameters(system: RigidBodySystem) -> dict[str, Array]:
    """Every parameter of a compiled scene by name.

    **Returns:** a dictionary `{"crank.mass": …, "A.point_b": …, "gravity.acceleration": …}`, in SI units and the
    shapes of the parts' fields. Numbers of a user function keep their own key, `"drive.speed"`.
    """
    leaves = {}
    for name, places in _places(system).items():
        where, index = places[0]
        value = where(system)
        leaves[name] = value if index is None else value[index]
    return leaves


def with_parameters(system: RigidBodySystem, values: Mapping[str, VectorLike]) -> RigidBodySystem:
    """The same system with some parameters replaced; differentiable, and usable under `jit` and `vmap`.

    Ranks and index sets are kept: a change that makes rows independent that were implied needs a new `compile`.

    **Arguments:** `values`: new numbers by name, as in `parameters`; shapes must be those of the old ones.

    **Raises:** `ValueError` for an unknown name (with the nearest ones) or a wrong shape.
    """
    places = _places(system)
    for name, value in values.items():
        if name not in places:
            raise unknown("parameter", name, places)
        value = jnp.asarray(value, dtype=jnp.result_type(float))
        for where, index in places[name]:
            old = where(system)
            shape = old.shape if index is None else old.shape[1:]
            if value.shape != shape:
                raise ValueError(f"Parameter {name!r} has shape {shape}, got {value.shape}.")
            system = eqx.tree_at(where, system, value if index is None else old.at[index].set(value))
    return system


def _places(system: RigidBodySystem) -> dict[str, list[tuple[Any, int | None]]]:
    """Where each parameter stands: accessors of (stacked) leaves and the index in the stack."""
    places: dict[str, list[tuple[Any, int | None]]] = {}
    for k, name in enumerate(system.body_names):
        places[f"{name}.mass"] = [(lambda s: s.mass, k)]
        if system.layout.rotates[k]:
            places[f"{name}.inertia"] = [(lambda s: s.rotary, k)]
    if system.gravity is not None:
        places[f"{system.gravity_name}.acceleration"] = [(lambda s: s.gravity, None)]
    for kind in ("constraints", "velocity_constraints", "forces"):
        for g, group in enumerate(getattr(system, kind)):
            part = group.group.part
            for field in part.__dataclass_fields__:
                value = getattr(part, field)
                keys = [None] if eqx.is_inexact_array(value) else list(value) if isinstance(value, dict) else []
                for key in keys:
                    where = _accessor(kind, g, field, key)
                    for k, name in enumerate(group.group.names):
                        places.setdefault(f"{name}.{field if key is None else key}", []).append((where, k))
    return places


def _accessor(kind: str, group: int, field: str, key: str | None):
    def where(system):
        value = getattr(getattr(system, kind)[group].group.part, field)
        return value if key is None else value[key]

    return where
