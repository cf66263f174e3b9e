"""Functions among the arguments of a run, identified by their present computation."""

import functools
from typing import Any

import diffrax
import jax

from .._captured import CapturedModule
from .._compat import changed
from .._index_bounds import IndexOutOfBoundsError
from .._traced_functions import is_installed
from .._types import State

# The keyword arguments that diffrax gives a function of an event, and numbers among them.
_OF_EVENTS = ("terms", "solver", "t0", "t1", "dt0", "saveat", "stepsize_controller", "max_steps")
_NUMBERS = ("t0", "t1", "dt0", "max_steps")
# It stands for the terms of a run, whose rates do not change what a function computes from them.
_TERMS = diffrax.ODETerm(lambda t, y, args: y)


def captured_event(event: diffrax.Event | None, t: Any, state: State) -> diffrax.Event | None:
    """An event whose functions are identified by their present computation."""
    if event is None:
        return None
    plain: dict[str, Any] = dict.fromkeys(_OF_EVENTS)
    full = plain | {"terms": _TERMS} | dict.fromkeys(_NUMBERS, jax.ShapeDtypeStruct((), state.q.dtype))
    functions = jax.tree.map(lambda f: captured_call(f, t, state, None, named=(plain, full)), event.cond_fn)
    return changed(event, cond_fn=functions)


def captured_call(function: Any, *args: Any, named: tuple[dict[str, Any], ...] = ({},)) -> Any:
    """A user's function, identified by its present computation; functions of packages and other objects as they are.

    **Arguments:** `args` of the function; `named`: sets of its keyword arguments, of which the first is used with which
    the function can be traced. Without such a set it is another function in each run.
    """
    if not callable(function) or is_installed(getattr(getattr(function, "__code__", None), "co_filename", None)):
        return function
    for keywords in named:
        module = CapturedModule(function)
        try:
            module.trace(*args, **keywords)
        except IndexOutOfBoundsError:
            raise
        except Exception:  # What a function raises for other arguments tells nothing about its calls in a run.
            continue
        module.known.keep()
        return module
    return functools.partial(function)
