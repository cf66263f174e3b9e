"""Notes of an import: approximations, omitted elements and refused elements."""

import dataclasses
from collections.abc import Collection

from ..parts.names import unknown

# The kinds of elements that can be left out.
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
# The number of names that a note lists; it counts the others.
_LISTED = 8


@dataclasses.dataclass
class Notes:
    """Collects sentences while a file is read.

    **Fields:** `ignore`: elements to leave out, by words of `LEAVABLE` or by name; `said`: sentences on approximations
    and omissions, each with the names or lines that it concerns; `refused`: sentences on refused elements; `used`: the
    words of `ignore` that had an effect.
    """

    ignore: frozenset[str]
    said: dict[str, list[str]] = dataclasses.field(default_factory=dict)
    refused: list[str] = dataclasses.field(default_factory=list)
    used: set[str] = dataclasses.field(default_factory=set)

    def say(self, sentence: str, *names: str | int) -> None:
        """Note a sentence once; names of elements, or their lines in the file, take the place of `{}`."""
        listed = self.said.setdefault(sentence, [])
        listed += [repr(name) for name in dict.fromkeys(names) if repr(name) not in listed]

    def leaves_out(self, kind: str, name: str = "") -> bool:
        """Whether a kind of element, or the element of this name, is to be left out; an omission is noted."""
        for word in (kind, name):
            if word and word in self.ignore:
                self.used.add(word)
                sentence = f"Left out, as ignore={word!r} asks: {kind}"
                self.say(f"{sentence} ({{}})." if name else f"{sentence}.", *[name][: bool(name)])
                return True
        return False

    def refuse(self, kind: str, name: str, sentence: str) -> None:
        """Refuse an element, unless `ignore` leaves it out."""
        if not self.leaves_out(kind, name):
            self.refused.append(f"{sentence} (ignore={kind!r} leaves it out)")

    def finish(self, file: str, what: str = "cannot be imported") -> dict[str, tuple[str, ...]]:
        """The sentences, one for each kind, with the first names or lines that it concerns; and for each all names or
        lines.

        **Raises:** `ValueError` that lists all refused elements, and for words of `ignore` without effect.
        """
        for word in sorted(self.ignore - self.used - set(LEAVABLE)):
            raise unknown("element", word, LEAVABLE, "ignore")
        if self.refused:
            listed = "".join(f"\n- {sentence}" for sentence in self.refused)
            raise ValueError(f"{file} has elements that {what}:{listed}")
        # Names in a sentence may contain braces.
        return {note.replace("{}", _listed(names)): tuple(names) for note, names in self.said.items()}


def _listed(names):
    more = len(names) - _LISTED
    return ", ".join(names) if more <= 1 else f"{', '.join(names[:_LISTED])} and {more} more"


def checked_ignore(ignore: str | Collection[str]) -> frozenset[str]:
    """`ignore` as a set of words."""
    return frozenset([ignore] if isinstance(ignore, str) else ignore)
