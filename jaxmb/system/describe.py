"""What a system is made of, in words: its parts, rows, degrees of freedom, redundancy, and what was left out."""

import dataclasses
import html
from collections import Counter
from collections.abc import Iterable

from .equation import AbstractSystem
from .rigid_bodies import RigidBodySystem


@dataclasses.dataclass(frozen=True)
class Description:
    """Tables of a system; prints as text, shows as HTML in a notebook.

    **Fields:** `facts`: (name, value) pairs; `tables`: rows of (type, names or count, remark) by title, of bodies,
    joints, forces, or constraints; `remarks`: sentences by title, on redundant rows and on what this system does not
    trace.
    """

    facts: tuple[tuple[str, str], ...]
    tables: dict[str, tuple[tuple[str, str, str], ...]]
    remarks: dict[str, tuple[str, ...]]

    def __str__(self) -> str:
        width = max(len(name) for name, _ in self.facts)
        lines = [f"{name:<{width}}  {value}" for name, value in self.facts]
        for title, rows in self.tables.items():
            if rows:
                lines += ["", title]
                widths = [max(len(row[k]) for row in rows) for k in range(2)]
                lines += [f"  {a:<{widths[0]}}  {b:<{widths[1]}}  {c}".rstrip() for a, b, c in rows]
        for title, sentences in self.remarks.items():
            if sentences:
                lines += ["", title, *(f"  {sentence}" for sentence in sentences)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        cell = lambda text: f"<td style='text-align:left'>{html.escape(text)}</td>"
        table = lambda rows: "<table>" + "".join(f"<tr>{''.join(map(cell, row))}</tr>" for row in rows) + "</table>"
        parts = [table(self.facts)]
        for title, rows in self.tables.items():
            if rows:
                parts.append(f"<b>{title}</b>{table(rows)}")
        for title, sentences in self.remarks.items():
            if sentences:
                parts.append(f"<b>{title}</b><ul>{''.join(f'<li>{html.escape(s)}</li>' for s in sentences)}</ul>")
        return "".join(parts)


def count_rows(system: AbstractSystem) -> str:
    """The number of constraint rows, of independent ones among them, and of those that do not bind positions."""
    text = f"{system.acceleration_rows}, of which {system.acceleration_rank} independent"
    kinds = {
        "nonholonomic": system.velocity_rows - system.position_rows,
        "between accelerations only": system.acceleration_rows - system.velocity_rows,
    }
    listed = ", ".join(f"{number} {kind}" for kind, number in kinds.items() if number)
    return f"{text} ({listed})" if listed else text


def count_independent(system: AbstractSystem) -> str:
    """The numbers of coordinates and velocities that the constraints leave free."""
    return f"{system.nq - system.coordinate_rank} coordinates, {system.nu - system.velocity_rank} velocities"


def constraints_left_out(system: AbstractSystem) -> list[str]:
    """Sentences on what the constraints of a system, or their absence, do away with."""
    if not system.acceleration_rows:
        return ["no constraints: no elimination, no Newton iteration, no charts"]
    out = []
    if system.position_rows == system.acceleration_rows:
        out.append("holonomic only: no rows between velocities, no chart of velocities besides that of coordinates")
    if not system.position_rows:
        out.append("no constraints between positions: no Newton iteration")
    if system.acceleration_rank == system.acceleration_rows:
        out.append("no redundancy: no row is dropped")
    if system.homogeneous:
        out.append("scleronomic: no derivative with respect to time")
    return out


def shorten(names: Iterable[str]) -> str:
    """Names in a line; of many the first and the last."""
    names = list(names)
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:4])}, … {names[-1]} ({len(names)})"


def describe(system: RigidBodySystem) -> Description:
    """Describe a compiled scene; from its static structure alone, so it works on traced systems as well."""
    space = "spatial" if system.spatial else "planar"
    grubler = system.nu - system.velocity_rows
    normalizations = system.coordinate_rows - system.position_rows
    facts = [
        ("scene", f"{space}, {len(system.body_names)} bodies"),
        ("velocities", str(system.nu)),
        ("constraint rows", count_rows(system)),
        ("degrees of freedom", f"{system.nu - system.velocity_rank} by rank, {grubler} by Grübler's count of rows"),
        ("independent", count_independent(system)),
    ]
    if normalizations:
        with_them = f"{system.nq}, with {normalizations} normalisations; rank of all {system.coordinate_rows} rows"
        facts.insert(2, ("coordinates", f"{with_them} is {system.coordinate_rank}"))
    bodies = [("Body" if r else "PointMass", name, "") for name, r in _shorten_bodies(system)]
    joints = [
        (type(g.group.part).__name__, shorten(g.group.names), f"{g.rows} rows each" + note)
        for groups, note in (
            (system.constraints, ""),
            (system.velocity_constraints, ", between velocities"),
            (system.servos, ", a program of a Servo"),
        )
        for g in groups
    ]
    forces = [(type(g.group.part).__name__, shorten(g.group.names), f"of {shorten(g.joints)}") for g in system.nonideal]
    forces += [(type(g.group.part).__name__, shorten(g.group.names), "") for g in system.forces]
    if system.gravity is not None:
        forces.insert(0, ("Gravity", system.gravity_name, ""))
    implied = [f"row {item.row} of {item.name} is implied by {', '.join(item.by)}" for item in system.implied]
    return Description(
        tuple(facts),
        {"bodies": tuple(bodies), "joints": tuple(joints), "forces": tuple(forces)},
        {"redundant rows": tuple(implied), "left out": tuple(_left_out(system))},
    )


def _left_out(system: RigidBodySystem) -> list[str]:
    out = constraints_left_out(system)
    if system.elimination is not None:
        out.append("joint chain: no dense Jacobian and no charts with Adams; block-tridiagonal elimination")
    if not system.spatial:
        out.append("planar: no Euler parameters, no gyroscopic moment")
    if not system.forces and not system.nonideal:
        out.append("no force elements" + ("" if system.gravity is None else " besides gravity"))
    return out


def _shorten_bodies(system):
    kinds = Counter(system.layout.rotates)
    for rotates in (True, False):
        if kinds[rotates]:
            names = [n for n, r in zip(system.body_names, system.layout.rotates, strict=True) if r == rotates]
            yield shorten(names), rotates
