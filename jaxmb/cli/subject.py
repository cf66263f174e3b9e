"""The machine of a command: from the library, or from a function of the user."""

import argparse
import ast
import dataclasses
import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from .. import mechanisms
from ..mechanisms import Mechanism
from ..report.subject import subject
from ..states.assembly import assemble


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


def mechanism_of(arguments: argparse.Namespace) -> Mechanism:
    """The mechanism, with its end and its reference values limited to `--t1`."""
    parameters = dict(arguments.set)
    function = _function(arguments.mechanism) if ":" in arguments.mechanism else None
    try:
        mechanism = (
            mechanisms.get(arguments.mechanism, **parameters) if function is None else _made(function, arguments)
        )
    except Exception as error:
        if function is not None or not parameters:
            raise
        # A value of the wrong type may fail anywhere in the mechanism.
        given = ", ".join(f"{name}={value!r}" for name, value in parameters.items())
        reason = str(error).split("\n")[0]
        raise ValueError(f"{arguments.mechanism} cannot be built with --set {given}: {reason}") from error
    if arguments.t1 is None:
        return mechanism
    if not 0 < arguments.t1 < float("inf"):
        raise ValueError(f"--t1 must be positive and finite, got {arguments.t1:g}.")
    return mechanism.until(arguments.t1)


def _function(where: str) -> Callable[..., Any]:
    """A function from `module:function` or `file.py:function`."""
    source, _, name = where.rpartition(":")
    cure = "give module:function or file.py:function"
    if source.endswith(".py"):
        if not Path(source).is_file():
            raise ValueError(f"{where}: there is no file {source}; {cure}.")
        module = module_from(source)
    else:
        sys.path.insert(0, "")
        try:
            module = importlib.import_module(source)
        except ModuleNotFoundError as error:
            # An import within the module may be missing instead.
            if error.name is None or not f"{source}.".startswith(f"{error.name}."):
                raise
            raise ValueError(f"{where}: {error}; {cure}.") from error
    if not hasattr(module, name):
        raise ValueError(f"{where}: {source} has no {name!r}; {cure}.")
    return getattr(module, name)


def _made(function: Callable[..., Any], arguments: argparse.Namespace) -> Mechanism:
    """The motion of a user's function, which returns a scene, a mechanism, or a system, a state and perhaps t1."""
    try:
        inspect.signature(function).bind(**dict(arguments.set))
    except TypeError as error:
        raise ValueError(
            f"{arguments.mechanism}: {error}; --set NAME=VALUE gives an argument, and the others need defaults."
        ) from None
    made = function(**dict(arguments.set))
    given, *rest = made if isinstance(made, tuple) else (made,)
    system = given.compile() if hasattr(given, "compile") else given
    if hasattr(system, "references"):
        return system
    state = rest[0] if rest else assemble(system)
    t1 = arguments.t1 if arguments.t1 is not None else rest[1] if len(rest) > 1 else None
    if t1 is None:
        raise ValueError(f"{arguments.mechanism} gives no end of the motion; add --t1 [s].")
    return dataclasses.replace(subject(system, state, t1), name=function.__name__)


def module_from(source: str) -> ModuleType:
    """A user's file as a module, imported by its path."""
    spec = importlib.util.spec_from_file_location(Path(source).stem, source)
    if spec is None or spec.loader is None:
        raise ValueError(f"{source} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
