"""Functions among the arguments of a run, identified by their present computation."""

import contextlib
from typing import Any

import diffrax
import jax

from .._captured import CapturedModule
from .._compat import changed
from .._traced_functions import is_installed
from .._types import State

# The keyword arguments that diffrax gives a function of an event.
_OF_EVENTS = ("terms", "solver", "t0", "t1", "dt0", "saveat", "stepsize_controller", "max_steps")


def captured_event(event: diffrax.Event | None, t: Any, state: State) -> diffrax.Event | None:
    """An event whose functions are identified by their present computation."""
    if event is None:
        return None
    functions = jax.tree.map(lambda f: captured_call(f, t, state, None, **dict.fromkeys(_OF_EVENTS)), event.cond_fn)
    return changed(event, cond_fn=functions)


def captured_call(function: Any, *args: Any, **named: Any) -> Any:
    """A user's function, identified by its present computation; functions of packages and other objects as they are."""
    if not callable(function) or is_installed(getattr(getattr(function, "__code__", None), "co_filename", None)):
        return function
    module = CapturedModule(function)
    # A function that needs other arguments is identified as a function.
    with contextlib.suppress(Exception):
        module.trace(*args, **named)
    module.known.keep()
    return module
