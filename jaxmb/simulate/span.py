"""The interval of a run, and derivatives by its times: its start, its end, and the saved times.

The mesh of a run has no derivatives. The states at a moving time follow by Taylor's series of the solution, with
coefficients from the field there. The series has two terms, so that second derivatives are right as well.
"""

import contextlib
import contextvars
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._arguments import real_array
from ..linalg.arrays import is_traced
from ..solvers.directed import next_number
from ..solvers.times import twice_differentiable

_FROZEN = contextvars.ContextVar("frozen", default=False)


class Span(NamedTuple):
    """The interval of a run.

    **Fields:** `dt0`: the first step, None for the default; `moving`: whether derivatives may be taken by the start,
    and by the end or a saved time.
    """

    t0: Any
    t1: Any
    dt0: Any
    moving: tuple[bool, bool]

    @classmethod
    def checked(cls, t0: Any, t1: Any, dt0: Any, saved: Any, dtype: Any) -> "Span":
        """**Arguments:** `saved`: as the user gave it, since a trace also traces the times of a new `SaveAt`."""
        start, end = real_array("t0", t0, dtype), real_array("t1", t1, dtype)
        for name, time in (("t0", start), ("t1", end)):
            if not is_traced(time) and not np.isfinite(time):
                raise ValueError(f"{name} must be finite, got {time}.")
        moving = may_move(start), may_move((end, saved))
        if dt0 is None:
            return cls(start, end, None, moving)
        step = real_array("dt0", dt0, dtype)
        if not is_traced((start, end, step)) and not (np.isfinite(step) and step * (1 if end >= start else -1) > 0):
            raise ValueError(
                f"dt0 must be a finite step from t0 = {t0} towards t1 = {t1}, got {dt0}; leave it out for the default."
            )
        return cls(start, end, step, moving)

    def is_backward(self) -> bool:
        """Whether the run is known to go back in time."""
        return not is_traced((self.t0, self.t1)) and self.t1 < self.t0

    def frozen(self, finite: Any) -> "Span":
        """The same without derivatives; an empty interval if the start has no `finite` numbers."""
        t0, t1, dt0 = lax.stop_gradient((self.t0, self.t1, self.dt0))
        return Span(t0, jnp.where(finite, t1, t0), dt0, (False, False))

    def before_jump(self, jumps: Any) -> "Span":
        """The same, but a run backward starts before a jump at its start."""
        if jumps is None:
            return self
        before = jnp.isin(self.t0, jumps) & (self.t1 < self.t0)
        return self._replace(t0=jnp.where(before, next_number(self.t0, -1), self.t0))


@contextlib.contextmanager
def frozen_times() -> Iterator[None]:
    """A context in which runs have no derivatives by their times, though JAX may trace these."""
    token = _FROZEN.set(True)
    try:
        yield
    finally:
        _FROZEN.reset(token)


def may_move(times: Any) -> bool:
    """Whether times of a run may have derivatives."""
    return is_traced(times) and not _FROZEN.get()


@eqx.filter_custom_jvp
def at_frozen_start(term: Any, t0: Any, y0: Any) -> Any:
    """The state of a run from a moving `t0`, at the present value of that time."""
    return y0


@at_frozen_start.def_jvp
def _at_frozen_start_jvp(primals, tangents):
    return eqx.filter_jvp(lambda term, t, y: _series(term, t, y, lax.stop_gradient(t) - t), primals, tangents)


@eqx.filter_custom_jvp
def at_moving_times(term: Any, ts: Any, moves: Any, ys: Any) -> Any:
    """Saved states at moving times, from the states at the present values of these times.

    **Arguments:** `moves`: zeros with the derivatives of the moving times. (The states of events have moved already
    with the derivatives of their times.)
    """
    return ys


@at_moving_times.def_jvp
def _at_moving_times_jvp(primals, tangents):
    def moved(term, ts, moves, ys):
        finite = jnp.isfinite(ts)
        first = jnp.argmax(finite)
        # The field does not exist at entries after the end of a run.
        inside = jax.tree.map(lambda x: jnp.where(finite.reshape(-1, *[1] * (x.ndim - 1)), x, x[first]), (ts, ys))
        new = jax.vmap(lambda t, y, move: _series(term, lax.stop_gradient(t), y, move))(inside[0], inside[1], moves)
        return jax.tree.map(lambda x, y: jnp.where(finite.reshape(-1, *[1] * (x.ndim - 1)), x, y), new, ys)

    return eqx.filter_jvp(moved, primals, tangents)


def _series(term, t, y, step):
    step = twice_differentiable(step)
    field = lambda t, y: term.vf(t, y, None)
    first, second = jax.jvp(field, (t, y), (jnp.ones_like(t), field(t, y)))
    return jax.tree.map(lambda y, f, g: y + step.astype(y.dtype) * (f + step.astype(y.dtype) / 2 * g), y, first, second)
