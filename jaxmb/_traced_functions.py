"""Functions of the user: their errors, and messages about the line that needs a number or an unknown name."""

import ast
import contextlib
import functools
import linecache
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import jax

# The errors that JAX raises if a traced value is needed as a number.
NEED_NUMBERS = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)
_PACKAGES = {
    Path(place).resolve()
    for place in (*(sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")), Path(__file__).parent)
}


# Packages that compute for the user's functions: their errors are about values that these return or pass on.
_COMPUTE = {"jaxmb", "jax", "jaxlib", "numpy", "equinox", "diffrax", "optimistix", "lineax", "jaxtyping"}


@functools.cache
def is_installed(file: str | None) -> bool:
    """Whether a file belongs to an installed package, the standard library or jaxmb, and not to the user."""
    # Code without a file has a name in angle brackets.
    return file is not None and file[0] != "<" and any(place in _PACKAGES for place in Path(file).resolve().parents)


def is_of_jax(module: str | None) -> bool:
    """Whether a module, by its name, belongs to JAX, to packages that compute with it, or to jaxmb."""
    return (module or "").partition(".")[0] in _COMPUTE


@contextlib.contextmanager
def traced_by_jax(what: str, argument: str) -> Iterator[None]:
    """A context in which a function of the user is traced.

    **Arguments:** `what` is traced, such as "the function of a sweep"; `argument`: a value without a number, such as "a
    parameter".

    **Raises:** `ValueError` that names the user's line that needs a number and the cure; or the line that asks a
    dictionary among the function's arguments for a missing name, and the names in it. Other errors pass.
    """
    try:
        yield
    except KeyError as error:
        asked = asked_argument(error)
        if asked is None:
            _add_note(error, what)
            raise
        name, names = asked
        listed = ", ".join(map(repr, names)) or "no names"
        raise ValueError(f"{_line(error)} asks for {error}, which {what} does not get; {name} has {listed}.") from error
    except NEED_NUMBERS as error:
        raise ValueError(
            f"{_line(error)} needs {argument} as a number, and {what} is traced by JAX: values that depend on "
            f"{argument} have no `if`, `while`, `float()`, `int()`, or function of NumPy or `math`. Use jnp.where or "
            "jax.lax.cond for `if`, jax.lax.while_loop for `while`, and jax.numpy for NumPy and `math`."
        ) from error
    except Exception as error:
        _add_note(error, what)
        raise


def _add_note(error, what):
    note = note_of(what)
    if _users_frames(error) and note not in getattr(error, "__notes__", ()):
        error.add_note(note)


def note_of(what: str) -> str:
    """The note for an error of the user, about the place where it was raised."""
    return f"This was raised in {what}."


def _users_frames(error):
    walked = traceback.walk_tb(error.__traceback__)
    return [frame for frame, _ in walked if not is_installed(frame.f_code.co_filename)]


def is_of_user(error: BaseException) -> bool:
    """Whether a line of the user raised an error, by itself or through the standard library or another package. Errors
    of JAX, NumPy and jaxmb do not count, unless they are about a file.
    """
    if isinstance(error, OSError):
        return bool(_users_frames(error))
    for frame, _ in reversed(list(traceback.walk_tb(error.__traceback__))):
        if is_of_jax(frame.f_globals.get("__name__")):
            return False
        if not is_installed(frame.f_code.co_filename):
            return True
    return False


def with_note(function: Callable[..., Any], what: str) -> Callable[..., Any]:
    """A function whose errors have a note if they are the user's; JAX removes its frames from tracebacks later."""

    @functools.wraps(function)
    def noted(*given):
        try:
            return function(*given)
        except Exception as error:
            if is_of_user(error) and not isinstance(error, NEED_NUMBERS):
                _add_note(error, what)
            raise

    return noted


def shown_function(function: Callable[..., Any]) -> str:
    """A function by its name and the place of its definition."""
    code = getattr(function, "__code__", None)
    name = getattr(function, "__qualname__", type(function).__name__)
    return f"The function {name}" + ("" if code is None else f" ({code.co_filename}:{code.co_firstlineno})")


def asked_argument(error: KeyError) -> tuple[str, Mapping[Any, Any]] | None:
    """The argument of the user's function that lacks the name asked for: the argument's own name and its dictionary.

    None for another dictionary, which is the user's, and for an `UnknownNameError`.
    """
    walked = list(traceback.walk_tb(error.__traceback__))
    frames = _users_frames(error)
    if isinstance(error, ValueError) or not frames or frames[-1] is not walked[-1][0]:
        return None
    given, last = _arguments(frames[0]), frames[-1]
    candidates = {
        name: mapping for name, mapping in last.f_locals.items() if any(mapping is argument for argument in given)
    }
    subscripted = _subscripted(traceback.extract_tb(error.__traceback__)[-1])
    if subscripted is not None:
        candidates = {name: mapping for name, mapping in candidates.items() if name == subscripted}
    missed = ((name, mapping) for name, mapping in candidates.items() if error.args and error.args[0] not in mapping)
    return next(missed, None)


def _arguments(frame: FrameType) -> list[Mapping[Any, Any]]:
    """The dictionaries among the arguments of a call."""
    code = frame.f_code
    names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    return [argument for name in names if isinstance(argument := frame.f_locals.get(name), Mapping)]


def _subscripted(place: traceback.FrameSummary) -> str | None:
    """The expression in front of the brackets where an error was raised, `"p"` of `p["mass"]`; None without a source
    file, and for anything else.
    """
    if place.lineno is None or place.colno is None or place.lineno != place.end_lineno:
        return None
    line = linecache.getline(place.filename, place.lineno).encode()
    try:
        parsed = ast.parse(line[place.colno : place.end_colno].decode(), mode="eval").body
    except (SyntaxError, UnicodeDecodeError):
        return None
    return ast.unparse(parsed.value) if isinstance(parsed, ast.Subscript) else None


def _line(error: Exception) -> str:
    """The last line of the user on the way to an error."""
    lines = [frame for frame in traceback.extract_tb(error.__traceback__) if not is_installed(frame.filename)]
    return f"{lines[-1].filename}:{lines[-1].lineno}: `{lines[-1].line}`" if lines else "The function"
