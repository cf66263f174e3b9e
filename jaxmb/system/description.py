"""A description of a system in words: tables and remarks that print as text and show as HTML in a notebook."""

import dataclasses
import html
from collections.abc import Iterable

from .equation import AbstractEquation


@dataclasses.dataclass(frozen=True)
class Description:
    """Tables of a system; prints as text, shows as HTML in a notebook.

    **Fields:** `facts`: (name, value) pairs; `tables`: rows of (type, names or count, remark) by title, of bodies,
    joints, forces, or constraints; `remarks`: sentences by title, on redundant rows and on computations that are
    specialised away.
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


def count_rows(system: AbstractEquation) -> str:
    """The number of constraint rows, of independent ones among them, and of those that do not bind positions."""
    text = f"{system.acceleration_rows}, of which {system.acceleration_rank} independent"
    kinds = {
        "nonholonomic": system.velocity_rows - system.position_rows,
        "between accelerations only": system.acceleration_rows - system.velocity_rows,
    }
    listed = ", ".join(f"{number} {kind}" for kind, number in kinds.items() if number)
    return f"{text} ({listed})" if listed else text


def count_independent(system: AbstractEquation) -> str:
    """The numbers of coordinates and velocities that the constraints leave free."""
    # A mode of friction is no coordinate that moves.
    frictions = None if system.contacts is None else system.contacts.frictions
    modes = 0 if frictions is None else len(frictions.names)
    coordinates = system.nq - system.coordinate_rank - modes
    return f"{coordinates} coordinates, {system.nu - system.velocity_rank} velocities"


def specialised_constraints(system: AbstractEquation) -> list[str]:
    """Sentences on the computations that this system's constraints, or their absence, make unnecessary."""
    if not system.acceleration_rows:
        return ["no constraints: no elimination, no Newton iteration, no charts"]
    out = []
    if system.position_rows == system.acceleration_rows:
        out.append("holonomic only: no rows between velocities, no chart of velocities besides that of coordinates")
    if not system.position_rows:
        out.append("no constraints between positions: no Newton iteration")
    if system.acceleration_rank == system.acceleration_rows:
        out.append("no redundancy: no row is dropped")
    if system.drift_free:
        out.append("scleronomic: no derivative with respect to time")
    return out


def shorten(names: Iterable[str]) -> str:
    """Names in one line, abbreviated if there are many."""
    names = list(names)
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:4])}, … {names[-1]} ({len(names)})"
