"""XML elements with their line in the file, for messages."""

import dataclasses
from collections.abc import Iterator
from xml.parsers import expat

import numpy as np


@dataclasses.dataclass
class Element:
    """An element: its tag, attributes, text and children, its place `where`, `"file:line: "`, and the line."""

    tag: str
    attributes: dict[str, str]
    where: str
    line: int
    text: str = ""
    children: list["Element"] = dataclasses.field(default_factory=list)
    read: bool = False

    def all(self, tag: str) -> Iterator["Element"]:
        """The children of a tag."""
        for child in self.children:
            if child.tag == tag:
                child.read = True
                yield child

    def first(self, tag: str) -> "Element | None":
        """The first child of a tag."""
        return next(self.all(tag), None)

    def need(self, name: str) -> str:
        """A required attribute."""
        if name not in self.attributes:
            raise ValueError(f"{self.where}<{self.tag}> needs the attribute {name!r}.")
        return self.attributes[name]

    def numbers(self, text: str | None = None, count: int = 3) -> np.ndarray:
        """Numbers from an attribute's text, by default from the element's."""
        given = self.text if text is None else text
        try:
            out = np.array([float(word) for word in given.split()])
        except ValueError:
            raise ValueError(f"{self.where}<{self.tag}>: expected {count} numbers, got {given.strip()!r}.") from None
        if out.shape != (count,) or not np.all(np.isfinite(out)):
            raise ValueError(f"{self.where}<{self.tag}>: expected {count} finite numbers, got {given.strip()!r}.")
        return out

    def number(self, tag: str, default: float = 0.0) -> float:
        """The number in a child, `<tag>1.5</tag>`."""
        child = self.first(tag)
        return default if child is None else float(child.numbers(count=1)[0])

    def attribute_number(self, name: str, default: float = 0.0) -> float:
        """The number in an attribute."""
        if name not in self.attributes:
            return default
        return float(self.numbers(self.attributes[name], 1)[0])

    def skip(self) -> None:
        """Mark the element and all its contents as read."""
        below = list(self.children)
        while below:
            child = below.pop()
            child.read = True
            below += child.children

    def unread(self) -> Iterator["Element"]:
        """The outermost unread elements."""
        below = self.children[::-1]
        while below:
            child = below.pop()
            if child.read:
                below += child.children[::-1]
            else:
                yield child


def parse(text: str, file: str) -> Element:
    """The root element of a text.

    **Raises:** `ValueError` with the line for a text that is not XML, and for a declared document type: its entities
    may expand to more text than any memory holds.
    """
    root = Element("", {}, "", 0)
    stack = [root]
    # The text is already decoded, whatever its first line declares.
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    # The declaration of XML must be first, even before an empty line; a C string's zero must not follow the text.
    text = text.rstrip("\0")
    blank = len(text) - len(text.lstrip())
    above = text.count("\n", 0, blank)

    def start(tag, attributes):
        line = parser.CurrentLineNumber + above
        element = Element(tag, attributes, f"{file}:{line}: ", line)
        stack[-1].children.append(element)
        stack.append(element)

    def data(words):
        stack[-1].text += words

    def document_type(*_):
        raise ValueError(
            f"{file}:{parser.CurrentLineNumber + above}: a document type or an entity is declared, which is not "
            "supported: remove <!DOCTYPE …> and write out its entities."
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: stack.pop()
    parser.CharacterDataHandler = data
    parser.StartDoctypeDeclHandler = document_type
    try:
        parser.Parse(text[blank:].encode("utf-8", "surrogatepass"), True)
    except expat.ExpatError as error:
        raise ValueError(f"{file}:{error.lineno + above}: {expat.ErrorString(error.code)}.") from None
    root.children[0].read = True
    return root.children[0]
