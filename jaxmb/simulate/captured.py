"""Functions among the arguments of a run, told apart by what they compute now."""

import contextlib
from typing import Any

import diffrax
import jax

from .._captured import CapturedModule
from .._compat import changed
from .._traced_functions import is_installed
from .._types import State

# What diffrax gives a function of an event besides the time, the state and the arguments.
_OF_EVENTS = ("terms", "solver", "t0", "t1", "dt0", "saveat", "stepsize_controller", "max_steps")


def captured_event(event: diffrax.Event | None, t: Any, state: State) -> diffrax.Event | None:
    """An event whose functions are told apart by what they compute now."""
    if event is None:
        return None
    functions = jax.tree.map(lambda f: captured_call(f, t, state, None, **dict.fromkeys(_OF_EVENTS)), event.cond_fn)
    return changed(event, cond_fn=functions)


def captured_call(function: Any, *args: Any, **named: Any) -> Any:
    """A function of the user's, told apart from others by what it computes now of such arguments; anything else, and a
    function of a package, as it is.
    """
    if not callable(function) or is_installed(getattr(getattr(function, "__code__", None), "co_filename", None)):
        return function
    module = CapturedModule(function)
    # One that needs other arguments is told apart as a function.
    with contextlib.suppress(Exception):
        module.trace(*args, **named)
    module.known.keep()
    return module
