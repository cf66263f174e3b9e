"""A compiled scene in words: parts, rows, degrees of freedom, redundant rows, and what is specialised away."""

from collections.abc import Mapping, Sequence
from typing import Any

from ..system import AbstractSystem
from ..system.description import Description, count_independent, count_rows, shorten, specialised_constraints


def describe_scene(
    system: AbstractSystem,
    *,
    spatial: bool,
    bodies: Mapping[str, Sequence[str]],
    joints: Sequence[tuple[Sequence[Any], str]],
    forces: Sequence[Any],
    laws: Sequence[Any],
    gravity: str | None,
    implied: Sequence[Any],
    design: Sequence[tuple[str, str, str]] = (),
    frames: Sequence[Any] = (),
    tendons: Sequence[Any] = (),
) -> Description:
    """Describe a compiled scene; from its static structure alone, so it works on traced systems as well.

    **Arguments:** `bodies`: names by kind; `joints`: groups of constraints, with a note on each kind; `forces`, `laws`:
    groups of force elements and of non-ideal laws; `gravity`: its name, or None; `implied`: redundant rows;
    `design`: rows on the design variables; `frames`, `tendons`: groups of them.
    """
    count = sum(map(len, bodies.values()))
    grubler = system.nu - system.velocity_rows
    counts = sum(len(g.group.names) * g.group.rows for g in tendons)
    normalizations = system.coordinate_rows - system.position_rows - counts
    facts = [
        ("scene", f"{'spatial' if spatial else 'planar'}, {count} bodies"),
        ("velocities", str(system.nu)),
        ("constraint rows", count_rows(system)),
        ("degrees of freedom", f"{system.nu - system.velocity_rank} by rank, {grubler} by Grübler's count of rows"),
        ("independent", count_independent(system)),
    ]
    if normalizations:
        with_them = f"{system.nq}, with {normalizations} normalisations"
        with_them += f" and {counts} counts of turns" * (counts > 0)
        with_them += f"; rank of all {system.coordinate_rows} rows"
        facts.insert(2, ("coordinates", f"{with_them} is {system.coordinate_rank}"))
    if system.nz:
        facts.append(("internal states", f"{system.nz}: {shorten(system.state_names())}"))
    kind = lambda g: g.group.part.kind
    tables = {
        "bodies": [(kind, shorten(names), "") for kind, names in bodies.items() if names],
        "joints": [(kind(g), shorten(g.group.names), f"{g.rows} rows each" + note) for gs, note in joints for g in gs],
        "forces": [
            *([] if gravity is None else [("Gravity", gravity, "")]),
            *((kind(g), shorten(g.group.names), f"of {shorten(g.joints)}") for g in laws),
            *((kind(g), shorten(g.group.names), "") for g in forces),
        ],
        "tendons": [(kind(g), shorten(g.group.names), "") for g in tendons],
        "frames": [(kind(g), shorten(g.group.names), "") for g in frames],
        "design variables": list(design),
    }
    specialised = specialised_constraints(system)
    if system.elimination is not None:
        specialised.append(f"no dense Jacobian and no charts with Adams: {_elimination(system.elimination)}")
    if system.implicit_in_blocks:
        joined = f"{count} bodies" if system.elimination is None else f"{count} bodies with the joints"
        specialised.append(f"no dense Newton matrix with Hermite: sparse elimination of {joined}")
    if not spatial:
        specialised.append("planar: no Euler parameters, no gyroscopic moment")
    if not forces and not laws:
        specialised.append("no force elements" + ("" if gravity is None else " besides gravity"))
    redundant = [f"row {item.row} of {item.name} is implied by {', '.join(item.by)}" for item in implied]
    remarks = {"redundant rows": tuple(redundant), "specialised away": tuple(specialised)}
    return Description(tuple(facts), {title: tuple(rows) for title, rows in tables.items()}, remarks)


def _elimination(order):
    """The order of elimination, in words."""
    nodes = order.nodes
    text = f"sparse elimination of {len(order.kept)} joints"
    if order.hubs.size:
        text += f" and {order.hubs.size} bodies of many joints"
    return f"{text} in {nodes.levels} levels" + (f" and a rest of {nodes.rest.size}" if nodes.rest.size else "")
