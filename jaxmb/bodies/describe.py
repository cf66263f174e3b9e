"""A compiled scene in words: parts, rows, degrees of freedom, redundant rows, and what is specialised away."""

from typing import Any

from ..parts.base import AbstractInertialConstraint
from ..parts.unilateral import AbstractUnilateralConstraint
from ..system.description import Description, count_independent, count_rows, shorten, specialised_constraints
from ..system.design_variables import description_rows


def describe_scene(system: Any) -> Description:
    """Describe a compiled scene; from its static structure alone, so it works on traced systems as well."""
    count, kinds = system.layout.bodies, {}
    for g in system.bodies:
        kinds.setdefault(g.group.part.kind, []).extend(g.group.names)
    is_contact = lambda g: isinstance(g.group.part, AbstractUnilateralConstraint)
    plain = [g for g in system.constraints if not isinstance(g.group.part, AbstractInertialConstraint)]
    joints = [
        (plain, ""),
        ([g for g in system.inertial if not is_contact(g)], ", each with a velocity of its own"),
        (system.free_joints, ", which have coordinates only"),
        ([g for g in system.velocity_constraints if not g.joints], ", between velocities"),
        (system.servos, ", a program of a Servo"),
    ]
    grubler = system.nu - system.velocity_rows
    counts = sum(len(g.group.names) * g.group.rows for g in system.tendons)
    normalizations = system.coordinate_rows - system.position_rows - counts
    facts = [
        ("scene", f"{'spatial' if system.spatial else 'planar'}, {count} bodies"),
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
    kind, frictions = lambda g: g.group.part.kind, system.frictions
    plainly = lambda groups: [(kind(g), shorten(g.group.names), "") for g in groups]
    gravity = [] if system.gravity is None else [("Gravity", system.gravity_name, "")]
    tables = {
        "bodies": [(kind, shorten(names), "") for kind, names in kinds.items() if names],
        "joints": [(kind(g), shorten(g.group.names), f"{g.rows} rows each" + note) for gs, note in joints for g in gs],
        "contacts": [
            *((kind(g), shorten(g.group.names), "where closed 1 row each") for g in system.inertial if is_contact(g)),
            *(
                (
                    kind(g),
                    shorten(g.group.names),
                    f"of {shorten(g.joints)}, where it sticks {g.rows} row{'s' * (g.rows > 1)} each",
                )
                for g in frictions
            ),
        ],
        "forces": [
            *gravity,
            *((kind(g), shorten(g.group.names), f"of {shorten(g.joints)}") for g in system.nonideal),
            *plainly(system.forces),
        ],
        "tendons": plainly(system.tendons),
        "frames": plainly(system.frames),
        "design variables": description_rows(system.design),
    }
    specialised = specialised_constraints(system)
    specialised += system.eliminations()
    if not system.spatial:
        specialised.append("planar: no Euler parameters, no gyroscopic moment")
    if not system.forces and not system.nonideal:
        specialised.append("no force elements" + " besides gravity" * bool(gravity))
    redundant = [f"row {item.row} of {item.name} is implied by {', '.join(item.by)}" for item in system.implied]
    remarks = {"redundant rows": tuple(redundant), "specialised away": tuple(specialised)}
    return Description(tuple(facts), {title: tuple(rows) for title, rows in tables.items()}, remarks)
