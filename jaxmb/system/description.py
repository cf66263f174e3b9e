"""A description of a system in words: tables and remarks that print as text and show as HTML in a notebook."""

import dataclasses
import html


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
