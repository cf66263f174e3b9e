"""A description of a system in words: tables and remarks that print as text and show as HTML in a notebook."""

import dataclasses
import html
from collections.abc import Iterable

from .equation import AbstractEquation

# The title of remarks on computations left out.
LEFT_OUT = "left out of the computation, since nothing here needs it"


@dataclasses.dataclass(frozen=True)
class Description:
    """Tables of a system; prints as text, shows as HTML in a notebook.

    **Fields:** `facts`: (name, value) pairs; `tables`: rows of (type, names or count, remark) by title, of bodies,
    joints, forces, or constraints; `remarks`: sentences by title, on redundant rows and on computations left out.
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
    """Numbers of constraint rows, of independent rows, and of rows that do not bind positions."""
    text = f"{system.acceleration_rows}, of which {system.acceleration_rank} independent"
    kinds = {
        "nonholonomic": system.velocity_rows - system.position_rows,
        "between accelerations only": system.acceleration_rows - system.velocity_rows,
    }
    listed = ", ".join(f"{number} {kind}" for kind, number in kinds.items() if number)
    return f"{text} ({listed})" if listed else text


def count_independent(system: AbstractEquation) -> str:
    """Numbers of coordinates and velocities that the constraints leave free."""
    # A mode of friction is not a coordinate that moves.
    coordinates = system.nq - system.coordinate_rank - system.contacts.m
    velocities = system.nu - system.velocity_rank
    return f"{counted(coordinates, 'coordinate')}, {counted(velocities, 'velocity', 'velocities')}"


def remarks(
    system: AbstractEquation, left_out: Iterable[str] = (), redundant: Iterable[str] = ()
) -> dict[str, tuple[str, ...]]:
    """The remarks of a description: on freedom, on `redundant` rows, and on computations left out."""
    return {
        "no degree of freedom": _held_in_place(system),
        "redundant rows": tuple(redundant),
        LEFT_OUT: (*_left_out_of_constraints(system), *left_out),
    }


def _held_in_place(system: AbstractEquation) -> tuple[str, ...]:
    """A sentence on a system without degrees of freedom."""
    if system.nu > system.velocity_rank:
        return ()
    if system.drift_free:
        return ("The constraints hold everything in place: nothing can move.",)
    return ("The constraints prescribe every motion: forces have no effect on it.",)


def _left_out_of_constraints(system: AbstractEquation) -> list[str]:
    """Computations that the constraints, or their absence, make unnecessary, with the reasons."""
    if not system.acceleration_rows:
        return ["elimination, Newton iteration and charts: there are no constraints"]
    out = []
    if system.position_rows == system.acceleration_rows:
        out.append("equations of velocities besides those of coordinates: every constraint is one of positions")
    if not system.position_rows:
        out.append("Newton iteration for positions: no constraint is one of positions")
    if system.acceleration_rank == system.acceleration_rows:
        out.append("choice of the rows that count: none is redundant")
    if system.drift_free:
        out.append("derivatives of constraints with respect to time: none changes with time")
    return out


def counted(number: int, one: str, many: str | None = None) -> str:
    """A number with its noun: `one` in the singular, else `many`, by default `one` with an s."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def shorten(names: Iterable[str]) -> str:
    """Names in one line, abbreviated if they are many."""
    names = list(names)
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:4])}, … {names[-1]} ({len(names)})"
