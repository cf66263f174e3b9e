"""Compiled functions whose first calls NumPy computes, while the compiler works in the background."""

import atexit
import collections
import contextlib
import ctypes
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from .._compat import current_trace, is_weak
from .._setup import compiles_later
from ..linalg.arrays import is_traced
from .source import Interpreted, interpreted
from .translate import Unsupported

# The compiler starts when nothing has run for this time [s], or when a program has run for longer: its first stage,
# lowering, holds up Python.
_REST = 1.0
# How often [s] it looks whether it may start, and whether it has stopped.
_LOOK = 0.05
# So many functions of NumPy are kept, of each compiled function.
_MOST = 64
_NO_TRACE = current_trace()


class _Program:
    """A program that NumPy computes until the compiler has it.

    **Fields:** whether the compiler `has` it; `began`: when a call began that is running, None if none is; the
    `seconds` of all calls before.
    """

    def __init__(self, traced: Any):
        self.by_numpy: Interpreted = interpreted(traced.jaxpr)
        self._traced, self._structure = traced, jax.tree.structure(traced.out_info)
        self.has, self.began, self.seconds, self._is_wanted = False, None, 0.0, False

    def __call__(self, *arguments: Any) -> Any:
        # A script that runs a motion once needs no compiler.
        self._want(self.seconds > 0)
        began = self.began = time.monotonic()
        try:
            out = self.by_numpy(jax.tree.leaves(arguments[:-1]))
        finally:
            _background.busy_at = time.monotonic()
            self.began, self.seconds = None, self.seconds + _background.busy_at - began
        self._want(self.seconds > _REST or hasattr(sys, "ps1") or "ipykernel" in sys.modules)
        return jax.tree.unflatten(self._structure, jax.device_put(out))

    def _want(self, wanted):
        if wanted and not self._is_wanted:
            self._is_wanted = True
            _background.add(self)

    def compile(self) -> None:
        """Let the compiler make the program, which JAX finds when the function is called."""
        self._traced.lower().compile()
        self.has = True

    def waits(self) -> bool:
        """Whether the compiler should wait."""
        now, began = time.monotonic(), self.began
        running = 0.0 if began is None else now - began
        return self.seconds + running < _REST and (running > 0 or now - _background.busy_at < _REST)


class _End(BaseException):
    """The end of the process."""


class _Background:
    """The thread that compiles one program after the other. `busy_at`: when a program was last traced or computed."""

    def __init__(self):
        self.busy_at = 0.0
        self._programs: queue.SimpleQueue[_Program | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def add(self, program: _Program) -> None:
        # A process that was forked is without the thread.
        if self._thread is None or not self._thread.is_alive():
            self._programs, self._thread = queue.SimpleQueue(), threading.Thread(target=self._work, daemon=True)
            self._thread.start()
            atexit.register(self._end, self._thread, self._programs)
        self._programs.put(program)

    def _work(self):
        with contextlib.suppress(_End):
            while True:
                program = self._programs.get()
                if program is None:
                    break
                while program.waits():
                    time.sleep(_LOOK)
                # NumPy goes on computing a program that the compiler fails to make.
                with contextlib.suppress(Exception):
                    program.compile()

    @staticmethod
    def _end(thread, programs):
        """End the thread: up to 3.13, Python aborts if it ends while a thread works in the compiler. XLA cannot be
        interrupted, and all before can.
        """
        programs.put(None)
        while sys.version_info < (3, 14) and thread.is_alive():
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(_End))
            thread.join(_LOOK)


_background = _Background()


class Later:
    """A function compiled by `jax.jit`, whose first calls NumPy computes after `jaxmb.setup(compile="later")`.

    **Arguments:** the `compiled` function, with its last argument static and the others pytrees of arrays.
    """

    def __init__(self, compiled: Any):
        self.compiled = compiled
        self._programs: collections.OrderedDict[Any, _Program | None] = collections.OrderedDict()

    def __call__(self, *arguments: Any) -> Any:
        return self.way(*arguments)(*arguments)

    def way(self, *arguments: Any) -> Callable[..., Any]:
        """The function to call with these arguments: `compiled`, or another that NumPy computes."""
        if not compiles_later() or current_trace() != _NO_TRACE or is_traced(arguments[:-1]):
            return self.compiled
        config: Any = jax.config
        if config.jax_disable_jit or config.jax_debug_nans or jax.default_backend() != "cpu":
            return self.compiled
        arrays, structure = jax.tree.flatten(arguments[:-1])
        key = arguments[-1], structure, tuple((np.shape(x), x.dtype) for x in arrays), config.jax_enable_x64
        if key not in self._programs:
            self._programs[key] = self._translated(arguments)
            if len(self._programs) > _MOST:
                self._programs.popitem(last=False)
        program = self._programs[key]
        if program is not None and program.has:
            program = self._programs[key] = None
        return self.compiled if program is None else program

    def _translated(self, arguments):
        """The program of NumPy; None if only the compiler can make it."""
        try:
            traced = self.compiled.trace(*arguments)
            return None if any(map(is_weak, traced.jaxpr.out_avals)) else _Program(traced)
        except Unsupported:
            return None
        finally:
            _background.busy_at = time.monotonic()
