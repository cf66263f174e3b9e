"""The saved states of a run: their times, their return to the constraints, and the user's function of them."""

import functools
import math
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._arguments import real_array
from .._compat import changed
from .._types import State
from ..linalg.arrays import is_traced
from ..linalg.members import vmap_states
from ..manifold.impulse import after_jumps
from ..system import AbstractSystem
from .captured import captured_call
from .span import Span, at_moving_times

# The least number of saved times of a program; others are powers of 2.
_FEWEST_TIMES = 4

# The state at the end, alone and after the user's series: for statistics and diagnosis.
_AT_END = diffrax.SubSaveAt(t1=True)
_END = diffrax.SaveAt(subs=_AT_END)
_ENDS = diffrax.SaveAt(subs=(_AT_END, _AT_END), solver_state=True, controller_state=True)
# The function of diffrax that saves states unchanged.
STATES = _AT_END.fn


def checked_saveat(saveat: Any, start: Any, end: Any) -> diffrax.SaveAt:
    if saveat is None:
        return _END
    if isinstance(saveat, diffrax.SaveAt):
        if not isinstance(saveat.subs, diffrax.SubSaveAt) and saveat.subs is not None:
            raise ValueError("simulate saves one series; use SaveAt without subs, or diffrax.diffeqsolve directly.")
        for name in ("solver_state", "controller_state", "made_jump"):
            if getattr(saveat, name):
                raise ValueError(f"simulate does not return what SaveAt({name}=True) saves; leave it out.")
        if saveat.subs is not None and saveat.subs.ts is not None:
            times = _check_saved_times(saveat.subs.ts, start, end)
            return changed(saveat, subs=changed(saveat.subs, ts=times))
        return saveat
    times = _check_saved_times(saveat, start, end)
    return changed(_END, subs=changed(_AT_END, t1=False, ts=times))


def _check_saved_times(times: Any, start: Any, end: Any) -> Any:
    ts = real_array("saveat", times, jnp.result_type(float), None)
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(
            f"saveat must be a vector of times or a diffrax.SaveAt, got shape {ts.shape}; for 11 equally spaced states "
            "saveat=numpy.linspace(t0, t1, 11)."
        )
    if is_traced((ts, start, end)):
        return ts
    if not (min(start, end) <= ts.min() and ts.max() <= max(start, end)):
        raise ValueError(
            f"saveat must lie between t0 = {start:g} and t1 = {end:g}, got times from {ts.min():g} to {ts.max():g}."
        )
    if np.any(np.diff(ts) * (1 if start <= end else -1) < 0):
        raise ValueError(f"saveat must run from t0 to t1 without turning back, got {ts}.")
    return ts


def with_end(saveat: diffrax.SaveAt, t: Any, state: State) -> diffrax.SaveAt:
    """The user's series, and the state at the end."""
    if saveat is _END:
        return _ENDS
    first = _AT_END if saveat.subs is None else saveat.subs
    return changed(
        _ENDS, subs=(changed(first, fn=captured_call(first.fn, t, state, None)), _AT_END), dense=saveat.dense
    )


def padded(saveat: diffrax.SaveAt, start: Any, end: Any) -> diffrax.SaveAt:
    """The same with times beyond the end added, which are not saved: one program serves several numbers of times."""
    first, last = saveat.subs
    if first.ts is None or first.ts.shape[0] == 0 or start == end:
        # In an empty interval every time would be saved.
        return saveat
    missing = max(_FEWEST_TIMES, 2 ** math.ceil(math.log2(first.ts.shape[0]))) - first.ts.shape[0]
    never = np.full(missing, np.inf if end > start else -np.inf, first.ts.dtype)
    times = np.concatenate([np.asarray(first.ts), never])
    return changed(saveat, subs=(changed(first, ts=times), last))


