"""Derivatives by the times of a run: its start, its end, and those that states are saved at.

The mesh of a run has no derivatives. Where a time moves, the states that belong to it follow by Taylor's series of the
solution, with coefficients from the field there: its first two terms, so that second derivatives are right as well.
"""

import contextlib
import contextvars
from collections.abc import Iterator
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from ..linalg.arrays import is_traced
from ..solvers import twice_differentiable

_FROZEN = contextvars.ContextVar("frozen", default=False)


@contextlib.contextmanager
def frozen_times() -> Iterator[None]:
    """Nothing is differentiated by the times of runs that begin here, though JAX may trace them."""
    token = _FROZEN.set(True)
    try:
        yield
    finally:
        _FROZEN.reset(token)


def may_move(times: Any) -> bool:
    """Whether some times of a run may have derivatives."""
    return is_traced(times) and not _FROZEN.get()


@eqx.filter_custom_jvp
def at_frozen_start(term: Any, t0: Any, y0: Any) -> Any:
    """The state that a run from a moving `t0` has at the time where it is now."""
    return y0


@at_frozen_start.def_jvp
def _at_frozen_start_jvp(primals, tangents):
    return eqx.filter_jvp(lambda term, t, y: _series(term, t, y, lax.stop_gradient(t) - t), primals, tangents)


@eqx.filter_custom_jvp
def at_moving_times(term: Any, ts: Any, moves: Any, ys: Any) -> Any:
    """Saved states at moving times, from those at the times where they are now; `moves` are zeros with the derivatives
    of the times that move. (Those of events have derivatives with which their states have moved already.)
    """
    return ys


@at_moving_times.def_jvp
def _at_moving_times_jvp(primals, tangents):
    def moved(term, ts, moves, ys):
        finite = jnp.isfinite(ts)
        first = jnp.argmax(finite)
        # Entries after the end of a run have no field.
        inside = jax.tree.map(lambda x: jnp.where(finite.reshape(-1, *[1] * (x.ndim - 1)), x, x[first]), (ts, ys))
        new = jax.vmap(lambda t, y, move: _series(term, lax.stop_gradient(t), y, move))(inside[0], inside[1], moves)
        return jax.tree.map(lambda x, y: jnp.where(finite.reshape(-1, *[1] * (x.ndim - 1)), x, y), new, ys)

    return eqx.filter_jvp(moved, primals, tangents)


def _series(term, t, y, step):
    step = twice_differentiable(step)
    field = lambda t, y: term.vf(t, y, None)
    first, second = jax.jvp(field, (t, y), (jnp.ones_like(t), field(t, y)))
    return jax.tree.map(lambda y, f, g: y + step.astype(y.dtype) * (f + step.astype(y.dtype) / 2 * g), y, first, second)


def saved_times(series: diffrax.SubSaveAt, found: Any, start: Any, end: Any) -> tuple[Any, Any]:
    """The times of a series of saved states with the derivatives of those that were asked for, and the moves of these:
    zeros with their derivatives.

    **Arguments:** `found`: the times without derivatives, but for those of events.
    """
    if series.steps:
        # Only the ends of a run move among its steps.
        asked = jnp.broadcast_to(end, found.shape)
        asked = asked.at[0].set(jnp.where(found[0] == lax.stop_gradient(start), start, end)) if series.t0 else asked
    else:
        asked = ([start[None]] if series.t0 else []) + ([] if series.ts is None else [series.ts])
        asked = jnp.concatenate(asked + ([end[None]] if series.t1 else []))
    frozen = lax.stop_gradient(asked)
    is_asked = found == frozen
    return jnp.where(is_asked, asked, found), jnp.where(is_asked, asked - frozen, 0.0)
