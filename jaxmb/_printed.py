"""Results that `print` and a notebook's cell show as a table, and a list or dictionary in one line."""

import html
from typing import Any


class Printed:
    """Shows `str` in a notebook, and one line elsewhere."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}: a table of {str(self).count(chr(10)) + 1} lines, which print shows"

    def _repr_html_(self) -> str:
        return preformatted(self)


def preformatted(shown: Any) -> str:
    """The text of an object as a notebook's cell shows it."""
    return f"<pre>{html.escape(str(shown))}</pre>"
