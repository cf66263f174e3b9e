"""Error messages for unknown names, with the nearest known ones."""

import difflib
from collections.abc import Iterable


def unknown(what: str, name: str, known: Iterable[str]) -> ValueError:
    """An error for an unknown name, with the nearest known ones."""
    known = list(dict.fromkeys(known))
    near = difflib.get_close_matches(name, known, n=2, cutoff=0.5)
    if near:
        hint = f"; did you mean {' or '.join(map(repr, near))}?"
    else:
        listed = ", ".join(map(repr, known[:12])) + (", …" if len(known) > 12 else "")
        hint = f"; there are {listed}." if known else "; there are none."
    return ValueError(f"Unknown {what} {name!r}{hint}")
