"""Paths from the name of a parameter of a compiled scene to the arrays that hold it: `"part.field"`, and
`"part.field.field"` for fields that are made of several numbers.
"""

import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx

from .equation import ParameterPath


def parameter_paths(
    bodies: Sequence[str], rotates: Sequence[bool], gravity: str | None, groups: Mapping[str, Sequence[Any]]
) -> dict[str, list[ParameterPath]]:
    """Paths to every parameter of a scene.

    **Arguments:** names of the bodies, and whether each has an attitude; name of gravity, if there is any; `groups` of
    stacked parts, by the name of the system's field that holds them.
    """
    paths: dict[str, list[ParameterPath]] = {}
    for k, name in enumerate(bodies):
        paths[f"{name}.mass"] = [(lambda s: s.mass, k)]
        if rotates[k]:
            paths[f"{name}.inertia"] = [(lambda s: s.rotary, k)]
    if gravity is not None:
        paths[f"{gravity}.acceleration"] = [(lambda s: s.gravity, None)]
    for kind, of_kind in groups.items():
        for g, group in enumerate(of_kind):
            part = group.group.part
            for field in part.__dataclass_fields__:
                for path in _numbers(getattr(part, field)):
                    where = _accessor(kind, g, (field, *path))
                    for k, name in enumerate(group.group.names):
                        paths.setdefault(f"{name}.{'.'.join(_label(part, field, *path))}", []).append((where, k))
    for g, group in enumerate(groups["servos"]):
        for k, name in enumerate(group.group.names):
            paths.setdefault(f"{name}.damping", []).append((lambda s, g=g: s.servos[g].damping, k))
            paths.setdefault(f"{name}.stiffness", []).append((lambda s, g=g: s.servos[g].stiffness, k))
    return paths


def _numbers(value: Any) -> Iterator[tuple[str, ...]]:
    """The keys that lead from a field to each of its arrays; none for a field that is an array itself."""
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
