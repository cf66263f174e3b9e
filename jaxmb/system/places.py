"""Where the parameters of a compiled scene stand in it, by name, `"part.field"`."""

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
                value = getattr(part, field)
                keys = [None] if eqx.is_inexact_array(value) else list(value) if isinstance(value, dict) else []
                for key in keys:
                    where = _accessor(kind, g, field, key)
                    for k, name in enumerate(group.group.names):
                        places.setdefault(f"{name}.{field if key is None else key}", []).append((where, k))
    for g, group in enumerate(system.servos):
        for k, name in enumerate(group.group.names):
            places.setdefault(f"{name}.damping", []).append((lambda s, g=g: s.servos[g].damping, k))
            places.setdefault(f"{name}.stiffness", []).append((lambda s, g=g: s.servos[g].stiffness, k))
    return places


def _accessor(kind: str, group: int, field: str, key: str | None):
    def where(system):
        value = getattr(getattr(system, kind)[group].group.part, field)
        return value if key is None else value[key]

    return where
