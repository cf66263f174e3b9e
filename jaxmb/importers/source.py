"""Sources of importers: a path, or the text of a file."""

import os
from pathlib import Path
from typing import Any


def is_text(source: Any) -> bool:
    """Whether a source is the text of a file and not a path."""
    return isinstance(source, str) and source.lstrip().startswith("<")


def file_name(source: Any) -> str:
    """What messages call a source."""
    if is_text(source):
        return "The text"
    return str(source) if isinstance(source, str | os.PathLike) else type(source).__name__


def text_of(source: str | os.PathLike[str]) -> str:
    """The text of a source.

    **Raises:** `ValueError` for a file that does not exist.
    """
    if is_text(source):
        return str(source)
    if not Path(source).is_file():
        raise ValueError(f"{source} does not exist.")
    return Path(source).read_text()
