"""A compiled scene in words: parts, rows, degrees of freedom, redundant rows, and computations left out."""

from typing import Any

from ..parts.base import AbstractInertialConstraint
from ..parts.unilateral import AbstractUnilateralConstraint
from ..system.description import Description, count_independent, count_rows, counted, remarks, shorten
from ..system.design_variables import description_rows


def describe_scene(system: Any) -> Description:
    """Describe a compiled scene by its static structure; also a traced scene."""
    kinds = {}
    for g in system.bodies.groups:
        kinds.setdefault(g.group.part.kind, []).extend(g.group.names)
    is_contact = lambda g: isinstance(g.group.part, AbstractUnilateralConstraint)
    constraints, forces = system.constraints, system.forces
    plain = [g for g in constraints.position if not isinstance(g.group.part, AbstractInertialConstraint)]
    contacts = [g for g in constraints.inertial if is_contact(g)]
    joints = [
        (plain, ""),
        ([g for g in constraints.inertial if not is_contact(g)], ", each with a velocity of its own"),
        (system.free_joints, ", which have coordinates only"),
        ([g for g in constraints.velocity if not g.is_friction], ", between velocities"),
        (constraints.servos, ", a program of a Servo"),
    ]
    kind = lambda g: g.group.part.kind
    rows = lambda g: f"{counted(g.rows, 'row')} each"
    plainly = lambda groups: [(kind(g), shorten(g.group.names), "") for g in groups]
    gravity = [("Gravity", gravity.name, "") for gravity in forces.gravity_part]
    tables = {
        "bodies": [(kind, shorten(names), "") for kind, names in kinds.items() if names],
        "joints": [(kind(g), shorten(g.group.names), rows(g) + note) for gs, note in joints for g in gs],
        "contacts": [
            *((kind(g), shorten(g.group.names), "where closed 1 row each") for g in contacts),
            *(
                (kind(g), shorten(g.group.names), f"of {shorten(g.joints)}, where it sticks {rows(g)}")
                for g in constraints.frictions
            ),
        ],
        "forces": [
            *gravity,
            *((kind(g), shorten(g.group.names), f"of {shorten(g.joints)}") for g in constraints.nonideal),
            *plainly(forces.groups),
        ],
        "tendons": plainly(system.bodies.tendons),
        "frames": plainly(system.frames),
        "design variables": description_rows(system.design),
    }
    left_out = _left_out_by_elimination(system)
    if not system.spatial:
        left_out.append("Euler parameters and gyroscopic moments: the scene is planar")
    if not forces.groups and not constraints.nonideal:
        left_out.append("force elements" + " besides gravity" * bool(gravity) + ": there are none")
    redundant = [f"row {item.row} of {item.name} is implied by {', '.join(item.by)}" for item in system.implied]
    tables = {title: tuple(rows) for title, rows in tables.items()}
    return Description(tuple(_facts(system)), tables, remarks(system, left_out, redundant))


def _facts(system) -> list[tuple[str, str]]:
    count, grubler = system.layout.bodies, system.nu - system.velocity_rows
    normalizations = len(system.layout.turning)
    counts = system.bodies.invariant_rows - normalizations
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
    return facts


def _left_out_by_elimination(system) -> list[str]:
    """Remarks on dense matrices that elimination in blocks replaces."""
    order, out = system.elimination, []
    if order is not None:
        out.append(f"the dense Jacobian and charts, with Adams: {order}")
    if system.implicit_in_blocks:
        joined = f"{system.layout.bodies} bodies" + " with the joints" * (system.acceleration_rows > 0)
        out.append(f"the dense Newton matrix, with Hermite: sparse elimination of {joined}")
    return out
