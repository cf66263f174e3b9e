"""The reference as HTML: pages in MyST's markdown, which Sphinx turns into a site with a search.

Docstrings are markdown, and so go into the pages as they are. Names in them that are public become links.
"""

import functools
import importlib
import inspect
import io
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from .._version import __version__
from .entries import (
    PACKAGE,
    Entry,
    Subject,
    bases,
    entries,
    further_fields,
    members,
    other_names,
    subjects,
)
from .signatures import signature
from .topics import topics

_CONFIGURATION = f"""
project = "{PACKAGE}"
version = release = "{__version__}"
extensions = ["myst_nb"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
nb_execution_mode = "off"
html_theme = "furo"
html_title = "{PACKAGE} {__version__}"
html_copy_source = False
html_show_copyright = False
# Each parameter has a line where one line is too short for them.
python_maximum_signature_line_length = 100
"""
_DEPTH = ":" * 8
_NAME = re.compile(r"(?<!`)`([A-Za-z_][\w.]*)(\(\))?`(?!`)")


def build(folder: Path | str, *, notebooks: Path | str | None = None) -> list[str]:
    """Write the reference of all public names as HTML.

    **Arguments:** `folder`: where to write, empty or with an earlier reference, which is replaced; `notebooks`: a
    folder of notebooks, which are shown with the outputs that they have.

    **Returns:** the warnings of Sphinx, each a line.

    **Raises:** `ValueError` for a folder with other files, or one without notebooks; `ImportError` without Sphinx, pip
    install "jaxmb[docs]"; `RuntimeError` if Sphinx fails.
    """
    folder, application = Path(folder), _sphinx()
    if folder.exists() and not (folder.is_dir() and (not any(folder.iterdir()) or _is_reference(folder))):
        raise ValueError(f"{folder} holds other files; give a new folder, or that of an earlier reference.")
    shown = [] if notebooks is None else sorted(Path(notebooks).glob("*.ipynb"))
    if notebooks is not None and not shown:
        raise ValueError(f"There are no notebooks in {notebooks}.")
    with tempfile.TemporaryDirectory() as temporary:
        sources, made, warnings = Path(temporary) / "sources", Path(temporary) / "made", io.StringIO()
        _write_sources(sources, shown)
        sphinx = application(sources, sources, made, Path(temporary) / "trees", "html", status=None, warning=warnings)
        sphinx.build(force_all=True)
        if sphinx.statuscode:
            raise RuntimeError(f"Sphinx failed: {warnings.getvalue().strip()}")
        if folder.exists():
            shutil.rmtree(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(made, folder)
        lines = re.sub(r"\x1b\[[\d;]*m", "", warnings.getvalue()).splitlines()
    return [line.replace(f"{sources}/", "") for line in lines if line.strip()]


def _is_reference(folder: Path) -> bool:
    """Whether a folder holds a site of Sphinx with the names of this package."""
    inventory = folder / "objects.inv"
    return inventory.is_file() and f"# Project: {PACKAGE}\n".encode() in inventory.read_bytes()


def _sphinx() -> Callable[..., Any]:
    try:
        import furo  # noqa: F401
        import myst_nb  # noqa: F401
        from sphinx.application import Sphinx
    except ImportError as error:
        raise ImportError('The reference is made by Sphinx; install it with: pip install "jaxmb[docs]"') from error
    return Sphinx


def _write_sources(sources: Path, notebooks: list[Path]) -> None:
    sources.mkdir()
    (sources / "conf.py").write_text(_CONFIGURATION)
    for subject in subjects():
        (sources / f"{_page(subject)}.md").write_text("\n\n".join(_of_subject(subject)) + "\n")
    for topic in topics().values():
        text = _linked(topic.text, entries()["simulate"])
        (sources / f"{topic.name}.md").write_text(f"# {topic.title}\n\n{text}\n")
    for path in notebooks:
        shutil.copy(path, sources)
    (sources / "index.md").write_text("\n\n".join(_of_index([path.stem for path in notebooks])) + "\n")


def _page(subject: Subject) -> str:
    return re.sub(r"\W+", "_", subject.title).lower()


def _of_index(notebooks: list[str]) -> Iterable[str]:
    yield f"# {PACKAGE}"
    yield f"```{{py:module}} {PACKAGE}\n```"
    yield importlib.import_module(PACKAGE).__doc__ or ""
    pages_of = {"Topics": [*topics()], "Names": [_page(subject) for subject in subjects()], "Notebooks": notebooks}
    for caption, pages in pages_of.items():
        if pages:
            yield "\n".join(["```{toctree}", f":caption: {caption}", ":maxdepth: 1", "", *pages, "```"])
    for subject in subjects():
        yield f"## {subject.title}"
        yield _table(subject.entries)


def _of_subject(subject: Subject) -> Iterable[str]:
    yield f"# {subject.title}"
    if subject.module is None:
        yield f"```{{py:currentmodule}} {PACKAGE}\n```"
    else:
        yield f"```{{py:module}} {PACKAGE}.{subject.module.name}\n```"
        yield _linked(subject.module.text, subject.module)
    yield _table(subject.entries)
    if subject.others:
        yield "Of other modules: " + ", ".join(map(_link, subject.others)) + "."
    for entry in subject.entries:
        yield from _of_entry(entry, _DEPTH)


def _table(shown: Iterable[Entry]) -> str:
    return "\n".join(f"- {_link(entry)}: {_linked(entry.summary, entry)}" for entry in shown)


def _of_entry(entry: Entry, fence: str) -> Iterable[str]:
    """The directive of a class, function or member, with those of its members in it."""
    own = signature(entry)
    yield f"{fence}{{py:{entry.kind}}} {entry.short}{own or ''}"
    yield _linked(entry.text, entry)
    if entry.kind == "class":
        inner = fence[:-1]
        for name, annotation in further_fields(entry, own.names if own else ()).items():
            yield f"{inner}{{py:attribute}} {name}\n:type: {annotation}\n{inner}"
        for member in members(entry):
            yield from _of_entry(member, inner)
        for base in bases(entry):
            inherited = ", ".join(f"{{py:obj}}`{own.short} <{PACKAGE}.{own.name}>`" for own in members(base))
            if inherited:
                yield f"From {_link(base)}: {inherited}."
    yield fence


def _link(entry: Entry) -> str:
    return f"{{py:obj}}`{entry.name} <{PACKAGE}.{entry.name}>`"


def _linked(text: str, entry: Entry) -> str:
    """A docstring in which names in backticks are links to their entries, but for those in code."""
    pieces = re.split(r"(^ *```.*?^ *```$)", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(
        piece if k % 2 else _NAME.sub(lambda own: _replaced(own, entry), piece) for k, piece in enumerate(pieces)
    )


def _replaced(own: re.Match[str], entry: Entry) -> str:
    target = _target(own.group(1), entry)
    return own.group() if target is None else f"{{py:obj}}`{own.group(1)}{own.group(2) or ''} <{PACKAGE}.{target}>`"


def _target(name: str, entry: Entry) -> str | None:
    """The name of the entry that a word of a docstring means; None for other words.

    Words in small letters mostly mean arguments, so that of these only functions of the package count. Classes are
    looked for beside the entry, in the package, and then anywhere.
    """
    plain, known = name.removeprefix(f"{PACKAGE}."), _targets()
    home = entry.name if entry.owner is None else entry.name.rpartition(".")[0]
    module = home.rpartition(".")[0] if entry.kind != "module" else home
    if name in _own_words(entry):
        return None
    beside = [f"{home}.{plain}", f"{module}.{plain}", plain]
    if entry.kind != "module" and name.islower() and "." not in name:
        beside = [plain] if inspect.isroutine(entries().get(plain, entry).thing) else []
    return next((known[own] for own in beside if own in known), _unique_names().get(plain))


def _own_words(entry: Entry) -> frozenset[str]:
    """What is called by a name of its own in the docstring of an entry: its parameters and itself."""
    own = None if entry.kind == "module" else signature(entry)
    return frozenset({entry.short}) | (own.names if own else frozenset())


@functools.cache
def _targets() -> dict[str, str]:
    """All names that can be linked to, members included, with those under which the pages have them."""
    found = {}
    for name, entry in (*entries().items(), *other_names().items()):
        found[name] = entry.name
        if entry.kind == "class":
            found |= {f"{name}.{own.short}": own.name for own in members(entry)}
    return found


@functools.cache
def _unique_names() -> dict[str, str]:
    """Names without their modules, of classes and their members that only one module has."""
    found = {}
    for name, target in _targets().items():
        words = name.split(".")
        k = next((k for k, word in enumerate(words) if word[:1].isupper()), None)
        if k is not None:
            found.setdefault(".".join(words[k:]), set()).add(target)
    return {name: next(iter(targets)) for name, targets in found.items() if len(targets) == 1}
