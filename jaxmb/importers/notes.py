"""What an import says aloud: what it approximates and leaves out, and what it refuses."""

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
    "friction",
    "joints",
    "limits",
    "loops",
    "meshes",
    "springs",
    "tendons",
)


@dataclasses.dataclass
class Notes:
    """Collects sentences while a file is read.

    **Fields:** `ignore`: what is to be left out, a word of `LEAVABLE` or the name of an element of the file; `said`:
    approximations, and what was left out; `refused`.
    """

    ignore: frozenset[str]
    said: list[str] = dataclasses.field(default_factory=list)
    refused: list[str] = dataclasses.field(default_factory=list)
    used: set[str] = dataclasses.field(default_factory=set)

    def say(self, sentence: str) -> None:
        """Note a sentence once."""
        if sentence not in self.said:
            self.said.append(sentence)

    def leaves_out(self, kind: str, name: str = "") -> bool:
        """Whether a kind of element, or the one of this name, is to be left out; if so, this is noted."""
        for word in (kind, name):
            if word and word in self.ignore:
                self.used.add(word)
                self.say(f"The {kind}{f' of {name!r}' if name else ''} are left out, as ignore={word!r} asks.")
                return True
        return False

    def refuse(self, kind: str, name: str, sentence: str) -> None:
        """Refuse an element, unless it is to be left out."""
        if not self.leaves_out(kind, name):
            self.refused.append(f"{sentence} (ignore={kind!r} leaves it out)")

    def finish(self, file: str) -> tuple[str, ...]:
        """The sentences.

        **Raises:** `ValueError` that lists all that was refused, and for words of `ignore` that nothing answers to.
        """
        for word in sorted(self.ignore - self.used - set(LEAVABLE)):
            raise ValueError(f"ignore: {unknown('element', word, LEAVABLE)}")
        if self.refused:
            listed = "".join(f"\n- {sentence}" for sentence in self.refused)
            raise ValueError(f"{file} has elements that cannot be imported:{listed}")
        return tuple(self.said)


def checked_ignore(ignore: str | Collection[str]) -> frozenset[str]:
    """`ignore` as a set of words."""
    return frozenset([ignore] if isinstance(ignore, str) else ignore)
