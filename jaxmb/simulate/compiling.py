"""Messages to the user while a first call compiles."""

import contextlib
import functools
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import jax

from .._setup import compiles_later
from ..system import AbstractSystem

# The time [s] after which a user is told.
_PATIENCE = 2.0
# The event that JAX reports at the end of a compilation; compilations shorter than `_LONG` [s] are single operations.
_COMPILED, _LONG = "/jax/core/compile/backend_compile_duration", 0.5


class _Wait:
    """A wait for a program.

    **Fields:** `began`: when tracing began; `ended`: when compilation ended, None before; `told`: whether the user was
    told.
    """

    def __init__(self, system: AbstractSystem):
        self.system = system
        self.began: float = 0.0
        self.ended: float | None = None
        self.told = False
        self.timer = threading.Timer(_PATIENCE, self._tell)
        self.timer.daemon = True

    def begin(self) -> None:
        self.began = time.monotonic()
        self.timer.start()

    def _tell(self):
        # If compilation has ended, the program itself takes that long.
        if self.ended is None:
            self.told = True
            print(f"jaxmb: compiling {_motion_of(self.system)} ...", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        self.timer.cancel()
        if self.told:
            now = time.monotonic()
            ended = now if self.ended is None else self.ended
            way = "" if compiles_later() else '; setup(compile="later") does not wait'
            took = f"{ended - self.began:.1f} s; a later call takes {_in_words(now - ended)}"
            print(f" {took}{way}", file=sys.stderr)


# The wait of each thread.
_waiting = threading.local()


@contextlib.contextmanager
def told_of_compiling(system: AbstractSystem) -> Iterator[None]:
    """A context for a simulation that may have to compile: a user at a terminal or in a notebook is told after a while.

    The program must run to its end within the context.
    """
    if not (sys.stderr.isatty() or "ipykernel" in sys.modules) or getattr(_waiting, "now", None) is not None:
        yield
        return
    _listen()
    _waiting.now = _Wait(system)
    try:
        yield
    finally:
        _waiting.now.end()
        _waiting.now = None


def tracing_begins() -> None:
    """To be called at the start of tracing, which precedes compilation."""
    wait = getattr(_waiting, "now", None)
    if wait is not None and not wait.began:
        wait.begin()


def nothing_compiles() -> None:
    """To be called where NumPy computes what was traced."""
    wait = getattr(_waiting, "now", None)
    if wait is not None and wait.ended is None:
        wait.ended = time.monotonic()


@functools.cache
def _listen() -> None:
    jax.monitoring.register_event_duration_secs_listener(_compiled)


def _compiled(event: str, duration_secs: float, **_: Any) -> None:
    wait = getattr(_waiting, "now", None)
    if wait is not None and event == _COMPILED and duration_secs > _LONG:
        wait.ended = time.monotonic()


def _motion_of(system: AbstractSystem) -> str:
    names = system.body_names or tuple(system.catalogue.motion_names())
    rest_of_names = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"a motion of {', '.join(names[:3])}{rest_of_names}"


def _in_words(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds >= 1 else f"{1000 * seconds:.1f} ms"
