"""The public names, each once, by subject.

A name is public in a module that defines it without an underscore, or that imports it in the form that makes it public
for type checkers, `from .planar import Body as Body`. If a module has `__all__`, only its names are public. Lines `##
Joints` are headings of the names below. Names of plain values, such as types, have no entry: the docstrings of their
modules explain them.
"""

import ast
import dataclasses
import functools
import importlib
import inspect
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from ..parts.base import AbstractPart
from ..parts.names import UnknownNameError, unknown
from .topics import topics

PACKAGE = __name__.split(".")[0]


@dataclasses.dataclass(frozen=True)
class Entry:
    """A public name of a module, a class, a function, or a member of a class.

    **Fields:** `name`, as a user writes it after `jaxmb.`; `thing`, the object, or the annotation of a field; `owner`,
    the class of a member.
    """

    name: str
    thing: Any
    owner: type | None = None

    @property
    def kind(self) -> str:
        """Module, class, function, method, property or field."""
        if self.owner is not None:
            if isinstance(self.thing, str):
                return "field"
            return "method" if callable(self.thing) else "property"
        return "module" if inspect.ismodule(self.thing) else "class" if inspect.isclass(self.thing) else "function"

    @property
    def is_part(self) -> bool:
        """Whether the entry is a class of parts for scenes, not a base class of parts."""
        return self.kind == "class" and issubclass(self.thing, AbstractPart) and not self.short.startswith("Abstract")

    @property
    def short(self) -> str:
        """The last word of the name."""
        return self.name.rpartition(".")[2]

    @property
    def text(self) -> str:
        """The docstring; for a class, with the arguments from the docstring of `__init__`."""
        docstring = self.thing.__doc__ if self.kind != "field" else f"A field; see `{self.name.rpartition('.')[0]}`."
        texts = [docstring, vars(self.thing)["__init__"].__doc__] if _explains_arguments(self.thing) else [docstring]
        return "\n\n".join(inspect.cleandoc(text) for text in texts if text)

    @property
    def summary(self) -> str:
        """The first sentence of its docstring, in one line."""
        paragraph = " ".join(self.text.split("\n\n")[0].split())
        sentence = re.match(r".*?[^.]\.(?=\s+[A-Z`*]|$)", paragraph)
        return sentence.group() if sentence else paragraph


@dataclasses.dataclass(frozen=True)
class Subject:
    """Public names that belong together.

    **Fields:** `title`; `module`, the entry of their module, None for names of the package itself; `groups` of entries
    by their headings; `others`, entries of other modules whose names the module has as well.
    """

    title: str
    module: Entry | None
    groups: dict[str, tuple[Entry, ...]]
    others: tuple[Entry, ...] = ()

    @property
    def entries(self) -> tuple[Entry, ...]:
        """The entries of all groups."""
        return tuple(entry for group in self.groups.values() for entry in group)


def _explains_arguments(thing: Any) -> bool:
    constructor = vars(thing).get("__init__") if inspect.isclass(thing) else None
    return constructor is not None and (constructor.__doc__ or "").startswith("**Arguments:**")


def public_names(module: ModuleType) -> dict[str, str]:
    """The public names of a module or its stub, in order, each with its heading."""
    path = Path(inspect.getfile(module))
    stub = path.with_suffix(".pyi")
    source = (stub if stub.exists() else path).read_text(encoding="utf-8")
    headings = {k: line[3:] for k, line in enumerate(source.splitlines()) if line.startswith("## ")}
    names = {}
    for node in ast.parse(source).body:
        heading = next((text for k, text in reversed(headings.items()) if k < node.lineno), "")
        names |= dict.fromkeys(_defined(node), heading)
    listed = vars(module).get("__all__", names)
    return {name: heading for name, heading in names.items() if name in listed}


