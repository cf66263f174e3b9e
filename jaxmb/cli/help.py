"""`jaxmb help NAME`: docstrings and topics in the terminal."""

import argparse
import os
import shutil
import sys
from typing import Any

from .. import reference

# Longer lines are hard to read.
_WIDEST = 100


def add_to(commands: Any) -> None:
    """Add the command to a parser's commands."""
    command = commands.add_parser(
        "help",
        help="explain public names or a topic, or list all",
        description="Print the signatures and the docstrings of public names, topics, or a list of all by subject.",
    )
    command.add_argument(
        "names",
        nargs="*",
        help="such as simulate, planar.Revolute, Trajectory.reactions, four_bar; a module: planar, solvers; or a "
        "topic: tolerances, derivatives, contacts",
    )
    command.add_argument(
        "--all",
        action="store_true",
        help="also the methods of parts, for user-defined parts; without a name, what each name is",
    )
    command.set_defaults(command=_help)


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
        print(reference.listed(width, styled, arguments.all))
