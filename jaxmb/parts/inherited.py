"""Docstrings of classes: a class explains its new arguments only; the inherited arguments are put before these."""

import inspect
import re

_ARGUMENTS = re.compile(r"\*\*Arguments:\*\*\s+(.*?)(?=\n\n(?!- )|\Z)", re.DOTALL)


def with_inherited_arguments(cls: type) -> str | None:
    """The docstring of a class with the inherited arguments that only its bases explain."""
    if cls.__doc__ is None:
        return None
    inherited = {}
    for base in cls.__bases__:
        inherited = _arguments(base.__doc__ or "") | inherited
    text = inspect.cleandoc(cls.__doc__)
    explained = _arguments(text)
    if not inherited.keys() - explained.keys():
        return cls.__doc__
    # The name of the part comes first, whichever base has it.
    items = [explained.get("name", inherited.get("name")), *(inherited | explained | {"name": None}).values()]
    section = "**Arguments:**\n\n" + "\n".join(item for item in items if item is not None)
    return _ARGUMENTS.sub(lambda _: section, text, 1) if explained else f"{text}\n\n{section}"


def _arguments(text: str) -> dict[str, str]:
    """The items of the list of arguments in a docstring, by their first names; a paragraph is one item."""
    section = _ARGUMENTS.search(inspect.cleandoc(text))
    if section is None:
        return {}
    body = section.group(1)
    items = (
        re.split(r"^(?=- )", body, flags=re.MULTILINE)[1:]
        if body.startswith("- ")
        else ["- " + body.replace("\n", "\n    ")]
    )
    firsts = (re.search(r"`(\w+)`", item) for item in items)
    return {first.group(1): item.strip() for first, item in zip(firsts, items, strict=True) if first}
