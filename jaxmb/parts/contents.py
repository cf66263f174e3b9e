"""The contents of a part: its parameters, its internal states, and other parts that it holds."""

import functools
from collections.abc import Iterator
from typing import Any

import equinox as eqx

from .._compat import with_values
from .fields import Declaration, declarations, field_names, values_of


def anonymous(part: Any) -> Any:
    """The part without the names that distinguish stacked parts, and without the initial guess of bodies."""
    declared, values = declarations(type(part)), values_of(part)
    out = {}
    for field in field_names(type(part)):
        value, kind = values[field], declared[field].kind if field in declared else None
        if kind in ("identity", "body"):
            value = ""
        elif kind in ("identities", "bodies"):
            value = ("",) * len(value)
        elif kind == "state":
            value = None
        elif kind in ("part", "law"):
            value = None if value is None else anonymous(value)
        elif kind == "parts":
            value = {key: anonymous(own) for key, own in value.items()}
        out[field] = value
    return with_values(part, out)


def inner_parts(part: Any, prefix: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The other parts that a part holds, and those that these hold, each after the path of keys that leads to it."""
    for name in _fields_of_parts(type(part)):
        value: Any = getattr(part, name)
        held = value if isinstance(value, dict) else {} if value is None else {None: value}
        for key, inner in held.items():
            keys = (*prefix, name) if key is None else (*prefix, name, key)
            yield keys, inner
            yield from inner_parts(inner, keys)


@functools.cache
def _fields_of_parts(cls: type) -> tuple[str, ...]:
    return tuple(name for name, own in declarations(cls).items() if own.kind in ("part", "parts"))


def internal_states(part: Any) -> dict[str, tuple[str, ...]]:
    """The paths of keys to the internal states of a part, by their names."""
    found = {}
    for name, declared in declarations(type(part)).items():
        if declared.kind == "internal" and getattr(part, name) is not None:
            found[name] = (name,)
        elif declared.kind == "internals":
            found |= {key: (name, key) for key in getattr(part, name)}
    return found


def paths(part: Any) -> Iterator[tuple[tuple[str, ...], tuple[str, ...], Declaration]]:
    """The parameters of a part itself, not of parts that it holds.

    For each: the path of keys to it; the path in its name, which leaves out the keys of dictionaries' fields; and its
    declaration, an empty one for an entry of a dictionary.
    """
    declared = declarations(type(part))
    for field in field_names(type(part)):
        own = declared.get(field, _ANY_NUMBER)
        if own.kind not in ("state", "internal", "internals", "part", "parts"):
            yield from _paths(getattr(part, field), (field,), (field,), own)


_ANY_NUMBER = Declaration("number")


def _paths(value: Any, keys: tuple[str, ...], shown: tuple[str, ...], declared: Declaration):
    if eqx.is_inexact_array(value):
        yield keys, shown, declared
    elif isinstance(value, dict):
        for key, entry in value.items():
            yield from _paths(entry, (*keys, key), (*shown[:-1], key), _ANY_NUMBER)
    elif isinstance(value, eqx.Module):
        for inner, name, own in paths(value):
            yield (*keys, *inner), (*shown, *name), own


def entry(value: Any, keys: tuple[str, ...]) -> Any:
    """The value at a path of attribute names and dictionary keys."""
    for key in keys:
        value = value[key] if isinstance(value, dict) else getattr(value, key)
    return value
