"""Topics that concern several names, as markdown pages beside the docstrings."""

import functools
from pathlib import Path
from typing import NamedTuple


class Topic(NamedTuple):
    """A page on a topic of several names.

    **Fields:** `name`, as in `jaxmb help tolerances`; `title`; `text`, markdown without the title.
    """

    name: str
    title: str
    text: str

    @property
    def summary(self) -> str:
        """The first sentence."""
        words = " ".join(self.text.split("\n\n", 1)[0].replace("**", "").split())
        return words.split(". ")[0].rstrip(".:") + "."


@functools.cache
def topics() -> dict[str, Topic]:
    """All topics by name, in alphabetical order."""
    files = sorted(Path(__file__).with_name("topics").glob("*.md"))
    return {file.stem: Topic(file.stem, *_parted(file.read_text(encoding="utf-8"))) for file in files}


def _parted(text: str) -> tuple[str, str]:
    title, text = text.removeprefix("# ").split("\n", 1)
    return title, text.strip()
