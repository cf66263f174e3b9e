"""What a compiled scene is made of, in words: bodies, joints, rows, degrees of freedom, redundancy, and what was left
out.
"""

import dataclasses
import html
from collections import Counter

from .rigid_bodies import RigidBodySystem


@dataclasses.dataclass(frozen=True)
class Description:
    """Tables of a scene; prints as text, shows as HTML in a notebook.

    **Fields:** `facts`: (name, value) pairs; `bodies`, `joints`, `forces`: rows of (type, names or count, remark);
    `implied`: sentences on redundant rows; `left_out`: sentences on what this scene does not trace.
    """

    facts: tuple[tuple[str, str], ...]
    bodies: tuple[tuple[str, str, str], ...]
    joints: tuple[tuple[str, str, str], ...]
    forces: tuple[tuple[str, str, str], ...]
    implied: tuple[str, ...]
    left_out: tuple[str, ...]

    def __str__(self) -> str:
        width = max(len(name) for name, _ in self.facts)
        lines = [f"{name:<{width}}  {value}" for name, value in self.facts]
        for title, rows in (("bodies", self.bodies), ("joints", self.joints), ("forces", self.forces)):
            if rows:
                lines += ["", title]
                widths = [max(len(row[k]) for row in rows) for k in range(2)]
                lines += [f"  {a:<{widths[0]}}  {b:<{widths[1]}}  {c}".rstrip() for a, b, c in rows]
        for title, sentences in (("redundant rows", self.implied), ("left out", self.left_out)):
            if sentences:
                lines += ["", title, *(f"  {sentence}" for sentence in sentences)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        cell = lambda text: f"<td style='text-align:left'>{html.escape(text)}</td>"
        table = lambda rows: "<table>" + "".join(f"<tr>{''.join(map(cell, row))}</tr>" for row in rows) + "</table>"
        parts = [table(self.facts)]
        for title, rows in (("bodies", self.bodies), ("joints", self.joints), ("forces", self.forces)):
            if rows:
                parts.append(f"<b>{title}</b>{table(rows)}")
        for title, sentences in (("redundant rows", self.implied), ("left out", self.left_out)):
            if sentences:
                parts.append(f"<b>{title}</b><ul>{''.join(f'<li>{html.escape(s)}</li>' for s in sentences)}</ul>")
        return "".join(parts)


def describe(system: RigidBodySystem) -> Description:
    """Describe a compiled scene; from its static structure alone, so it works on traced systems as well."""
    space = "spatial" if system.spatial else "planar"
    grubler = system.nu - system.velocity_rows
    positions, motions = system.nq - system.coordinate_rank, system.nu - system.velocity_rank
    normalizations = system.coordinate_rows - system.position_rows
    rows = f"{system.velocity_rows}, of which {system.velocity_rank} independent"
    if system.velocity_rows > system.position_rows:
        rows += f" ({system.velocity_rows - system.position_rows} nonholonomic)"
    facts = [
        ("scene", f"{space}, {len(system.body_names)} bodies"),
        ("velocities", str(system.nu)),
        ("constraint rows", rows),
        ("degrees of freedom", f"{motions} by rank, {grubler} by Grübler's count of rows"),
        ("independent", f"{positions} coordinates, {motions} velocities"),
    ]
    if normalizations:
        with_them = f"{system.nq}, with {normalizations} normalisations; rank of all {system.coordinate_rows} rows"
        facts.insert(2, ("coordinates", f"{with_them} is {system.coordinate_rank}"))
    bodies = [("Body" if r else "PointMass", name, "") for name, r in _shorten_bodies(system)]
    joints = [
        (type(g.group.part).__name__, _shorten(g.group.names), f"{g.rows} rows each" + note)
        for groups, note in ((system.constraints, ""), (system.velocity_constraints, ", between velocities"))
        for g in groups
    ]
    forces = [(type(g.group.part).__name__, _shorten(g.group.names), "") for g in system.forces]
    if system.gravity is not None:
        forces.insert(0, ("Gravity", system.gravity_name, ""))
    implied = [f"row {item.row} of {item.name} is implied by {', '.join(item.by)}" for item in system.implied]
    return Description(
        tuple(facts), tuple(bodies), tuple(joints), tuple(forces), tuple(implied), tuple(_left_out(system))
    )


def _left_out(system: RigidBodySystem) -> list[str]:
    out = []
    if not system.velocity_rows:
        out.append("no constraints: no elimination, no Newton iteration, no charts")
    else:
        if system.position_rows == system.velocity_rows:
            out.append("holonomic only: no rows between velocities, no chart of velocities besides that of coordinates")
        if not system.position_rows:
            out.append("no constraints between positions: no Newton iteration")
        if system.velocity_rank == system.velocity_rows:
            out.append("no redundancy: no row is dropped")
        if system.homogeneous:
            out.append("scleronomic: no derivative with respect to time")
    if not system.spatial:
        out.append("planar: no Euler parameters, no gyroscopic moment")
    if not system.forces:
        out.append("no force elements" + ("" if system.gravity is None else " besides gravity"))
    return out


def _shorten_bodies(system):
    kinds = Counter(system.layout.rotates)
    for rotates in (True, False):
        if kinds[rotates]:
            names = [n for n, r in zip(system.body_names, system.layout.rotates, strict=True) if r == rotates]
            yield _shorten(names), rotates


def _shorten(names) -> str:
    names = list(names)
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:4])}, … {names[-1]} ({len(names)})"
