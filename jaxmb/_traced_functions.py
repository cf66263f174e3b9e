"""Functions of the user that JAX traces: a message about the line that needs a number where there is none."""

import contextlib
import functools
import sysconfig
import traceback
from collections.abc import Iterator
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

    **Raises:** `ValueError` that says which line of the user's needs a number, and what to write instead.
    """
    try:
        yield
    except NEED_NUMBERS as error:
        lines = [own for own in traceback.extract_tb(error.__traceback__) if not is_installed(own.filename)]
        where = f"{lines[-1].filename}:{lines[-1].lineno}: `{lines[-1].line}`" if lines else "The function"
        raise ValueError(
            f"{where} needs {argument} as a number, and {what} is traced by JAX: there is no `if`, `while`, `float()`, "
            f"`int()`, or function of NumPy or `math` of what depends on {argument}. Use jnp.where or jax.lax.cond for "
            "`if`, jax.lax.while_loop for `while`, and jax.numpy for NumPy and `math`."
        ) from error
