"""Where the parameters of a compiled scene stand in it, by name, `"part.field"`, and `"part.field.field"` for what a
part is made of.
"""

from typing import TYPE_CHECKING, Any

from ..parts.fields import entry, paths

if TYPE_CHECKING:
    from .rigid_bodies import RigidBodySystem


def parameter_places(system: "RigidBodySystem") -> dict[str, list[tuple[Any, int | None]]]:
    """Where each parameter stands: accessors of (stacked) leaves and the index in the stack."""
    places: dict[str, list[tuple[Any, int | None]]] = {}
    for kind in ("bodies", "constraints", "velocity_constraints", "servos", "forces", "nonideal"):
        for g, group in enumerate(getattr(system, kind)):
            part = group.group.part
            own = [(_accessor(kind, g, keys), ".".join(shown)) for keys, shown, _ in paths(part)]
            for k, name in enumerate(group.group.names):
                for where, field in own:
                    places.setdefault(f"{name}.{field}", []).append((where, k))
    for g, group in enumerate(system.servos):
        for k, name in enumerate(group.group.names):
            places.setdefault(f"{name}.damping", []).append((lambda s, g=g: s.servos[g].damping, k))
            places.setdefault(f"{name}.stiffness", []).append((lambda s, g=g: s.servos[g].stiffness, k))
    if system.gravity is not None:
        places[f"{system.gravity_name}.acceleration"] = [(lambda s: s.gravity, None)]
    return places


def _accessor(kind: str, group: int, keys: tuple[str, ...]):
    return lambda system: entry(getattr(system, kind)[group].group.part, keys)
