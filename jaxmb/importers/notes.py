"""Notes of an import: approximations, elements that are left out, and those that are refused."""

import dataclasses
from collections.abc import Collection

from ..parts.names import unknown

# What can be left out, by name.
LEAVABLE = (
    "actuators",
    "armature",
    "collisions",
    "couplings",
    "damping",
    "fluid",
    "friction",
    "gearboxes",
    "limits",
    "loops",
    "meshes",
    "pictures",
    "springs",
    "tendons",
)
# A note lists so many names, and counts the others.
_LISTED = 8


@dataclasses.dataclass
class Notes:
    """Collects sentences while a file is read.

    **Fields:** `ignore`: what is to be left out, a word of `LEAVABLE` or the name of an element of the file; `said`:
    approximations, and what was left out, each with the names or lines that it holds for; `refused`.
    """

    ignore: frozenset[str]
    said: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    refused: list[str] = dataclasses.field(default_factory=list)
    used: set[str] = dataclasses.field(default_factory=set)

    def say(self, sentence: str, *names: str | int) -> None:
        """Note a sentence once; if it holds for elements, with their names, or their lines in the file, in place of
        `{}`.
        """
        own = self.said.setdefault(sentence, [])
        own += [repr(name) for name in dict.fromkeys(names) if repr(name) not in own]

    def leaves_out(self, kind: str, name: str = "") -> bool:
        """Whether a kind of element, or the one of this name, is to be left out; if so, this is noted."""
        for word in (kind, name):
            if word and word in self.ignore:
                self.used.add(word)
                sentence = f"Left out, as ignore={word!r} asks: {kind}"
                self.say(f"{sentence} ({{}})." if name else f"{sentence}.", *[name][: bool(name)])
                return True
        return False

    def refuse(self, kind: str, name: str, sentence: str) -> None:
        """Refuse an element, unless it is to be left out."""
        if not self.leaves_out(kind, name):
            self.refused.append(f"{sentence} (ignore={kind!r} leaves it out)")

    def finish(self, file: str, what: str = "cannot be imported") -> dict[str, tuple[str, ...]]:
        """The sentences, one for each kind, and for each the names or lines that it holds for, of which it has the
        first ones.

        **Raises:** `ValueError` that lists all that was refused, and for words of `ignore` that nothing answers to.
        """
        for word in sorted(self.ignore - self.used - set(LEAVABLE)):
            raise unknown("element", word, LEAVABLE, "ignore")
        if self.refused:
            listed = "".join(f"\n- {sentence}" for sentence in self.refused)
            raise ValueError(f"{file} has elements that {what}:{listed}")
        # Sentences may have braces from the names of a file.
        return {said.replace("{}", _listed(names)): tuple(names) for said, names in self.said.items()}


def _listed(names):
    more = len(names) - _LISTED
    return ", ".join(names) if more <= 1 else f"{', '.join(names[:_LISTED])} and {more} more"


def checked_ignore(ignore: str | Collection[str]) -> frozenset[str]:
    """`ignore` as a set of words."""
    return frozenset([ignore] if isinstance(ignore, str) else ignore)