def _defined(node: ast.stmt) -> list[str]:
    match node:
        case ast.ImportFrom():
            return [alias.name for alias in node.names if alias.asname == alias.name]
        case ast.FunctionDef() | ast.ClassDef():
            names = [node.name]
        case ast.Assign():
            names = [target.id for target in node.targets if isinstance(target, ast.Name)]
        case _:
            names = []
    return [name for name in names if not name.startswith("_")]


def public_modules() -> dict[str, ModuleType]:
    """The public modules of the package, at any depth, by name, in the package's order."""

    def below(path: str, module: ModuleType) -> Iterator[tuple[str, ModuleType]]:
        for name in public_names(module):
            member = getattr(module, name)
            if inspect.ismodule(member):
                yield f"{path}{name}", member
                yield from below(f"{path}{name}.", member)

    return dict(below("", importlib.import_module(PACKAGE)))


def _is_described(thing: Any) -> bool:
    is_own = getattr(thing, "__module__", "").split(".")[0] == PACKAGE
    return is_own and (inspect.isclass(thing) or inspect.isroutine(thing))


@functools.cache
def subjects() -> tuple[Subject, ...]:
    """All subjects: first the package's, then its modules'."""
    package = importlib.import_module(PACKAGE)
    seen: dict[int, Entry] = {}
    made = []
    for path, module in {"": package, **public_modules()}.items():
        groups: dict[str, list[Entry]] = {}
        others = []
        for name, heading in public_names(module).items():
            thing = getattr(module, name)
            if id(thing) in seen:
                others.append(seen[id(thing)])
            elif _is_described(thing):
                seen[id(thing)] = Entry(f"{path}.{name}".lstrip("."), thing)
                groups.setdefault(heading, []).append(seen[id(thing)])
        by_heading = {heading: tuple(group) for heading, group in groups.items()}
        if module is package:
            made += [Subject(heading, None, {heading: group}) for heading, group in by_heading.items()]
        else:
            made.append(Subject(f"{PACKAGE}.{path}", Entry(path, module), by_heading, tuple(others)))
    return tuple(made)


@functools.cache
def entries() -> dict[str, Entry]:
    """All entries by name, except members of classes."""
    modules = (subject.module for subject in subjects() if subject.module is not None)
    every = (*modules, *(entry for subject in subjects() for entry in subject.entries))
    return {entry.name: entry for entry in every}


@functools.cache
def other_names() -> dict[str, Entry]:
    """Entries by their further names: in other modules, and in another spelling."""
    by_id = {id(entry.thing): entry for entry in entries().values()}
    others = {}
    for path, module in {"": importlib.import_module(PACKAGE), **public_modules()}.items():
        for name in public_names(module):
            entry, full_name = by_id.get(id(getattr(module, name))), f"{path}.{name}".lstrip(".")
            if entry is not None and entry.name != full_name:
                others[full_name] = entry
    return others


@functools.cache
def members(entry: Entry) -> tuple[Entry, ...]:
    """The documented methods and properties of a class, and of its private bases those that no public base has."""
    inherited = {name for base in bases(entry) for name in _documented(_of_package(base.thing))}
    itself, *others = _of_package(entry.thing)
    public = {id(base.thing) for base in bases(entry)}
    of_private = _documented(base for base in others if id(base) not in public)
    every = {name: thing for name, thing in of_private.items() if name not in inherited} | _documented([itself])
    return tuple(Entry(f"{entry.name}.{name}", thing, entry.thing) for name, thing in every.items())


@functools.cache
def bases(entry: Entry) -> tuple[Entry, ...]:
    """The entries of the public classes that a class derives from, nearest first."""
    by_id = {id(each.thing): each for each in entries().values()}
    mro = entry.thing.__mro__[1:] if entry.kind == "class" else ()
    return tuple(by_id[id(base)] for base in mro if id(base) in by_id)


def fields(entry: Entry) -> dict[str, str]:
    """The annotations of the fields of a class, as they are written."""
    return _fields(entry.thing)


def _fields(cls: type) -> dict[str, str]:
    return {name: annotation for base in reversed(_of_package(cls)) for name, annotation in _annotations(base).items()}


