"""Options of several commands."""

import argparse
import ast


def add_parameters(command: argparse.ArgumentParser) -> None:
    """Add the keyword arguments of a mechanism."""
    command.add_argument(
        "--set",
        action="append",
        default=[],
        type=assignment,
        metavar="NAME=VALUE",
        help="a keyword argument of the mechanism, such as units=2; may be given more than once",
    )


def assignment(text: str) -> tuple[str, object]:
    """A name, and its value as a Python literal or a word."""
    name, equals, value = text.partition("=")
    if not equals or not name.isidentifier():
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}")
    try:
        return name, ast.literal_eval(value)
    except (SyntaxError, ValueError):
        # A word, such as the name of a variant.
        return name, value
