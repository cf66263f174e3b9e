"""Error messages for unknown names, with the nearest known names."""

import difflib
import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import ParamSpec, TypeVar

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


class UnknownNameError(ValueError, KeyError):
    """An unknown name. It is a `KeyError` as well, so that `in` and `get` of a mapping work."""

    __str__ = ValueError.__str__


def unknown(what: str, name: str, known: Iterable[str], where: str = "") -> UnknownNameError:
    """An error for an unknown name, with the nearest known names. For `"rod.phi"`, or `"rod"` where names have dots,
    these are names of `"rod"`. `where`: the part or argument that has the name.
    """
    lead = f"{where}: " if where else ""
    return UnknownNameError(f"{lead}Unknown {what} {name!r}{_hint(str(name), known)}")


def _hint(name: str, names: Iterable[str]) -> str:
    names = list(dict.fromkeys(names))
    part, _, field = name.rpartition(".")
    if any(candidate.startswith(f"{name}.") for candidate in names):
        part, field = name, ""
    of_part = {
        candidate[len(part) + 1 :]: candidate for candidate in names if part and candidate.startswith(f"{part}.")
    }
    if of_part:
        near = [of_part[candidate] for candidate in difflib.get_close_matches(field, of_part, n=2, cutoff=0.6)]
        listed = list(of_part.values())
        lead = f"{part!r} has"
    else:
        near, listed, lead = _alike(name, names), names, "there are"
    if near:
        return f"; did you mean {' or '.join(map(repr, near))}?"
    shown = ", ".join(map(repr, listed[:12])) + (", …" if len(listed) > 12 else "")
    return f"; {lead} {shown}." if listed else "; there are none."


def _alike(name: str, names: list[str]) -> list[str]:
    """A few known names that contain a word, or are spelled nearly alike."""
    within = [candidate for candidate in names if len(name) > 3 and name.lower() in candidate.lower()]
    return sorted(within, key=len)[:3] or difflib.get_close_matches(name, names, n=2, cutoff=0.5)


def check_arguments(what: str, signature: inspect.Signature, positional: int, names: Iterable[str]) -> None:
    """Raise a `TypeError` that lists the arguments of a function or class, for arguments that it does not take.

    **Arguments:** `what` and `signature`: the name and the signature of the function or class; `positional`: the number
    of arguments by position; `names` of the others.
    """
    parameters = signature.parameters
    kinds = {parameter.kind for parameter in parameters.values()}
    if inspect.Parameter.VAR_KEYWORD not in kinds:
        for name in names:
            if name not in parameters:
                near = difflib.get_close_matches(name, parameters, n=2, cutoff=0.5)
                hint = f"did you mean {' or '.join(map(repr, near))}?" if near else f"it takes {', '.join(parameters)}."
                raise TypeError(f"{what} has no argument {name!r}; {hint}")
    by_place = [name for name, parameter in parameters.items() if parameter.kind is not inspect.Parameter.KEYWORD_ONLY]
    if positional > len(by_place) and inspect.Parameter.VAR_POSITIONAL not in kinds:
        others = [name for name in parameters if name not in by_place]
        by_name = f"; give by name: {', '.join(others)}" if others else ""
        listed = (
            f"{len(by_place)} arguments by position, {', '.join(by_place)}" if by_place else "no argument by position"
        )
        raise TypeError(f"{what} takes {listed}; got {positional}{by_name}.")


def names_arguments(
    function: Callable[_Arguments, _Result], gone: Mapping[str, str] = MappingProxyType({})
) -> Callable[_Arguments, _Result]:
    """A function whose error for an unknown argument names the nearest argument, or all arguments.

    **Arguments:** `gone`: removed arguments by name, each with its replacement.
    """
    signature = inspect.signature(function)
    parameters = signature.parameters
    by_place = sum(parameter.kind is not inspect.Parameter.KEYWORD_ONLY for parameter in parameters.values())

    @functools.wraps(function)
    def checked(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        if len(args) > by_place or not kwargs.keys() <= parameters.keys():
            for name in kwargs.keys() & gone.keys():
                raise TypeError(f"{function.__name__} has no argument {name!r} any more: {gone[name]}.")
            check_arguments(function.__name__, signature, len(args), kwargs)
        return function(*args, **kwargs)

    return checked
