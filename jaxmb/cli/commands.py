"""The commands, and how they end."""

import argparse
import sys
from collections.abc import Sequence

import jax

from .. import mechanisms
from . import report, run, sweep


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    **Arguments:** `argv`: the words after `jaxmb`, default those of the process.

    **Returns:** the exit code: 0; with a message on stderr 1 if a simulation failed or a file could not be written, 2
    for a name or value that does not fit, and 130 after Ctrl-C.
    """
    arguments = parser().parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    try:
        arguments.command(arguments)
    except (ValueError, RuntimeError, OSError) as error:
        print(f"jaxmb: {error}", file=sys.stderr)
        return 2 if isinstance(error, ValueError) else 1
    except KeyboardInterrupt:
        print("jaxmb: interrupted", file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    out = argparse.ArgumentParser(
        prog="jaxmb", description="Accurate, differentiable dynamics of constrained mechanical systems."
    )
    commands = out.add_subparsers(required=True, metavar="command")
    commands.add_parser("mechanisms", help="list the mechanisms of the library").set_defaults(command=_mechanisms)
    for command in (run, report, sweep):
        command.add_to(commands)
    return out


def _mechanisms(arguments: argparse.Namespace) -> None:
    del arguments
    width = max(map(len, mechanisms.names()))
    for name in mechanisms.names():
        summary = " ".join((getattr(mechanisms, name).__doc__ or "").split("\n\n")[0].split())
        print(f"{name:{width}}  {summary}")
