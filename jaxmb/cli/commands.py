"""The commands and their exit codes."""

import argparse
import os
import sys
import traceback
import warnings
from collections.abc import Sequence

from .. import mechanisms
from .._setup import VARIABLE, setup
from .._traced_functions import is_of_user
from . import doctor, help, run, sweep


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    **Arguments:** `argv`: the words after `jaxmb`, default from the process.

    **Returns:** the exit code: 0; or, with a message on stderr, 1 if a simulation failed or a file could not be
    written, 2 for an invalid name or value, and 130 after Ctrl-C. Errors in a user's file have their tracebacks.
    """
    arguments = (commands := parser()).parse_args(argv)
    if arguments.command is None:
        commands.print_help()
        return 0
    _prepare()
    try:
        arguments.command(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of a pipe, such as head, has closed it; no output must be left to write when the process ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, RuntimeError, OSError) as error:
        if is_of_user(error):
            traceback.print_exception(error)
        else:
            print(f"jaxmb: {error}", file=sys.stderr)
        return 2 if isinstance(error, ValueError) else 1
    except KeyboardInterrupt:
        print("jaxmb: interrupted", file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    out = argparse.ArgumentParser(
        prog="jaxmb",
        description="Accurate, differentiable dynamics of constrained mechanical systems.",
        epilog="Compiled programs are kept in the user's cache folder for later runs; the environment variable "
        f"{VARIABLE} names another folder, or is off. `jaxmb doctor` shows the folder.",
    )
    out.set_defaults(command=None)
    commands = out.add_subparsers(metavar="command")
    commands.add_parser("mechanisms", help="list the mechanisms of the library").set_defaults(command=_mechanisms)
    for command in (run, sweep, doctor, help):
        command.add_to(commands)
    return out


def _prepare() -> None:
    """Double precision, fast compilation, and the cache of programs."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        setup()
    for warning in caught:
        print(f"jaxmb: {warning.message}", file=sys.stderr)


def _mechanisms(arguments: argparse.Namespace) -> None:
    del arguments
    width = max(map(len, mechanisms.names()))
    for name in mechanisms.names():
        summary = " ".join((getattr(mechanisms, name).__doc__ or "").split("\n\n")[0].split())
        print(f"{name:{width}}  {summary}")