def further_fields(entry: Entry, given: Iterable[str]) -> dict[str, str]:
    """The fields of a class itself, except the `given` parameters."""
    return {name: annotation for name, annotation in _annotations(entry.thing).items() if name not in given}


@functools.cache
def signature(entry: Entry) -> inspect.Signature | None:
    """The signature of a function, class or method, with annotations as in the source; None for others."""
    if entry.kind in ("module", "property", "field"):
        return None
    return signature_of(entry.thing, is_method=entry.kind == "method")


def signature_of(thing: Any, *, is_method: bool = False) -> inspect.Signature | None:
    """The signature of a class or function, or of a method without the object; None if Python has none."""
    try:
        made = inspect.signature(thing)
    except (TypeError, ValueError):
        return None
    is_class = inspect.isclass(thing)
    written = _written(inspect.unwrap(thing.__init__ if is_class else thing))
    if is_class and not written:
        written = _fields(thing)
    parameters = []
    for name, parameter in made.parameters.items():
        annotation = _AsWritten(written[name]) if name in written else parameter.empty
        # Dots for a default that is computed or cannot be typed.
        dots = parameter.default is not parameter.empty and repr(parameter.default).startswith("<")
        default = _AsWritten("...") if dots else parameter.default
        if not (is_method and name == "self"):
            parameters.append(parameter.replace(annotation=annotation, default=default))
    returns = _AsWritten(written["return"]) if "return" in written and not is_class else made.empty
    return inspect.Signature(parameters, return_annotation=returns)


class _AsWritten(str):
    """A text that a signature shows unchanged."""

    __repr__ = str.__str__


def _written(function: Any) -> dict[str, str]:
    """The annotations in the source of a function; none without a source, as in a dataclass."""
    tree = _source(function)
    if not isinstance(tree, ast.FunctionDef):
        return {}
    given = {x.arg: x.annotation for x in ast.walk(tree.args) if isinstance(x, ast.arg)} | {"return": tree.returns}
    return {name: ast.unparse(annotation) for name, annotation in given.items() if annotation is not None}


@functools.cache
def _annotations(cls: type) -> dict[str, str]:
    """The annotations in the source of a class itself, except class variables."""
    nodes = [node for node in getattr(_source(cls), "body", ()) if isinstance(node, ast.AnnAssign)]
    annotations = {ast.unparse(node.target): ast.unparse(node.annotation) for node in nodes}
    shown = lambda name, kind: not (kind.startswith(("ClassVar", "AbstractVar")) or name.startswith("_"))
    return {name: kind for name, kind in annotations.items() if shown(name, kind)}


def _source(thing: Any) -> ast.stmt | None:
    """The statement that defines a class or function; None without a source."""
    try:
        return ast.parse(inspect.cleandoc("\n" + inspect.getsource(thing))).body[0]
    except (OSError, TypeError):
        return None


def _of_package(cls: type) -> list[type]:
    """The class and its bases in this package."""
    return [base for base in cls.__mro__ if base.__module__.split(".")[0] == PACKAGE]


def _documented(classes: Iterable[type]) -> dict[str, Any]:
    """The public methods and properties with docstrings in some classes, for each name from the first class."""
    documented = {}
    for base in classes:
        for name, raw in vars(base).items():
            if name.startswith("_") or name in documented:
                continue
            is_property = isinstance(raw, property | functools.cached_property)
            thing = raw if is_property else getattr(base, name)
            if (is_property or inspect.isroutine(thing)) and thing.__doc__:
                documented[name] = thing
    return documented


@functools.cache
def results() -> dict[str, Entry]:
    """Entries of the classes without a public name that public names return or explain, such as `Reaction`, by their
    names.
    """
    out = {}
    for entry in entries().values():
        for each in (entry, *members(entry)) if entry.kind == "class" else (entry,):
            for name in _classes_named(each):
                thing = _class_of(name, each.thing)
                if name not in _by_short_name() and thing is not None:
                    out[name] = Entry(f"{thing.__module__.removeprefix(f'{PACKAGE}.')}.{name}", thing)
    return out


