"""Where the parameters of a compiled scene stand in it, by name, `"part.field"`, and `"part.field.field"` for what a
part is made of.
"""

import functools
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import equinox as eqx

if TYPE_CHECKING:
    from .rigid_bodies import RigidBodySystem


def parameter_places(system: "RigidBodySystem") -> dict[str, list[tuple[Any, int | None]]]:
    """Where each parameter stands: accessors of (stacked) leaves and the index in the stack."""
    places: dict[str, list[tuple[Any, int | None]]] = {}
    for k, name in enumerate(system.body_names):
        places[f"{name}.mass"] = [(lambda s: s.mass, k)]
        if system.layout.rotates[k]:
            places[f"{name}.inertia"] = [(lambda s: s.rotary, k)]
    if system.gravity is not None:
        places[f"{system.gravity_name}.acceleration"] = [(lambda s: s.gravity, None)]
    for kind in ("constraints", "velocity_constraints", "servos", "forces", "nonideal"):
        for g, group in enumerate(getattr(system, kind)):
            part = group.group.part
            for field in part.__dataclass_fields__:
                for path in _numbers(getattr(part, field)):
                    where = _accessor(kind, g, (field, *path))
                    for k, name in enumerate(group.group.names):
                        places.setdefault(f"{name}.{'.'.join(_label(part, field, *path))}", []).append((where, k))
    for g, group in enumerate(system.servos):
        for k, name in enumerate(group.group.names):
            places.setdefault(f"{name}.damping", []).append((lambda s, g=g: s.servos[g].damping, k))
            places.setdefault(f"{name}.stiffness", []).append((lambda s, g=g: s.servos[g].stiffness, k))
    return places


def _numbers(value: Any) -> Iterator[tuple[str, ...]]:
    """Where the numbers of a field stand in it, key by key: nowhere further for an array."""
    if eqx.is_inexact_array(value):
        yield ()
    elif isinstance(value, dict | eqx.Module):
        for key in value if isinstance(value, dict) else value.__dataclass_fields__:
            yield from ((key, *path) for path in _numbers(_get(value, key)))


def _get(value: Any, key: str) -> Any:
    return value[key] if isinstance(value, dict) else getattr(value, key)


def _label(value: Any, *path: str) -> Iterator[str]:
    """The keys of a path without the names of the dictionaries on it."""
    for key in path:
        value = _get(value, key)
        if not isinstance(value, dict):
            yield key


def _accessor(kind: str, group: int, path: tuple[str, ...]):
    return lambda system: functools.reduce(_get, path, getattr(system, kind)[group].group.part)
