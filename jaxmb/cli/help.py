"""`jaxmb help NAME` and `jaxmb reference FOLDER`: what docstrings and topics say, in the terminal and as HTML."""

import argparse
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from .. import reference

# Longer lines are hard to read.
_WIDEST = 100


def add_to(commands: Any) -> None:
    """Add the commands to a parser's commands."""
    command = commands.add_parser(
        "help",
        help="print what public names are, a topic, or a list of all",
        description="Print the signatures and the docstrings of public names, topics, or a list of all by subject.",
    )
    command.add_argument(
        "names",
        nargs="*",
        help="such as simulate, planar.Revolute, Trajectory.reactions, four_bar; a module: planar, solvers; or a "
        "topic: tolerances, derivatives, contacts",
    )
    command.add_argument("--all", action="store_true", help="of parts also the methods, for parts of one's own")
    command.set_defaults(command=_help)
    command = commands.add_parser(
        "reference",
        help="write the reference of all public names as HTML",
        description="Write the reference of all public names, with a search, as HTML; open index.html in it.",
    )
    command.add_argument("folder", type=Path, help="where to write; it must be empty, or hold an earlier reference")
    command.add_argument(
        "--notebooks",
        type=Path,
        help="folder of notebooks that become part of it (default: those of the checkout of jaxmb in which the command "
        "runs or the package lies)",
    )
    command.set_defaults(command=_reference)


def _help(arguments: argparse.Namespace) -> None:
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    styled = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    topics = reference.topics()

    def shown(name):
        if name in topics:
            return reference.shown_topic(topics[name], width=width, styled=styled)
        return reference.shown(reference.find(name), width=width, styled=styled, every=arguments.all)

    if arguments.names:
        print("\n\n".join(map(shown, arguments.names)))
    else:
        print(reference.listed(width, styled))


def _reference(arguments: argparse.Namespace) -> None:
    notebooks = _notebooks_of_checkout() if arguments.notebooks is None else arguments.notebooks
    try:
        warnings = reference.build(arguments.folder, notebooks=notebooks)
    except ImportError as error:
        raise RuntimeError(str(error)) from error
    for warning in warnings:
        print(f"jaxmb: {warning}", file=sys.stderr)
    print(f"Wrote {arguments.folder / 'index.html'}")


def _notebooks_of_checkout() -> Path | None:
    """The folder `notebooks` beside the package or in the current one, if its notebooks say that they are of jaxmb."""
    for folder in (Path(__file__).parents[2] / "notebooks", Path("notebooks")):
        paths = sorted(folder.glob("*.ipynb"))
        if paths and all("jaxmb" in json.loads(path.read_text(encoding="utf-8"))["metadata"] for path in paths):
            return folder
    return None
