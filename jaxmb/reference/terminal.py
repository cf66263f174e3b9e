"""Entries as text for a terminal, filled to its width."""

import inspect
import re
import textwrap
from collections.abc import Iterable

from .entries import Entry, bases, entries, further_fields, members, signature, subjects
from .topics import Topic, topics

_HOW = (
    "`jaxmb help NAME` explains a name, such as `jaxmb help simulate`, all names of a module, such as `jaxmb help "
    "planar`, or a topic, such as `jaxmb help tolerances`. Examples go on from the script of `jaxmb help "
    "getting-started`. "
)
_SHORT, _ALL = "Topics, and public names, which `jaxmb help --all` describes:", "All topics and public names:"
_BOLD, _CODE, _PLAIN = "\x1b[1m", "\x1b[36m", "\x1b[0m"
_ITEM = re.compile(r" *(- |\d+\. )")
_LINK = re.compile(r"\[([^\]]+)\]\([^)]+\.(?:md|ipynb)\)")
_NEXT_ITEM = re.compile(r"\n(?= *(?:- |\d+\. ))")
# A piece of code between fences, or the lines up to an empty line or a piece of code.
_BLOCK = re.compile(r"^ *```.*\n(?P<code>(?:.*\n)*?) *```$|(?:^(?! *```) *\S.*(?:\n|\Z))+", re.M)


def shown(entry: Entry, width: int = 80, styled: bool = False, every: bool = False) -> str:
    """An entry: signature, docstring, and the first sentences of its members.

    **Arguments:** `width`, of the terminal; `styled`: whether it shows bold and coloured text; `every`: whether to
    include methods and further fields of parts, which only systems use.
    """
    parts = [_styled(_heading(entry, width), styled)]
    parts += [block if is_code else _styled(block, styled) for block, is_code in _filled(entry.text, width)]
    alike = [x.name for x in entries().values() if x.short.lower() == entry.short.lower() and x.short != entry.short]
    if alike:
        parts.append(_styled(f"Another name: {', '.join(f'`jaxmb help {name}`' for name in alike)}", styled))
    if entry.is_part and not every:
        parts.append(_styled(f"Its methods, which systems call: `jaxmb help --all {entry.name}`", styled))
    elif entry.kind in ("module", "class"):
        contents = _of_module if entry.kind == "module" else _of_class
        parts += [_styled(part, styled) for part in contents(entry, width)]
    return "\n\n".join(parts)


def shown_topic(topic: Topic, width: int = 80, styled: bool = False) -> str:
    """The text of a topic, without the addresses of links."""
    text = _LINK.sub(r"\1", topic.text)
    parts = [f"**{topic.title}**", *(block for block, _ in _filled(text, width))]
    return "\n\n".join(_styled(part, styled) for part in parts)


def listed(width: int = 80, styled: bool = False, every: bool = False) -> str:
    """A hint, all topics, and the public names by subject; with `every` each with its first sentence."""
    pages = _rows(((name, topic.summary) for name, topic in topics().items()), width)
    parts = [_hanging(_HOW + (_ALL if every else _SHORT), 0, 0, width), "**Topics**", pages]
    for subject in subjects():
        # Some modules have only names of other modules.
        if subject.entries and every:
            parts += [f"**{subject.title}**", _table(subject.entries, width)]
        elif subject.entries:
            names = ", ".join(entry.short for entry in subject.entries)
            parts.append(f"**{subject.title}**\n{_hanging(names, 2, 2, width)}")
    return "\n\n".join(_styled(part, styled) for part in parts)


def _heading(entry: Entry, width: int) -> str:
    """The call of a name, with a line for each parameter if one line is too short."""
    name, call = f"jaxmb.{entry.name}", signature(entry)
    if entry.kind == "field":
        return f"**{name}**: {entry.thing}"
    if call is None:
        return f"**{name}**"
    line = f"{name}{call}"
    if len(line) <= width:
        return line.replace(name, f"**{name}**", 1)
    parameters = list(call.parameters.values())
    lines = [str(parameter) for parameter in parameters]
    kinds = [parameter.kind for parameter in parameters]
    if inspect.Parameter.KEYWORD_ONLY in kinds and inspect.Parameter.VAR_POSITIONAL not in kinds:
        lines.insert(kinds.index(inspect.Parameter.KEYWORD_ONLY), "*")
    returns = str(call.replace(parameters=[])).removeprefix("()")
    return "\n".join([f"**{name}**(", *(f"    {parameter}," for parameter in lines), f"){returns}"])


def _of_module(entry: Entry, width: int) -> Iterable[str]:
    (of_module,) = [subject for subject in subjects() if subject.module == entry]
    for heading, group in of_module.groups.items():
        yield from _section(heading or "Names", group, width)
    yield from _section("Of other modules", of_module.others, width)


def _of_class(entry: Entry, width: int) -> Iterable[str]:
    given = signature(entry)
    others = further_fields(entry, given.parameters if given else ())
    if others:
        lines = (_hanging(f"{name}: {annotation}", 4, 8, width) for name, annotation in others.items())
        yield "\n".join(["**Further fields**", *lines])
    yield from _section("Methods and properties", members(entry), width)
    for base in bases(entry):
        inherited = ", ".join(member.short for member in members(base))
        if inherited:
            yield "\n".join([f"**From {base.name}**", _hanging(inherited, 4, 4, width)])


def _section(title: str, entries: tuple[Entry, ...], width: int) -> Iterable[str]:
    if entries:
        yield f"**{title}**\n{_table(entries, width)}"


def _table(entries: Iterable[Entry], width: int) -> str:
    """Names with their first sentences beside them."""
    return _rows(((entry.name if entry.owner is None else entry.short, entry.summary) for entry in entries), width)


def _rows(rows: Iterable[tuple[str, str]], width: int) -> str:
    return "\n".join(_hanging(f"**{name}**  {summary}", 2, 6, width) for name, summary in rows)


def _hanging(text: str, first: int, other: int, width: int) -> str:
    return textwrap.fill(
        text, width, initial_indent=" " * first, subsequent_indent=" " * other, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip


def _filled(text: str, width: int) -> Iterable[tuple[str, bool]]:
    """The filled paragraphs of a docstring, each with whether it is code; code and tables stay as they are."""
    for match in _BLOCK.finditer(text):
        block = match.group().rstrip("\n")
        if match["code"] is not None:
            yield textwrap.indent(textwrap.dedent(match["code"]).rstrip("\n"), "    "), True
        elif block.lstrip().startswith("|"):
            yield block, False
        else:
            yield "\n".join(_hanging_item(item.split("\n"), width) for item in _NEXT_ITEM.split(block)), False


def _hanging_item(lines: list[str], width: int) -> str:
    indent = len(lines[0]) - len(lines[0].lstrip())
    mark = _ITEM.match(lines[0])
    other = indent if mark is None else len(mark.group())
    return _hanging(" ".join(" ".join(lines).split()), indent, other, width)


def _styled(text: str, styled: bool) -> str:
    """Bold text and code in the terminal's styles; without styles, bold text only loses its marks."""
    pieces = re.split(r"(`[^`]+`)", text)
    bold = rf"{_BOLD}\1{_PLAIN}" if styled else r"\1"
    pieces[::2] = [re.sub(r"\*\*(?=\S)(.+?)(?<=\S)\*\*", bold, piece) for piece in pieces[::2]]
    if styled:
        pieces[1::2] = [f"{_CODE}{piece[1:-1]}{_PLAIN}" for piece in pieces[1::2]]
    return "".join(pieces)
