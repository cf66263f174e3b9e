"""A compiled scene in words: parts, rows, degrees of freedom, redundant rows, and what is left out."""

from typing import Any

from ..parts.base import AbstractInertialConstraint
from ..parts.unilateral import AbstractUnilateralConstraint
from ..system.description import Description, count_independent, count_rows, counted, remarks, shorten
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
        ("scene", f"{'spatial' if system.spatial else 'planar'}, {counted(count, 'body', 'bodies')}"),
        ("velocities", str(system.nu)),
        ("constraint rows", count_rows(system)),
        ("degrees of freedom", f"{system.nu - system.velocity_rank} by rank, {grubler} by Grübler's count of rows"),
        ("independent", count_independent(system)),
    ]
    if normalizations:
        with_them = f"{system.nq}, with {counted(normalizations, 'normalisation')}"
        with_them += f" and {counted(counts, 'count')} of turns" * (counts > 0)
        with_them += f"; rank of all {counted(system.coordinate_rows, 'row')}"
        facts.insert(2, ("coordinates", f"{with_them} is {system.coordinate_rank}"))
    if system.nz:
        facts.append(("internal states", f"{system.nz}: {shorten(system.state_names())}"))
    kind, frictions = lambda g: g.group.part.kind, system.frictions
    rows = lambda g: f"{counted(g.rows, 'row')} each"
    plainly = lambda groups: [(kind(g), shorten(g.group.names), "") for g in groups]
    gravity = [] if system.gravity is None else [("Gravity", system.gravity_name, "")]
    tables = {
        "bodies": [(kind, shorten(names), "") for kind, names in kinds.items() if names],
        "joints": [(kind(g), shorten(g.group.names), rows(g) + note) for gs, note in joints for g in gs],
        "contacts": [
            *((kind(g), shorten(g.group.names), "where closed 1 row each") for g in system.inertial if is_contact(g)),
            *(
                (kind(g), shorten(g.group.names), f"of {shorten(g.joints)}, where it sticks {rows(g)}")
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
    left_out = system.left_out_by_elimination()
    if not system.spatial:
        left_out.append("Euler parameters and gyroscopic moments: the scene is planar")
    if not system.forces and not system.nonideal:
        left_out.append("force elements" + " besides gravity" * bool(gravity) + ": there are none")
    redundant = [f"row {item.row} of {item.name} is implied by {', '.join(item.by)}" for item in system.implied]
    tables = {title: tuple(rows) for title, rows in tables.items()}
    return Description(tuple(facts), tables, remarks(system, left_out, redundant))
