"""Pages of all public names, topics and notebooks: `python -m tests.pages FOLDER`, from the checkout."""

import re
from pathlib import Path

import jaxmb
from jaxmb.reference import subjects
from jaxmb.reference.entries import entries, signature_of

project, release = "jaxmb", jaxmb.__version__
extensions = ["sphinx.ext.autodoc", "myst_nb"]
root_doc, html_theme, html_title = "tests/pages/index", "furo", f"jaxmb {release}"
include_patterns = ["tests/pages/**", "notebooks/*.ipynb", "jaxmb/reference/topics/*.md"]
myst_enable_extensions, nb_execution_mode = ["dollarmath"], "off"
# A public name in backticks is a link.
default_role, python_maximum_signature_line_length = "py:obj", 100
autodoc_default_options, autoclass_content = {"members": True, "member-order": "bysource"}, "both"


def as_rst(text):
    """A docstring in Markdown as reStructuredText: blocks of code, formulas, code in a line, and items of lists."""
    flags = re.MULTILINE | re.DOTALL
    # Between blocks of code, of which an indentation, a language and the code are further pieces.
    pieces = re.split(r"^( *)```(\w+)\n(.*?)^ *```$", text, flags=flags)
    for k, piece in enumerate(pieces):
        if k % 4 == 0:
            piece = re.sub(r"\$\$(.*?)\$\$", lambda m: ".. math:: " + " ".join(m[1].split()), piece, flags=flags)
            piece = piece.replace("|", "\\|")
            piece = re.sub(r"`([^`]+)`(?=(\w?))", code, piece)
            items = lambda m: re.sub(r"\n +", f"\n{m[1]}  ", m[0])
            pieces[k] = re.sub(r"^( *)- [^\n]*(\n\1 +[^\n]*)+", items, piece, flags=flags)
        elif k % 4 == 2:
            pieces[k] = f".. code-block:: {piece}\n\n"
        elif k % 4 == 3:
            pieces[k] = re.sub("^", "    ", piece, flags=flags)
    return "".join(pieces)


def code(found):
    """A name stays in single backticks, which make links; other code goes into double ones.

    Words in small letters mostly mean arguments.
    """
    inside = found[1].replace("\\|", "|")
    target = f" <jaxmb.{inside}>" if inside in entries() and not inside.islower() else ""
    return (f"`{inside}{target}`" if re.fullmatch(r"[\w.]+", inside) else f"``{inside}``") + "\\ " * bool(found[2])


def signature(app, what, name, thing, *_):
    """The signature as the source has it."""
    made = signature_of(thing, is_method=what == "method") if what in ("class", "function", "method") else None
    returns = None if made is None or made.return_annotation is made.empty else made.return_annotation
    return made and (str(made.replace(return_annotation=made.empty)), returns)


def page(subject):
    """The docstring of a module, and a directive for each name."""
    yield f"{subject.title}\n{'=' * len(subject.title)}"
    if subject.module is not None:
        yield f".. py:module:: {subject.title}\n\n{as_rst(subject.module.text)}"
    for heading, group in subject.groups.items():
        if heading not in ("", subject.title):
            yield f"{heading}\n{'-' * len(heading)}"
        yield from (f".. auto{entry.kind}:: jaxmb.{entry.name}" for entry in group)


def setup(app):
    folder = Path(__file__).with_name("names")
    folder.mkdir(exist_ok=True)
    for k, subject in enumerate(subjects()):
        (folder / f"{k:02}.rst").write_text("\n\n".join(page(subject)) + "\n")
    docstring = lambda *arguments: arguments[-1].__setitem__(slice(None), as_rst("\n".join(arguments[-1])).splitlines())
    app.connect("autodoc-process-docstring", docstring)
    app.connect("autodoc-process-signature", signature)
