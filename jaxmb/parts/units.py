"""Units of numbers, and the power of a length in them."""

import math
import re
from typing import TypeAlias

# Other units in SI units: a degree [rad], a bar [Pa], a revolution per minute [rad/s].
deg, bar, rpm = math.pi / 180, 1e5, math.pi / 30

# The unit of a number; two units, with an angle and with a length, for a number of a coordinate; None if unknown.
Unit: TypeAlias = str | tuple[str, str] | None

_POWERS = {
    **dict.fromkeys(("1", "rad", "kg", "s", "Hz", "A", "C", "T", "K", "mol", "cd"), 0),
    "m": 1,
    "N": 1,
    "Pa": -1,
    "J": 2,
    "W": 2,
    "V": 2,
    "Ω": 2,
    "Wb": 2,
    "H": 2,
    "F": -2,
}


def power_of_length(unit: str) -> float:
    """The power of the metre in a unit such as `"N m/rad"` or `"kg m²"`, written in metres, kilograms, seconds and
    amperes.

    **Raises:** `ValueError` unless it is a product of powers of SI units, perhaps over another product.
    """
    power = 0.0
    for sign, side in zip((1, -1), unit.split("/", 1), strict=False):
        for word in side.replace("²", "^2").replace("³", "^3").split(" "):
            base, _, exponent = word.partition("^")
            if base not in _POWERS or not re.fullmatch(r"(-?\d+(\.\d+)?)?", exponent):
                raise ValueError(
                    f"{word!r} in the unit {unit!r} is not a power of one of {', '.join(_POWERS)}; write a unit as in "
                    "'N m/rad' or 'kg m²', '1' for a number without unit, and leave it out if it is unknown."
                )
            power += sign * _POWERS[base] * float(exponent or 1)
    return power
