"""Compiled functions whose first calls NumPy computes, while the compiler works in the background."""

import atexit
import collections
import contextlib
import ctypes
import functools
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from .._compat import canonical, current_trace, evaluate_calls_by, is_weakly_typed, typed_as
from .._setup import compiles_later
from ..linalg.arrays import derivatives_of, is_traced
from .source import Interpreted, interpreted
from .translate import Unsupported

# The compiler starts when nothing has run for this time [s], or when a program has run for longer: its first stage,
# lowering, holds up Python.
_REST = 1.0
# How often [s] it looks whether it may start, and whether it has stopped.
_LOOK = 0.05
# So many functions of NumPy are kept, of each compiled function: those that were called last.
_MOST = 64
_NO_TRACE = current_trace()


class _Program:
    """A program that NumPy computes until the compiler has it.

    **Fields:** the structure of its `results`; whether the compiler `has` it; `began`: when a call began that is
    running, None if none is; the `seconds` of all calls before.
    """

    def __init__(self, jaxpr: Any, compile: Callable[[], Any]):
        self.by_numpy: Interpreted = interpreted(jaxpr)
        self._compile, self.results = compile, None
        self.has, self.began, self.seconds, self._is_wanted = False, None, 0.0, False

    def __call__(self, arrays: list[Any]) -> list[Any]:
        # A script that runs a motion once needs no compiler.
        self._want(self.seconds > 0)
        began = self.began = time.monotonic()
        try:
            out = self.by_numpy(arrays)
        finally:
            _background.busy_at = time.monotonic()
            self.began, self.seconds = None, self.seconds + _background.busy_at - began
        self._want(self.seconds > _REST or hasattr(sys, "ps1") or "ipykernel" in sys.modules)
        return [_as_jax(x, kind) for x, kind in zip(out, self.by_numpy.given, strict=True)]

    def _want(self, wanted):
        if wanted and not self._is_wanted:
            self._is_wanted = True
            _background.add(self)

    def compile(self) -> None:
        """Let the compiler make the program, which JAX finds when the function is called."""
        self._compile()
        self.has = True

    def waits(self) -> bool:
        """Whether the compiler should wait."""
        now, began = time.monotonic(), self.began
        running = 0.0 if began is None else now - began
        return self.seconds + running < _REST and (running > 0 or now - _background.busy_at < _REST)


def _as_jax(x, kind):
    return x if kind.dtype == jax.dtypes.float0 else typed_as(kind, jax.device_put(x))


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


class _Programs:
    """The programs of a function, or of several, by keys; None where only the compiler can make one."""

    def __init__(self):
        self._kept: collections.OrderedDict[Any, _Program | None] = collections.OrderedDict()

    def found(self, key: Any, make: Callable[[], _Program]) -> _Program | None:
        """The program that NumPy computes, None if the compiler computes it."""
        if key not in self._kept:
            try:
                self._kept[key] = make()
            except Unsupported:
                self._kept[key] = None
            _background.busy_at = time.monotonic()
            if len(self._kept) > _MOST:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        program = self._kept[key]
        if program is not None and program.has:
            program = self._kept[key] = None
        return program


def _is_chosen() -> bool:
    config: Any = jax.config
    if not compiles_later() or config.jax_disable_jit or config.jax_debug_nans or jax.default_backend() != "cpu":
        return False
    _differentiate_by_numpy()
    return True


class Later:
    """A function compiled by `jax.jit`, whose first calls NumPy computes after `jaxmb.setup(compile="later")`.

    **Arguments:** the `compiled` function, with its last argument static and the others pytrees of arrays.
    """

    def __init__(self, compiled: Any):
        self.compiled, self._programs = compiled, _Programs()

    def __call__(self, *arguments: Any) -> Any:
        return self.way(*arguments)[0](*arguments)

    def way(self, *arguments: Any) -> tuple[Callable[..., Any], bool]:
        """The function to call with these arguments, and whether NumPy computes it."""
        if not _is_chosen():
            return self.compiled, False
        if is_traced(arguments[:-1]):
            # Batches, and calls within `jit`, are for the compiler.
            known = derivatives_of(arguments[:-1]).known
            (_differentiated.add if known else _differentiated.discard)(self.compiled.__name__)
            return self.compiled, False
        if current_trace() != _NO_TRACE:
            return self.compiled, False
        arrays, structure = jax.tree.flatten(arguments[:-1])
        kinds = tuple((np.shape(x), x.dtype, isinstance(x, jax.Array) and is_weakly_typed(x)) for x in arrays)
        key = arguments[-1], structure, kinds, canonical()
        program = self._programs.found(key, lambda: self._program(arguments))
        if program is None:
            return self._at_once, False
        return lambda *arguments: jax.tree.unflatten(program.results, program(jax.tree.leaves(arguments[:-1]))), True

    def _program(self, arguments):
        traced = self.compiled.trace(*arguments)
        program = _Program(traced.jaxpr, lambda: traced.lower().compile())
        program.results = jax.tree.structure(traced.out_info)
        return program

    def _at_once(self, *arguments):
        """What the compiler computes, where JAX may evaluate the call itself."""
        _direct.calls = True
        try:
            return self.compiled(*arguments)
        finally:
            _direct.calls = False


# The names of functions of which derivatives are taken, and the programs that JAX then makes and calls.
_differentiated: set[str] = set()
# Whether a function is called by itself, in each thread.
_direct = threading.local()
_of_derivatives = _Programs()


@functools.cache
def _differentiate_by_numpy() -> None:
    """Let NumPy compute the programs that JAX makes of these functions when it takes a derivative outside of `jit`."""

    def evaluated(evaluate: Callable[[], Any], name: str, jaxpr: Any, arrays: list[Any]) -> Any:
        if name not in _differentiated or getattr(_direct, "calls", False) or not _is_chosen():
            return evaluate()
        # A later call finds the program that `evaluate` has compiled.
        program = _of_derivatives.found(jaxpr, lambda: _Program(jaxpr, evaluate))
        return evaluate() if program is None else program(arrays)

    evaluate_calls_by(evaluated)
