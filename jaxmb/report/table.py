"""Tables, the results of reports."""

import dataclasses
import html
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._printed import Printed
from .._version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclasses.dataclass(frozen=True, repr=False)
class Table(Printed):
    """The results of a report; `print` and notebooks show them, and `table["error"]` is a column.

    **Fields:** `title`; `columns`: the format of each column's numbers by its name, `".1e"`, or "" for words; `rows` of
    numbers, words, and None for an unknown number; `notes`: lines below; `draw(table)`: returns a matplotlib figure.
    """

    title: str
    columns: Mapping[str, str]
    rows: Sequence[tuple[Any, ...]]
    notes: Sequence[str] = ()
    draw: "Callable[[Table], Figure] | None" = None

    def __getitem__(self, column: str) -> list[Any]:
        return [row[list(self.columns).index(column)] for row in self.rows]

    def __str__(self) -> str:
        words = sum(not form for form in self.columns.values())
        return "\n".join([self.title, *aligned([list(self.columns), *self._cells()], words), *self.notes])

    def _repr_html_(self) -> str:
        line = lambda tag, cells: "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells)
        rows = "".join(f"<tr>{line('td', cells)}</tr>" for cells in self._cells())
        notes = "".join(f"<p>{html.escape(note)}</p>" for note in self.notes)
        head = f"<caption>{html.escape(self.title)}</caption><tr>{line('th', self.columns)}</tr>"
        return f"<table>{head}{rows}</table>{notes}"

    def _cells(self) -> list[list[str]]:
        cell = lambda value, form: "–" if value is None else value if isinstance(value, str) else format(value, form)
        return [[cell(*pair) for pair in zip(row, self.columns.values(), strict=True)] for row in self.rows]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, for JSON, with the version of jaxmb."""
        rows = [dict(zip(self.columns, row, strict=True)) for row in self.rows]
        return {"jaxmb": __version__, "title": self.title, "rows": rows, "notes": list(self.notes)}

    def plot(self) -> "Figure":
        """A matplotlib `Figure` of the table, which a notebook's cell shows.

        **Raises:** `ImportError` that names the extra to install if matplotlib is missing; `ValueError` for a table
        without a figure.
        """
        if self.draw is None:
            raise ValueError(f"There is no figure of this table: {self.title}.")
        return self.draw(self)

    def figure(self, path: str | Path) -> None:
        """Write `plot()` as PNG, SVG or PDF by the path's ending, with `to_dict` as JSON in its description."""
        key = "Subject" if Path(path).suffix.lower() == ".pdf" else "Description"
        self.plot().savefig(path, dpi=150, metadata={key: json.dumps(self.to_dict())})


def aligned(rows: Sequence[Sequence[str]], words: int = 1) -> list[str]:
    """The lines of a table; the first `words` columns are aligned to the left, numbers to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    side = lambda k, cell: cell.ljust(widths[k]) if k < words else cell.rjust(widths[k])
    return ["  ".join(side(k, cell) for k, cell in enumerate(row)).rstrip() for row in rows]