def _classes_named(entry: Entry) -> list[str]:
    """The capitalised words of an annotation of the result, and of the code in a docstring."""
    function = inspect.unwrap(getattr(entry.thing, "fget", entry.thing))
    # A class has the annotations of its fields.
    returns = "" if inspect.isclass(function) else getattr(function, "__annotations__", {}).get("return", "")
    return [*re.findall(r"`([A-Z]\w+)`", entry.text), *re.findall(r"\b[A-Z]\w+", str(returns))]


def _class_of(name: str, user: Any) -> type | None:
    """The documented class of this package that a name means in the module of its user, or else in any module."""
    using = sys.modules.get(getattr(inspect.unwrap(getattr(user, "fget", user)), "__module__", ""))
    modules = [using] if name in vars(using or object) else [m for k, m in sys.modules.items() if k.startswith(PACKAGE)]
    things = [vars(module).get(name) for module in modules]
    return next((x for x in things if inspect.isclass(x) and x.__module__.startswith(PACKAGE) and x.__doc__), None)


def find(name: str) -> Entry:
    """The entry of a public name, with or without `jaxmb.` or `mb.`, or of a class that public names return. The module
    may be left out if no other module has the name, as in `four_bar`.

    **Raises:** `UnknownNameError` with the nearest names; `ValueError` for a name of several modules.
    """
    plain = re.sub(rf"^({PACKAGE}|mb)\.|\(\)$", "", name.strip())
    match = _found(plain)
    if match is not None:
        return match
    head, dot, last = plain.rpartition(".")
    owner = _found(head) if dot else None
    if owner is not None and owner.kind == "class":
        of_fields = (Entry(f"{owner.name}.{x}", annotation, owner.thing) for x, annotation in fields(owner).items())
        # The nearest class comes last, so that its members are kept.
        of_classes = (member for base in (*reversed(bases(owner)), owner) for member in members(base))
        by_short = {entry.short: entry for entry in (*of_fields, *of_classes)}
        if last in by_short:
            return by_short[last]
        raise unknown("name", plain, [f"{head}.{short}" for short in by_short])
    if dot:
        raise unknown("name", plain, entries())
    by_short = _by_short_name()
    shortest = [entry.short if len(by_short[entry.short]) == 1 else entry.name for entry in entries().values()]
    error, speaking = unknown("name", plain, [*shortest, *results()]), _speaking_of(plain)
    raise UnknownNameError(f"{error} The word is explained in {', '.join(speaking)}.") if speaking else error


def _speaking_of(word: str) -> list[str]:
    """At most six names with an argument or quantity of this name in their docstrings, shortest docstrings first; else
    names and topics that have the word, most often first.
    """
    code, said = re.compile(rf"[`(, ]{re.escape(word)}(=|`)"), re.compile(rf"\b{re.escape(word)}", re.I)
    described = [entry for entry in entries().values() if entry.kind != "module"]
    matches = [entry for entry in described if code.search(entry.text)]
    if matches:
        return [entry.name for entry in sorted(matches, key=lambda entry: len(entry.text))[:6]]
    pages = {topic.name: topic.text for topic in topics().values()} | {x.name: x.text for x in described}
    counts = {name: len(said.findall(text)) for name, text in pages.items()}
    return [name for name in sorted(counts, key=lambda name: -counts[name])[:6] if counts[name]]


def _found(name: str) -> Entry | None:
    for table in (entries(), other_names()):
        if name in table:
            return table[name]
    same = _by_short_name().get(name, [])
    if len(same) > 1:
        listed = " and ".join(repr(entry.name) for entry in same)
        raise ValueError(f"{name!r} is the name of {listed}; give one of these.")
    return same[0] if same else results().get(name)


@functools.cache
def _by_short_name() -> dict[str, list[Entry]]:
    groups = {}
    for entry in entries().values():
        groups.setdefault(entry.short, []).append(entry)
    return groups
