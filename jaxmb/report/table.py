"""Tables in plain text."""

from collections.abc import Sequence


def aligned(rows: Sequence[Sequence[str]], words: int = 1) -> list[str]:
    """The lines of a table; the first `words` columns are aligned to the left, numbers to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    side = lambda k, cell: cell.ljust(widths[k]) if k < words else cell.rjust(widths[k])
    return ["  ".join(side(k, cell) for k, cell in enumerate(row)).rstrip() for row in rows]