class SavedTimes(NamedTuple):
    """The user's series of saved states in the program of a run.

    **Fields:** the `series`, whose times have derivatives; its `times` without derivatives, None if it has no times;
    `after`: the same, moved behind jumps; `outside`: whether times lie outside of the run, or turn back.
    """

    series: diffrax.SubSaveAt
    times: Any
    after: Any
    outside: Any

    @classmethod
    def of(cls, series: diffrax.SubSaveAt, t0: Any, t1: Any, traced: bool) -> "SavedTimes":
        """The times clipped to the ends of a run, unless that was checked before."""
        asked: Any = series.ts
        outside: Any = False
        times = lax.stop_gradient(asked)
        if traced and asked is not None:
            ends = jnp.sort(jnp.stack([t0, t1]))
            inside = jnp.clip(times, *ends)
            # A time that is computed like t1 may differ from it by rounding errors.
            rounding = 8 * jnp.finfo(ends.dtype).eps * jnp.max(jnp.abs(ends))
            ordered = jnp.all(jnp.where(t0 <= t1, 1, -1) * jnp.diff(times) >= 0)
            outside, times = ~(jnp.all(jnp.abs(inside - times) <= rounding) & ordered), inside
            # Restore the derivatives of times at the ends, which clipping removes.
            series = changed(series, ts=times + asked - lax.stop_gradient(asked))
        return cls(series, times, times, outside)

    def behind_jumps(self, jumps: Any, t0: Any, t1: Any) -> "SavedTimes":
        """The times for which states saved at a jump are the states after it, also in a run backward."""
        if jumps is None or self.times is None:
            return self
        return self._replace(after=after_jumps(self.times, jumps, t0, t1))

    def told(self, saveat: diffrax.SaveAt, t0: Any, finite: Any, function: Any) -> diffrax.SaveAt:
        """The `SaveAt` for the solver, with a `function` of states; all times are `t0` if the start is not `finite`."""
        times = None if self.after is None else jnp.where(finite, self.after, t0)
        first, *rest = saveat.subs
        return changed(saveat, subs=(changed(first, ts=times, fn=function), *rest))

    def restored(self, ts: Any, start: Any, finite: Any, begins: Any) -> Any:
        """The requested times, from the times at which states were saved.

        **Arguments:** `start`: the time at the start if a run may begin just before it, else None; `finite`: whether
        the run started from finite numbers; `begins`: whether the series begins here.
        """
        if start is not None and self.series.t0:
            ts = ts.at[0].set(jnp.where(begins, lax.stop_gradient(start), ts[0]))
        if self.times is not None:
            ts = jnp.where(finite, ts, jnp.inf)
        return ts if self.after is self.times else _replaced(ts, self.after, self.times)


def moved(series: diffrax.SubSaveAt, term: Any, span: Span, y0: State, ts: Any, ys: Any) -> tuple[Any, Any]:
    """Saved times and states with the derivatives of moving times; `y0`: the state at a moving start."""
    if not any(span.moving):
        return ts, ys
    ts, moves = _moving_times(series, ts, span)
    if span.moving[1]:
        ys = at_moving_times(term, ts, moves, ys)
    if span.moving[0] and series.t0:
        ys = jax.tree.map(lambda x, y: x.at[0].set(y), ys, y0)
    return ts, ys


def _moving_times(series, saved, span):
    """The times of a series of saved states with the derivatives of the requested times, and their moves: zeros with
    these derivatives.

    **Arguments:** `saved`: the times without derivatives, except for times of events.
    """
    start, end = span.t0, span.t1
    if series.steps:
        # Among the ends of steps, only the ends of the run move.
        asked = jnp.broadcast_to(end, saved.shape)
        asked = asked.at[0].set(jnp.where(saved[0] == lax.stop_gradient(start), start, end)) if series.t0 else asked
    else:
        asked = ([start[None]] if series.t0 else []) + ([] if series.ts is None else [series.ts])
        asked = jnp.concatenate(asked + ([end[None]] if series.t1 else []))
    frozen = lax.stop_gradient(asked)
    is_asked = saved == frozen
    return jnp.where(is_asked, asked, saved), jnp.where(is_asked, asked - frozen, 0.0)


def seen(function: Any, ts: Any, ys: Any, start: tuple[Any, State]) -> Any:
    """The values of a user's function of saved states. After the end of a run, where states are infinite, values are
    infinite (integers zero) and have no derivatives.
    """
    never = lambda x: jnp.inf if jnp.issubdtype(x.dtype, jnp.inexact) else 0

    def saved(t, y, finite):
        t, y = jax.tree.map(lambda x, x0: jnp.where(finite, x, x0), (t, y), start)
        values = jax.tree.map(jnp.asarray, function(t, y, None))
        return jax.tree.map(lambda x: jnp.where(finite, x, jnp.asarray(never(x), x.dtype)), values)

    return jax.vmap(saved)(ts, ys, jnp.isfinite(ts))


def corrected(correction: Any, system: AbstractSystem, ts: Any, ys: Any, start: tuple[Any, State]) -> tuple[Any, Any]:
    """Saved states, returned to the constraints, and whether this failed; entries after the end of a run stay."""
    finite = jnp.isfinite(ts)
    # Elsewhere the start is corrected instead, which has no failure and no derivative.
    at_start, y0 = lax.stop_gradient(start)
    inside = jax.tree.map(lambda y, y0: jnp.where(finite[:, None], y, y0[None]), ys, y0)
    every = vmap_states(lambda t, y: correction(system, t, y), system.coordinate_rows * system.nq)
    returned = every(jnp.where(finite, ts, at_start), inside)
    is_known = lambda y: functools.reduce(
        jnp.logical_and, [jnp.all(jnp.isfinite(x), axis=1) for x in jax.tree.leaves(y)]
    )
    lost = jnp.any(is_known(inside) & ~is_known(returned))
    return jax.tree.map(lambda new, old: jnp.where(finite[:, None], new, old), returned, ys), lost


def _replaced(values, old, new):
    """The values with `old` times, which ascend or descend, replaced by `new` times."""
    order = jnp.argsort(old)
    k = order[jnp.clip(jnp.searchsorted(old[order], values), 0, old.size - 1)]
    return jnp.where(values == old[k], new[k], values)
