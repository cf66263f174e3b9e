"""XML elements that know their line in the file, for messages."""

import dataclasses
from collections.abc import Iterator
from xml.parsers import expat

import numpy as np


@dataclasses.dataclass
class Element:
    """An element: its tag, attributes, text and children, and `where` it stands, `"file:line: "`."""

    tag: str
    attributes: dict[str, str]
    where: str
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
        """An attribute that must be there."""
        if name not in self.attributes:
            raise ValueError(f"{self.where}<{self.tag}> needs the attribute {name!r}.")
        return self.attributes[name]

    def numbers(self, text: str | None = None, count: int = 3) -> np.ndarray:
        """Numbers from an attribute's text, by default from that of the element."""
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

    def unread(self) -> Iterator["Element"]:
        """Elements that nothing has asked for, the outermost of them."""
        for child in self.children:
            if not child.read:
                yield child
            else:
                yield from child.unread()


def parse(text: str, file: str) -> Element:
    """The root element of a text.

    **Raises:** `ValueError` with the line for a text that is not XML.
    """
    root = Element("", {}, "")
    stack = [root]
    parser = expat.ParserCreate()

    def start(tag, attributes):
        element = Element(tag, attributes, f"{file}:{parser.CurrentLineNumber}: ")
        stack[-1].children.append(element)
        stack.append(element)

    def data(words):
        stack[-1].text += words

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: stack.pop()
    parser.CharacterDataHandler = data
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise ValueError(f"{file}:{error.lineno}: {expat.ErrorString(error.code)}.") from None
    root.children[0].read = True
    return root.children[0]
