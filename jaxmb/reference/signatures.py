"""Signatures as the source has them, where annotations and defaults have names that are short to read."""

import ast
import dataclasses
import functools
import inspect
import re
from collections.abc import Mapping
from typing import Any

from .entries import Entry, fields


@dataclasses.dataclass(frozen=True)
class Signature:
    """**Fields:** `parameters`, each with its annotation and default, with the marks `*` and `/`; `returns`, the
    annotation of what is returned, or "".
    """

    parameters: tuple[str, ...]
    returns: str = ""

    @property
    def names(self) -> frozenset[str]:
        """The names of the parameters."""
        return frozenset(re.split(r"[:= ]", own.lstrip("*"))[0] for own in self.parameters)

    def __str__(self) -> str:
        return f"({', '.join(self.parameters)})" + (f" -> {self.returns}" if self.returns else "")


@functools.cache
def signature(entry: Entry) -> Signature | None:
    """What a function, class or method is called with; None where an entry is not called."""
    if entry.kind in ("module", "property", "field"):
        return None
    if entry.kind != "class":
        return _written(inspect.unwrap(entry.thing), bound=_is_bound(entry))
    written = _written(inspect.unwrap(entry.thing.__init__), bound=True)
    if written is not None:
        return dataclasses.replace(written, returns="")
    return _of_fields(entry)


def _is_bound(entry: Entry) -> bool:
    """Whether a user does not give the first parameter, which is the object or the class."""
    if entry.owner is None:
        return False
    return not isinstance(inspect.getattr_static(entry.owner, entry.short), staticmethod)


def _written(function: Any, bound: bool) -> Signature | None:
    """The signature in the source of a function; None where it has none, as that of a dataclass."""
    try:
        source = inspect.cleandoc("\n" + inspect.getsource(function))
    except (OSError, TypeError):
        return None
    (tree,) = ast.parse(source).body
    if not isinstance(tree, ast.FunctionDef):
        return None
    given, made = tree.args, inspect.signature(function).parameters
    by_place = [*given.posonlyargs, *given.args]
    defaults = [None] * (len(by_place) - len(given.defaults)) + given.defaults
    out = [_parameter(own, default, made) for own, default in zip(by_place, defaults, strict=True)]
    if given.posonlyargs:
        out.insert(len(given.posonlyargs), "/")
    if given.vararg is not None:
        out.append("*" + _parameter(given.vararg, None, made))
    elif given.kwonlyargs:
        out.append("*")
    out += [_parameter(own, default, made) for own, default in zip(given.kwonlyargs, given.kw_defaults, strict=True)]
    if given.kwarg is not None:
        out.append("**" + _parameter(given.kwarg, None, made))
    return Signature(tuple(out[bound:]), "" if tree.returns is None else ast.unparse(tree.returns))


def _parameter(own: ast.arg, default: ast.expr | None, made: Mapping[str, inspect.Parameter]) -> str:
    annotation = "" if own.annotation is None else f": {ast.unparse(own.annotation)}"
    if default is None:
        return own.arg + annotation
    value = made[own.arg].default
    # The value of a constant says more than its name.
    is_constant = isinstance(default, ast.Name) and isinstance(value, int | float | str)
    return own.arg + annotation + _default(repr(value) if is_constant else ast.unparse(default), annotation)


def _default(text: str, annotation: str) -> str:
    return f" = {text}" if annotation else f"={text}"


def _of_fields(entry: Entry) -> Signature | None:
    """That of a dataclass or a named tuple, with annotations as the fields have them."""
    try:
        made = inspect.signature(entry.thing)
    except (TypeError, ValueError):
        return None
    annotations, out = fields(entry), []
    for name, own in made.parameters.items():
        if own.kind is own.KEYWORD_ONLY and "*" not in out:
            out.append("*")
        mark = {own.VAR_POSITIONAL: "*", own.VAR_KEYWORD: "**"}.get(own.kind, "")
        annotation = f": {annotations[name]}" if name in annotations else ""
        default = "" if own.default is own.empty else _default(_shown(own.default), annotation)
        out.append(mark + name + annotation + default)
    return Signature(tuple(out))


def _shown(value: Any) -> str:
    """A default as it is typed, or dots for one that is made anew or has no such form."""
    text = repr(value)
    return "..." if text.startswith("<") else text
