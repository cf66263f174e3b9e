"""Tyre property files (`.tir`) of the Magic Formula, versions 5.2 and 6.1: their keys, and a reader."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from ..linalg.arrays import is_traced

Version = Literal["5.2", "6.1"]
_FORMATS: dict[str, Version] = {"6": "5.2", "52": "5.2", "61": "6.1", "MF_05": "5.2", "MF_61": "6.1"}
_READ = "5.2 (FITTYP 6 or 52, or PROPERTY_FILE_FORMAT 'MF_05') and 6.1 (FITTYP 61, or 'MF_61')"

# Keys that a file must have, of both versions and of each.
_REQUIRED = """
UNLOADED_RADIUS FNOMIN LONGVL VERTICAL_STIFFNESS
PCX1 PDX1 PDX2 PDX3 PEX1 PEX2 PEX3 PEX4 PKX1 PKX2 PKX3 PHX1 PHX2 PVX1 PVX2 RBX1 RBX2 RCX1 REX1 REX2 RHX1
PCY1 PDY1 PDY2 PDY3 PEY1 PEY2 PEY3 PEY4 PKY1 PKY2 PKY3 PHY1 PHY2 PVY1 PVY2 PVY3 PVY4
RBY1 RBY2 RBY3 RCY1 REY1 REY2 RHY1 RHY2 RVY1 RVY2 RVY3 RVY4 RVY5 RVY6
QBZ1 QBZ2 QBZ3 QBZ4 QBZ5 QBZ9 QBZ10 QCZ1 QDZ1 QDZ2 QDZ3 QDZ4 QDZ6 QDZ7 QDZ8 QDZ9 QEZ1 QEZ2 QEZ3 QEZ4 QEZ5
QHZ1 QHZ2 QHZ3 QHZ4 SSZ1 SSZ2 SSZ3 SSZ4 QSX1 QSX2 QSX3 QSY1 QSY2
"""
_REQUIRED_BY = {
    "5.2": "PHY3 PTX1 PTX2 PTX3 PTY1 PTY2",
    "6.1": "NOMPRES PKY4 PKY5 PKY6 PKY7 LONGITUDINAL_STIFFNESS LATERAL_STIFFNESS",
}
# Keys that may be missing, which are then one or zero.
_ONES = """
LFZO LCX LMUX LEX LKX LHX LVX LCY LMUY LEY LKY LHY LVY LTR LRES LXAL LYKA LVYKA LS LMX LVMX LMY
"""
_ONES_BY = {"5.2": "LGAX LGAY LGAZ LSGKP LSGAL", "6.1": "LKYC LKZC Q_RE0 QSY7"}
_ZEROS = "VERTICAL_DAMPING BREFF DREFF FREFF QSY3 QSY4 FZMIN"
_ZEROS_BY = {
    "5.2": "",
    "6.1": """
