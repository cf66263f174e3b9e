"""Functions of the user that JAX traces: a message about the line that needs a number or a name that is not there."""

import contextlib
import functools
import sysconfig
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax

# What JAX raises where a number is asked for that is not known in tracing.
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


@functools.cache
def is_installed(file: str | None) -> bool:
    """Whether a file belongs to an installed package, the standard library or jaxmb, and not to the user."""
    # Code that was never in a file has a name in angle brackets.
    return file is not None and file[0] != "<" and any(place in _PACKAGES for place in Path(file).resolve().parents)


@contextlib.contextmanager
def traced_by_jax(what: str, argument: str) -> Iterator[None]:
    """Where a function of the user is traced.

    **Arguments:** `what` is traced, such as "the function of a sweep", and what it has no number of, such as "a
    parameter".

    **Raises:** `ValueError` that says which line of the user's needs a number, and what to write instead; or which one
    asks a dictionary for a name, and what names are in it.
    """
    try:
        yield
    except KeyError as error:
        if isinstance(error, ValueError):
            # It says more: an unknown name of a system.
            raise
        frames = [own for own, _ in traceback.walk_tb(error.__traceback__) if not is_installed(own.f_code.co_filename)]
        near = frames[-1].f_locals if frames else {}
        there = {name: own for name, own in near.items() if isinstance(own, Mapping)}
        listed = [f"; {name} has {', '.join(map(repr, own)) or 'no names'}" for name, own in there.items()]
        raise ValueError(f"{_line(error)} asks for {error}, which {what} does not get{''.join(listed)}.") from error
    except NEED_NUMBERS as error:
        raise ValueError(
            f"{_line(error)} needs {argument} as a number, and {what} is traced by JAX: there is no `if`, `while`, "
            f"`float()`, `int()`, or function of NumPy or `math` of what depends on {argument}. Use jnp.where or "
            "jax.lax.cond for `if`, jax.lax.while_loop for `while`, and jax.numpy for NumPy and `math`."
        ) from error


def _line(error: Exception) -> str:
    """The last line of the user's on the way to an error."""
    lines = [own for own in traceback.extract_tb(error.__traceback__) if not is_installed(own.filename)]
    return f"{lines[-1].filename}:{lines[-1].lineno}: `{lines[-1].line}`" if lines else "The function"
