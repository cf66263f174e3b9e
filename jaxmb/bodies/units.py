"""Words and units of quantities by name, for labels and tables."""

import itertools
from typing import Any, NamedTuple

import numpy as np

from ..parts.fields import declarations

# Of quantities by the last part of their names; a number behind, as of the angles of a gimbal, does not count.
_WORDS = {
    "position": ("position", "m"),
    "displacement": ("displacement", "m"),
    "length": ("length", "m"),
    "angle": ("angle", "rad"),
    "rotation": ("rotation", "rad"),
    "velocity": ("velocity", "m/s"),
    "angular_velocity": ("angular velocity", "rad/s"),
    "acceleration": ("acceleration", "m/s²"),
    "angular_acceleration": ("angular acceleration", "rad/s²"),
    "specific_force": ("specific force", "m/s²"),
    "force": ("force", "N"),
    "tension": ("tension", "N"),
    "moment": ("moment", "N m"),
    "orientation": ("Euler parameters", "1"),
    "strain": ("strain", "1"),
    "curvature": ("curvature", "1/m"),
    "section_force": ("section force", "N"),
    "section_moment": ("section moment", "N m"),
}
_RATES = {
    "m": (("velocity", "m/s"), ("acceleration", "m/s²")),
    "rad": (("angular velocity", "rad/s"), ("angular acceleration", "rad/s²")),
    "": (("rate of the coordinate", ""), ("acceleration of the coordinate", "")),
}
_WORD_OF_UNIT = {"N": "force", "N m": "torque", "Pa": "pressure"}
_ORDERS = ("", "_rate", "_acceleration")


class Named(NamedTuple):
    """A quantity: the part or coordinate, the quantity within it ("" for a coordinate), a word for it, and its unit."""

    part: str
    field: str
    word: str
    unit: str


def named(system: Any, quantity: str) -> Named:
    """The part, the word and the unit of a quantity of a motion."""
    coordinates = system.coordinate_names()
    order = max(k for k, end in enumerate(_ORDERS) if quantity.endswith(end))
    if quantity in coordinates or quantity.split(".")[-1] in _WORDS:
        order = 0
    part, _, field = quantity.removesuffix(_ORDERS[order]).partition(".")
    kind = field.rstrip("_123ab")
    if field and not system.body_names:
        # Generalized forces of coordinates with several units.
        word, unit = field, ""
    elif field == "gap":
        word, unit = "gap", "rad" if unit_along(system, part) == "N m" else "m"
    elif field == "drive_force":
        unit = unit_along(system, part)
        word = f"{_WORD_OF_UNIT.get(unit, 'force')} of the drive"
    elif not field:
        word, unit = "coordinate", ""
    else:
        word, unit = _WORDS.get(kind, (field.replace("_", " "), ""))
        # Of an internal state of this name, such as the force of a motor.
        unit = declared_unit(system, part, field) or unit
        word = _WORD_OF_UNIT.get(unit, word) if word == "force" else word
    if order:
        word, unit = _RATES[unit][order - 1] if unit in _RATES else (f"{word}, rate", f"{unit}/s")
    return Named(part, field, word, unit)


def panel_words(named_quantities: Any) -> tuple[str, str]:
    """The label and the unit of a panel of quantities."""
    words, units = (dict.fromkeys(x) for x in zip(*((own.word, own.unit) for own in named_quantities), strict=True))
    return ", ".join(words), next(iter(units))


def effort(system: Any, name: str) -> tuple[str, str]:
    """The word and the unit of an actuator: a coordinate, a part, or a parameter that forces are proportional to."""
    part, _, field = name.partition(".")
    is_parameter = field and name not in system.quantities() and part not in system.body_names
    unit = declared_unit(system, part, field) if is_parameter else unit_along(system, name)
    return _WORD_OF_UNIT.get(unit, field.replace("_", " ") if is_parameter else "force"), unit


def parameter_unit(system: Any, name: str) -> str:
    """The unit of a parameter, of a component of it, or of a design variable; "" if it is unknown."""
    base = name.split("[")[0]
    variables = {own: variable.unit for group in system.design for own, variable in group.variables}
    return variables[base] if base in variables else declared_unit(system, *base.partition(".")[::2])


def declared_unit(system: Any, part: str, field: str) -> str:
    """The unit of a number or an internal state of a part, "" if it is unknown."""
    for own in _parts(system, part):
        # Numbers of a user function have the units that the user gives.
        if field in (given := dict(getattr(own, "units", ()))):
            return given[field]
        unit = getattr(declarations(type(own)).get(field.split(".")[0]), "unit", None)
        if isinstance(unit, tuple):
            return _of_coordinate(own, field, unit)
        if unit is not None:
            return unit
    return ""


def unit_along(system: Any, name: str) -> str:
    """The unit of the force along a coordinate, or of the drive of a part: N, of an angle N m; "" if it is unknown."""
    body, _, field = name.partition(".")
    if body in system.body_names:
        return "N" if field in ("x", "y", "z", "position", "velocity") else "N m"
    if field:
        return {"m": "N", "rad": "N m"}.get(named(system, name).unit, "")
    for own in _parts(system, name):
        driven = getattr(own, "quantity", None)
        return _of_coordinate(own, "", ("N m", "N")) if driven is None else "N m" if driven == "angle" else "N"
    return ""


def _of_coordinate(part, field, units) -> str:
    of_length = part.is_of_length(field)
    # Components of several kinds have no common unit.
    return "" if of_length is None or np.ndim(of_length) else units[int(of_length)]


def _parts(system, name):
    """The parts of a name; several where a joint rubs."""
    if not system.body_names:
        return
    yield from (weight for weight in system.forces.gravity_part if weight.name == name)
    for group in itertools.chain(system.constraints.groups, system.forces.groups, system.bodies.groups):
        if name in group.group.names:
            yield group.group.part