LMUV Q_V1 Q_V2 Q_FZ2 PFZ1 PPX1 PPX2 PPX3 PPX4 PEY5 PPY1 PPY2 PPY3 PPY4 PPY5 PPZ1 PPZ2 RBX3 RBY4 QDZ10 QDZ11 PPMX1
QSX4 QSX5 QSX6 QSX7 QSX8 QSX9 QSX10 QSX11 QSX12 QSX13 QSX14 QSY5 QSY6 QSY8 PCFX1 PCFX2 PCFX3 PCFY1 PCFY2 PCFY3
""",
}
_LIMITS = {
    "FZMAX": 1e12,
    "KPUMIN": -1e12,
    "KPUMAX": 1e12,
    "ALPMIN": -1.57,
    "ALPMAX": 1.57,
    "CAMMIN": -1.57,
    "CAMMAX": 1.57,
    "PRESMIN": 0.0,
    "PRESMAX": 1e12,
}
# In version 6.1 these have no value when they are missing: Q_FZ1 follows from the stiffness, INFLPRES is NOMPRES.
_OPTIONAL = {"5.2": "", "6.1": "Q_FZ1 INFLPRES"}


def _of(version: str, common: str, by_version: Mapping[str, str]) -> list[str]:
    return f"{common} {by_version[version]}".split()


def _defaults(version: str) -> dict[str, float]:
    ones, zeros = _of(version, _ONES, _ONES_BY), _of(version, _ZEROS, _ZEROS_BY)
    return dict.fromkeys(ones, 1.0) | dict.fromkeys(zeros, 0.0) | _LIMITS


# The terms of the other version vanish.
_NEUTRAL = {"PKY4": 2.0, "PKY5": 0.0, "PKY6": 0.0, "PKY7": 0.0, "PHY3": 0.0, "NOMPRES": 1.0, "Q_FZ1": None}
DEFAULTS: dict[str, Any] = _NEUTRAL | _defaults("5.2") | _defaults("6.1")
# Keys of effects that are not modelled, which zero leaves out: of the load, and all.
_OF_LOAD = {
    **dict.fromkeys(("Q_FCX", "Q_FCY"), "the load that depends on the horizontal forces"),
    **dict.fromkeys(("Q_FZ3", "Q_CAM", "Q_FCG"), "the load that depends on the inclination"),
}
_EFFECTS = _OF_LOAD | {
    "QTZ1": "the gyroscopic couple of the belt",
    **dict.fromkeys(("MC_CONTOUR_A", "MC_CONTOUR_B"), "the round section of a motorcycle tyre"),
}
# Of rigid ring models, obstacles, turn slip and the rim, without effect on steady forces and relaxation.
_OTHERS = """
TYPE MFVERS USE_MODE VXLOW WIDTH RIM_RADIUS RIM_WIDTH ASPECT_RATIO BOTTOM_OFFST BOTTOM_STIFF MASS IXX IYY BELT_MASS
BELT_IXX BELT_IYY GRAVITY MBELT LGYR LMP YAW_STIFFNESS FREQ_LONG FREQ_LAT FREQ_YAW FREQ_WINDUP DAMP_LONG DAMP_LAT
DAMP_YAW DAMP_WINDUP DAMP_RESIDUAL DAMP_VLOW Q_BVX Q_BVT Q_RA1 Q_RA2 Q_RB1 Q_RB2 ELLIPS_SHIFT ELLIPS_LENGTH
ELLIPS_HEIGHT ELLIPS_ORDER ELLIPS_MAX_STEP ELLIPS_NWIDTH ELLIPS_NLENGTH ENV_C1 ENV_C2 ENV_P1 ENV_P2 ENV_P3 Q_A1 Q_A2
PDXP1 PDXP2 PDXP3 PKYP1 PDYP1 PDYP2 PDYP3 PDYP4 PHYP1 PHYP2 PHYP3 PHYP4 PECP1 PECP2 QDTP1 QCRP1 QCRP2 QBRP1 QDRP1 QDRP2
"""
_WORDS = ("FITTYP", "PROPERTY_FILE_FORMAT", "TYRESIDE", "LENGTH", "FORCE", "ANGLE", "MASS", "TIME")
# Sections without coefficients of steady forces; they may hold tables.
_SKIPPED = ("MDI_HEADER", "SHAPE", "INERTIA")

# Units by their names, in SI units, and the powers of length, force and time in the numbers that have a unit.
_UNITS = {
    "LENGTH": {"meter": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "inch": 0.0254, "foot": 0.3048},
    "FORCE": {"newton": 1.0, "n": 1.0, "kilonewton": 1e3, "knewton": 1e3, "kn": 1e3, "pound_force": 4.4482216152605},
    "TIME": {"second": 1.0, "s": 1.0, "sec": 1.0, "millisecond": 1e-3, "ms": 1e-3},
    "ANGLE": {"radians": 1.0, "radian": 1.0, "rad": 1.0},
    # No coefficient has a mass.
    "MASS": {"kg": 1.0, "kilogram": 1.0, "gram": 1e-3, "pound_mass": 0.45359237, "slug": 14.593902937206},
}
_DIMENSIONS = {
    "UNLOADED_RADIUS": (1, 0, 0),
    "LONGVL": (1, 0, -1),
    "VERTICAL_DAMPING": (-1, 1, 1),
    **dict.fromkeys(("FNOMIN", "FZMIN", "FZMAX"), (0, 1, 0)),
    **dict.fromkeys(("VERTICAL_STIFFNESS", "LONGITUDINAL_STIFFNESS", "LATERAL_STIFFNESS"), (-1, 1, 0)),
    **dict.fromkeys(("NOMPRES", "INFLPRES", "PRESMIN", "PRESMAX"), (-2, 1, 0)),
}


class TyreData(NamedTuple):
    """The content of a tyre property file: the version of the Magic Formula, the side of the vehicle for which it was
    measured, None if the file does not say, and the coefficients by name, in SI units.
    """

    version: Version
    side: str | None
    coefficients: dict[str, Any]


def read(label: str, tir: Any, *, for_load: bool = True) -> TyreData:
    """The data of a file, or of a mapping of the same keys. All scaling factors of the version are among them.

    **Arguments:** `for_load`: whether the load depends on them.

    **Raises:** `ValueError` for other formats, unknown units, and missing or unknown keys.
    """
    if isinstance(tir, Mapping):
        entries, shown = {str(key).upper(): value for key, value in tir.items()}, f"{label}: tir"
    else:
        path = Path(tir)
        shown = f"{label}: {path.name}"
        entries = _entries(path.read_text(encoding="utf-8", errors="replace"), shown)
    version = _version(entries, shown)
    side = str(entries.get("TYRESIDE", "")).lower() or None
    if side not in ("left", "right", None):
        raise ValueError(f"{shown}: TYRESIDE must be 'LEFT' or 'RIGHT', got {entries['TYRESIDE']!r}.")
    units = [_unit(entries, kind, shown) for kind in ("LENGTH", "FORCE", "TIME")]
    for kind in ("ANGLE", "MASS"):
        _unit(entries, kind, shown)
    others = {*_OTHERS.split(), *_WORDS}
    numbers = {key: value for key, value in entries.items() if key not in others}
    _check(numbers, version, shown, _EFFECTS if for_load else _EFFECTS.keys() - _OF_LOAD.keys())
    scale = {key: _product(units, powers) for key, powers in _DIMENSIONS.items()}
    kept = {key: scale.get(key, 1.0) * value for key, value in numbers.items() if key not in _EFFECTS}
    factors = {key: 1.0 for key in _of(version, _ONES, _ONES_BY) if key.startswith("L")}
    return TyreData(version, side, factors | kept)


def _entries(text: str, shown: str) -> dict[str, Any]:
    """The values of a file by key, numbers or words."""
    entries: dict[str, Any] = {}
    section = ""
    for k, line in enumerate(text.splitlines(), 1):
        content = line.split("$")[0].split("!")[0].strip()
        if content.startswith("["):
            section = content.strip("[] ").upper()
        elif content and section not in _SKIPPED:
            key, equals, value = (word.strip() for word in content.partition("="))
            key = key.upper()
            if not equals or not key:
                raise ValueError(f"{shown}, line {k}: expected KEY = value, got {content!r}.")
            if key in entries:
                raise ValueError(f"{shown}, line {k}: {key} stands there twice; remove one of them.")
            entries[key] = _value(value)
    return entries


def _value(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text.strip("'\" ")


def _version(entries: Mapping[str, Any], shown: str) -> Version:
    number, word = entries.get("FITTYP"), entries.get("PROPERTY_FILE_FORMAT")
    given = f"{number:g}" if isinstance(number, float | int) else number if number is not None else str(word).upper()
    if given not in _FORMATS:
        got = f"FITTYP = {given}" if number is not None else f"PROPERTY_FILE_FORMAT = {word!r}"
        raise ValueError(f"{shown}: versions of the Magic Formula that are read are {_READ}; got {got}.")
    return _FORMATS[given]


def _unit(entries: Mapping[str, Any], kind: str, shown: str) -> float:
    # In a mapping MASS may be that of the tyre.
    word = entries.get(kind)
    given = word.lower() if isinstance(word, str) else next(iter(_UNITS[kind]))
    if given not in _UNITS[kind]:
        raise ValueError(
            f"{shown}: {kind} = {entries[kind]!r} is not a unit that is read, which are {', '.join(_UNITS[kind])}; "
            "convert the file."
        )
    return _UNITS[kind][given]


def _product(units: list[float], powers: tuple[int, ...]) -> float:
    length, force, time = (unit**power for unit, power in zip(units, powers, strict=True))
    return length * force * time


def _check(numbers: Mapping[str, Any], version: str, shown: str, zero: Collection[str]) -> None:
    required = _of(version, _REQUIRED, _REQUIRED_BY)
    missing = [key for key in required if key not in numbers]
    if missing:
        raise ValueError(f"{shown}: version {version} of the Magic Formula needs {', '.join(missing)} as well.")
    for key, value in numbers.items():
        if isinstance(value, str):
            raise ValueError(f"{shown}: {key} must be a number, got {value!r}.")
        if key in zero and (is_traced(value) or value != 0):
            cure = f"set {key} = 0 to leave it out" + (", or give normal" if key in _OF_LOAD else "")
            raise ValueError(f"{shown}: {key}: {_EFFECTS[key]} is not modelled; {cure}.")
    known = {*_EFFECTS, *required, *_defaults(version), *_OPTIONAL[version].split()}
    unknown = [key for key in numbers if key not in known]
    if unknown:
        raise ValueError(f"{shown}: unknown for version {version}: {', '.join(unknown)}; remove them.")
