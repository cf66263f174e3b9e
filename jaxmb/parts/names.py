"""Messages about names: the nearest one to a misspelt one."""

import difflib
from collections.abc import Iterable


def unknown(what: str, name: str, known: Iterable[str]) -> ValueError:
    """An error for a name that is not there, with the nearest names."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=2, cutoff=0.5)
    if near:
        hint = f"; did you mean {' or '.join(map(repr, near))}?"
    else:
        listed = ", ".join(map(repr, known[:12])) + (", …" if len(known) > 12 else "")
        hint = f"; there are {listed}." if known else "; there are none."
    return ValueError(f"Unknown {what} {name!r}{hint}")
