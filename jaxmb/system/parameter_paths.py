"""Paths from the name of a parameter of a compiled scene to the array that holds it: `"part.field"`, and
`"part.field.field"` for fields with several numbers.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..parts.fields import entry, paths
from .equation import ParameterPath


def parameter_paths(
    gravity: str | None, groups: Mapping[str, Sequence[Any]], servos: Sequence[Any]
) -> dict[str, list[ParameterPath]]:
    """Paths to every parameter of a scene.

    **Arguments:** `gravity`: its name, or None; `groups` of stacked parts, by the name of the system's field that holds
    them; `servos`: groups of servos, which also have gains.
    """
    out: dict[str, list[ParameterPath]] = {}
    for kind, of_kind in groups.items():
        for g, group in enumerate(of_kind):
            own = [(_accessor(kind, g, keys), ".".join(shown)) for keys, shown, _ in paths(group.group.part)]
            for k, name in enumerate(group.group.names):
                for where, field in own:
                    out.setdefault(f"{name}.{field}", []).append((where, k))
    for g, group in enumerate(servos):
        for k, name in enumerate(group.group.names):
            out.setdefault(f"{name}.damping", []).append((lambda s, g=g: s.servos[g].damping, k))
            out.setdefault(f"{name}.stiffness", []).append((lambda s, g=g: s.servos[g].stiffness, k))
    if gravity is not None:
        out[f"{gravity}.acceleration"] = [(lambda s: s.gravity, None)]
    return out


def positive_parameters(groups: Mapping[str, Sequence[Any]]) -> Iterator[str]:
    """Names of the parameters that parts declare to be positive, or positive definite."""
    for of_kind in groups.values():
        for group in of_kind:
            for _, shown, declared in paths(group.group.part):
                if declared.sign in ("positive", "positive definite"):
                    yield from (f"{name}.{'.'.join(shown)}" for name in group.group.names)


def _accessor(kind: str, group: int, keys: tuple[str, ...]):
    return lambda system: entry(getattr(system, kind)[group].group.part, keys)
