"""Paths from the name of a parameter of a compiled scene to the array that holds it: `"part.field"`, and
`"part.field.field"` for fields with several numbers.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from ..parts.contents import entry, paths
from ..parts.fields import Declaration
from .equation import ParameterPath


class StackedNumber(NamedTuple):
    """A parameter in a group of stacked parts: `keys` lead to it in group number `group` of the system's field `kind`,
    `member` is the number of its part.
    """

    name: str
    kind: str
    group: int
    keys: tuple[str, ...]
    member: int
    declared: Declaration


def stacked_numbers(groups: Mapping[str, Sequence[Any]]) -> Iterator[StackedNumber]:
    """Every parameter of some groups, which are given by the name of the system's field that holds them."""
    for kind, of_kind in groups.items():
        for g, group in enumerate(of_kind):
            # Numbers of another part that these parts hold keep the name of that part.
            stacked = group.group
            sources = [((), stacked.part, stacked.names)]
            sources += [(keys, entry(stacked.part, keys), names) for keys, names in stacked.inner]
            for prefix, part, names in sources:
                own = [((*prefix, *keys), ".".join(shown), declared) for keys, shown, declared in paths(part)]
                for k, name in enumerate(names):
                    for keys, field, declared in own:
                        yield StackedNumber(f"{name}.{field}", kind, g, keys, k, declared)


def parameter_paths(
    gravity: str | None, groups: Mapping[str, Sequence[Any]], servos: Sequence[Any]
) -> dict[str, list[ParameterPath]]:
    """Paths to every parameter of a scene.

    **Arguments:** `gravity`: its name, or None; `groups` of stacked parts, by the name of the system's field that holds
    them; `servos`: groups of servos, which also have gains.
    """
    out: dict[str, list[ParameterPath]] = {}
    for number in stacked_numbers(groups):
        where = _accessor(number.kind, number.group, number.keys)
        out.setdefault(number.name, []).append((where, number.member))
    for g, group in enumerate(servos):
        for k, name in enumerate(group.group.names):
            out.setdefault(f"{name}.damping", []).append((lambda s, g=g: s.servos[g].damping, k))
            out.setdefault(f"{name}.stiffness", []).append((lambda s, g=g: s.servos[g].stiffness, k))
    if gravity is not None:
        out[f"{gravity}.acceleration"] = [(lambda s: s.gravity, None)]
    return out


def positive_parameters(groups: Mapping[str, Sequence[Any]]) -> Iterator[str]:
    """Names of the parameters that parts declare to be positive, or positive definite."""
    for number in stacked_numbers(groups):
        if number.declared.sign in ("positive", "positive definite"):
            yield number.name


def _accessor(kind: str, group: int, keys: tuple[str, ...]):
    return lambda system: entry(getattr(system, kind)[group].group.part, keys)
