"""The integration of any term by any solver of diffrax's protocol, step by step.

A step that would end within a hundred rounding errors of the end of the run ends there. A run that fails has no event.
The time of an event is searched only in members of a batch that have an event, so a failed member does not stop the
others.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, get_origin

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import PyTree

from .._compat import any_of_batch, buffer_set, changed, while_loop, with_loops
from .controller import intended_step
from .directed import directed, undirected
from .evaluation import gaps_of
from .events import map_error
from .gaps import hidden
from .headings import turns_over
from .order import refuse
from .turning import Counted, Turning
from .wrapped import with_tolerances

_RESULTS = diffrax.RESULTS
# A step that would end within this many rounding errors of the end of the run ends there.
_LAST = 100
# The function of a series that saves states unchanged.
_STATES = diffrax.SubSaveAt(t1=True).fn
_NO_METER = diffrax.NoProgressMeter()


class Series(eqx.Module):
    """A series of saved states, in tables as long as it may get.

    **Fields:** the times `ts` in the solver's time, and the states `ys`; the `count` of entries; how many of its times
    are `passed`.
    """

    ts: Any
    ys: PyTree
    count: Any
    passed: Any


class Dense(eqx.Module):
    """The dense output of all steps: their ends `ts` after the start, the data `infos`, and their `count`."""

    ts: Any
    infos: PyTree
    count: Any


class EventNear(eqx.Module):
    """The last step, in which an event may lie.

    **Fields:** its start and its end; the data `info` of its interpolant; the `values` of the event's functions at its
    end; the `mask`: which event happened.
    """

    start: Any
    end: Any
    info: PyTree
    values: PyTree
    mask: PyTree


class Progress(eqx.Module):
    """An integration between two steps, in the solver's time, which increases.

    **Fields:** `tprev`: the end of the last accepted step; `tnext`: the end of the next attempted step; `y` at `tprev`;
    whether there was a jump (`made_jump`); the states of solver, controller and progress meter; the `result` so far;
    numbers of steps; the series `saved`; `dense` output, None without; `near`: where an event may lie, None without
    events; `turning`: the count of full turns, None without.
    """

    tprev: Any
    tnext: Any
    y: PyTree
    made_jump: Any
    solver_state: PyTree
    controller_state: PyTree
    meter_state: PyTree
    result: Any
    num_steps: Any
    num_accepted_steps: Any
    num_rejected_steps: Any
    saved: tuple[Series, ...]
    dense: Dense | None
    near: EventNear | None
    turning: Turning | None


class Carry(eqx.Module):
    """What a call of a program keeps for the next call, which goes on with the same integration.

    **Fields:** `fresh`: whether there was no call before, so that the rest has no meaning; `begins`: whether series of
    saved states begin with the next call; the `progress` without tables; for each series how many times are `passed`,
    and how many states are `written` without the state at the end.
    """

    fresh: Any
    begins: Any
    progress: Progress
    passed: tuple[Any, ...]
    written: tuple[Any, ...]

    @classmethod
    def of(cls, progress: Progress) -> "Carry":
        # Only a run without failures goes on.
        bare = changed(progress, saved=(), dense=None, result=None, made_jump=jnp.asarray(progress.made_jump))
        no = jnp.array(False)
        of_series = lambda name: tuple(getattr(series, name) for series in progress.saved)
        carry = cls(no, no, bare, of_series("passed"), of_series("count"))
        return jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(x)), carry)

    def resumed(self, solve: "Integration", first: Progress, constants: dict[str, Any]) -> Progress:
        """The start of the next call.

        **Arguments:** `first`: the start of the integration; `constants`: its fields that are constant.
        """
        never = solve.direction * jnp.asarray(jnp.inf, first.tprev.dtype)
        fresh, begins, before = self.fresh, self.begins, self.progress
        # `select` is one instruction, and `where` is a function.
        again = lambda new, old: lax.select(fresh, jnp.asarray(new, old.dtype), old)
        since = lambda new, old: lax.select(begins, new, jnp.full_like(new, old))
        bare = changed(first, saved=(), dense=None, result=None, made_jump=jnp.asarray(first.made_jump))
        state = jax.tree.map(again, bare, before)
        # At the end of an interval no further step was planned.
        intended = intended_step(before.controller_state)
        ahead = first.tnext - first.tprev if intended is None else intended
        tnext = jnp.where(state.tnext > state.tprev, state.tnext, state.tprev + ahead)
        tnext = jnp.minimum(tnext, solve.t1)
        saved = tuple(
            Series(
                since(series.ts, never),
                jax.tree.map(lambda x: since(x, jnp.inf), series.ys),
                since(jnp.asarray(series.count, passed.dtype), 0),
                since(jnp.asarray(series.passed, passed.dtype), passed),
            )
            for series, passed in zip(first.saved, self.passed, strict=True)
        )
        dense = first.dense
        if dense is not None:
            dense = changed(dense, ts=dense.ts.at[0].set(state.tprev))
        given = {"result": first.result} | constants
        return changed(state, tnext=tnext, saved=saved, dense=dense, **given)


class Along(NamedTuple):
    """What an integration looks at along its steps, in the user's time.

    **Fields:** whether no step passes over a force that acts in one of the term's `gaps`; `headings(t, y)`, vectors
    that must not vanish, None for none; `angles(t, y)`, angles up to full turns and their rates, which are counted from
    the angles `counted`, None for none.
    """

    gaps: bool = False
    headings: Callable[..., Any] | None = None
    angles: Callable[..., Any] | None = None
    counted: Any = None


class Integration(NamedTuple):
    """What an integration does, in the solver's time; made by `begun`.

    **Fields:** as the arguments of `diffrax.diffeqsolve`; `max_steps`: the number of steps for which there are tables;
    the `direction` of the user's time; what is looked at `along` the steps.
    """

    terms: PyTree
    args: PyTree
    solver: Any
    stepsize_controller: Any
    event: diffrax.Event | None
    saveat: diffrax.SaveAt
    t0: Any
    t1: Any
    dt0: Any
    max_steps: int
    progress_meter: Any
    direction: Any
    along: Along

    @property
    def subs(self) -> list[diffrax.SubSaveAt]:
        """What each series saves."""
        return jax.tree.leaves(self.saveat.subs, is_leaf=_is_sub)

    def on_series(self, function: Callable[..., Any], saved: tuple[Series, ...]) -> tuple[Series, ...]:
        """Apply a function of `(sub, series)` to each series of saved states."""
        return tuple(function(sub, series) for sub, series in zip(self.subs, saved, strict=True))

    def guard(self, function: Callable[..., Any], t: Any, y: PyTree) -> Any:
        """The value of a function of the event, which sees the user's time and terms."""
        given = {name: getattr(self, name) for name in ("solver", "saveat", "stepsize_controller", "max_steps")}
        in_time = lambda t: None if t is None else t * self.direction
        times = {name: in_time(getattr(self, name)) for name in ("t0", "t1", "dt0")}
        return function(in_time(t), y, self.args, terms=undirected(self.terms), **given, **times)

    def first(self, y0: PyTree, made_jump: Any) -> Progress:
        """The start of the integration."""
        controller, solver = self.stepsize_controller, self.solver
        tnext, controller_state = controller.init(
            self.terms, self.t0, self.t1, y0, self.dt0, self.args, solver.func, solver.error_order(self.terms)
        )
        tnext = jnp.minimum(tnext, self.t1)
        solver_state = solver.init(self.terms, self.t0, tnext, y0, self.args)
        info = None
        if self.saveat.dense or self.event is not None:
            step = self.terms, self.t0, tnext, y0, self.args, solver_state, made_jump
            info = eqx.filter_eval_shape(solver.step, *step)[2]
        dense, near, result = None, None, _RESULTS.successful
        if self.saveat.dense:
            tables = jax.tree.map(lambda x: jnp.full((self.max_steps, *x.shape), jnp.inf, x.dtype), info)
            ts = jnp.full(self.max_steps + 1, jnp.inf, self.t0.dtype)
            dense = Dense(ts.at[0].set(self.t0), tables, 0)
        if self.event is not None:
            info = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), info)
            values = jax.tree.map(lambda guard: self.guard(guard, self.t0, y0), self.event.cond_fn, is_leaf=callable)
            mask, happened = _first_of(jax.tree.map(_holds, values))
            near, result = (
                EventNear(self.t0, self.t0, info, values, mask),
                _RESULTS.where(happened, _RESULTS.event_occurred, result),
            )
        turning = None if self.along.angles is None else Turning.of(self.t0, self.along.counted)
        saved = tuple(self._tables(sub, y0, turning) for sub in self.subs)
        start = (self.t0, tnext, y0, made_jump, solver_state, controller_state, self.progress_meter.init())
        first = Progress(*start, result, 0, 0, 0, saved, dense, near, turning)
        at_start = lambda sub, saved: _saved(self, sub, saved, first, self.t0, y0) if sub.t0 else saved
        return changed(first, saved=self.on_series(at_start, saved))

    def _tables(self, sub: diffrax.SubSaveAt, y0: PyTree, turning: Turning | None) -> Series:
        every, rows = sub.steps, self.max_steps
        size = int(sub.t0) + (0 if sub.ts is None else len(sub.ts)) + (rows // every if every else 0)
        size += int(sub.t1 and (every == 0 or rows % every != 0))
        shapes = eqx.filter_eval_shape(lambda: _seen(self, sub, turning, self.t0, y0))
        # Entries that are never written are infinite.
        ys = jax.tree.map(lambda x: jnp.full((size, *x.shape), jnp.inf, x.dtype), shapes)
        return Series(self.direction * jnp.full(size, jnp.inf, self.t0.dtype), ys, 0, 0)


_NOTHING = Along()


def begun(
    terms: PyTree,
    solver: Any,
    *,
    t0: Any,
    t1: Any,
    dt0: Any,
    y0: PyTree,
    args: PyTree = None,
    saveat: diffrax.SaveAt,
    stepsize_controller: Any,
    event: diffrax.Event | None = None,
    max_steps: int,
    progress_meter: Any = _NO_METER,
    made_jump: Any = False,
    along: Along = _NOTHING,
) -> tuple[Integration, Progress]:
    """An integration and its start.

    **Arguments:** as of `diffrax.diffeqsolve`, checked, with floating-point times of one type.
    """
    _check_terms(terms, solver)
    direction = jnp.where(t0 < t1, 1, -1)
    directed_time = lambda t: None if t is None else t * direction
    has_times = lambda saveat: [x.ts for x in jax.tree.leaves(saveat.subs, is_leaf=_is_sub) if x.ts is not None]
    saveat = eqx.tree_at(has_times, saveat, replace_fn=directed_time)
    controller = stepsize_controller.wrap(direction)
    solver = with_loops(with_tolerances(solver, controller), "lax")
    integration = Integration(
        terms=directed(terms, direction),
        args=args,
        solver=solver,
        stepsize_controller=controller,
        event=event,
        saveat=saveat,
        t0=directed_time(t0),
        t1=directed_time(t1),
        dt0=directed_time(dt0),
        max_steps=max_steps,
        progress_meter=progress_meter,
        direction=direction,
        along=along,
    )
    return integration, integration.first(y0, made_jump)


def _check_terms(terms: PyTree, solver: Any) -> None:
    """Raise a `ValueError` unless the solver takes such terms."""
    is_term = lambda x: isinstance(x, diffrax.AbstractTerm)
    fits = lambda kind, term: isinstance(term, get_origin(kind) or kind)
    try:
        suits = jax.tree.all(jax.tree.map(fits, solver.term_structure, terms, is_leaf=is_term))
    except ValueError:
        suits = False
    if not suits:
        while isinstance(solver, diffrax.AbstractWrappedSolver):
            solver = solver.solver
        raise ValueError(
            f"{type(solver).__name__} integrates terms of the form {solver.term_structure}, got "
            f"{jax.tree.map(lambda x: type(x).__name__, terms, is_leaf=is_term)}."
        )


def loop(solve: Integration, first: Progress, limit: Any, carry: Carry | None = None) -> tuple[Progress, Carry | None]:
    """The end of an integration after at most `limit` steps, and what the next call needs with a `carry` of the last.

    With a carry, the series of saved states have the states since the last call.
    """
    constants = constant_fields(solve, first)
    if carry is not None:
        first = carry.resumed(solve, first, constants)

    def outer(proceed, advance, init, buffers):
        going = lambda state: proceed(state) & (state.num_steps < limit)
        return while_loop(going, advance, init, max_steps=None, buffers=buffers, kind="lax")

    last = stepped(solve, first, constants, outer)
    return ended(solve, last, constants), None if carry is None else Carry.of(last)


def constant_fields(solve: Integration, state: Progress) -> dict[str, Any]:
    """The fields of the state that are the same constants in all steps, by name: for example, that nothing fails and
    that there are no jumps. The compiler then knows them.
    """
    constants = _concrete_fields(state)
    while True:
        # A constant that turns out to vary may make others vary.
        fields_after = lambda state, constants=constants: _concrete_fields(
            _advanced(solve, changed(state, **constants))
        )
        shapes = eqx.filter_eval_shape(fields_after, state)
        same = {name: value for name, value in constants.items() if name in shapes and shapes[name] == value}
        if len(same) == len(constants):
            return constants
        constants = same


def stepped(solve: Integration, first: Progress, constants: dict[str, Any], outer: Callable[..., Any]) -> Progress:
    """The state after the last step, by the loop `outer(proceed, advance, first, buffers)`, with the constants of
    `constant_fields`.
    """
    proceed = lambda state: _proceeds(solve, changed(state, **constants))
    advance = lambda state: _advanced(solve, changed(state, **constants))
    return outer(proceed, advance, first, _buffers)


def ended(solve: Integration, last: Progress, constants: dict[str, Any]) -> Progress:
    """The last state with its result, the end of the run among the saved states, and an event at its time."""
    t, y, result, saved = last.tprev, last.y, last.result, last.saved
    finds = solve.event is not None and solve.event.root_finder is not None
    if finds:
        near: Any = last.near
        happened = jnp.any(jnp.stack(jax.tree.leaves(near.mask)))
        find = lambda: _time_of_event(solve, last, happened)
        t, y, result = lax.cond(any_of_batch(happened), find, lambda: (t, y, result))
        saved = solve.on_series(lambda _, saved: _until(saved, t), saved)
    saved = solve.on_series(lambda sub, saved: _without_steps(solve, sub, saved, last, y), saved)
    saved = solve.on_series(lambda sub, saved: _with_end(solve, sub, saved, last, (t, y), finds), saved)
    last = changed(last, **constants | {"saved": saved})
    result = _RESULTS.where(_proceeds(solve, last), _RESULTS.max_steps_reached, result)
    return changed(last, result=result)


def solution_of(solve: Integration, last: Progress, y0: PyTree) -> diffrax.Solution:
    """The end of an integration as diffrax's solution, in the user's time; with the states of solver and controller."""
    interpolation, in_form = None, jax.tree.structure(solve.saveat.subs, is_leaf=_is_sub).unflatten
    if last.dense is not None:
        interpolation = diffrax.DenseInterpolation(
            ts=last.dense.ts,
            ts_size=last.dense.count + 1,
            infos=last.dense.infos,
            interpolation_cls=solve.solver.interpolation_cls,
            direction=solve.direction,
            t0_if_trivial=solve.t0,
            y0_if_trivial=y0,
        )
    counts = {name: getattr(last, name) for name in ("num_steps", "num_accepted_steps", "num_rejected_steps")}
    return diffrax.Solution(
        t0=solve.t0 * solve.direction,
        t1=solve.t1 * solve.direction,
        ts=in_form([series.ts * solve.direction for series in last.saved]),
        ys=in_form([series.ys for series in last.saved]),
        interpolation=interpolation,
        stats=counts | {"max_steps": solve.max_steps},
        result=last.result,
        solver_state=last.solver_state,
        controller_state=last.controller_state,
        made_jump=None,
        event_mask=None if last.near is None else last.near.mask,
    )


def _is_sub(x):
    return isinstance(x, diffrax.SubSaveAt)


def _holds(value):
    """Whether an event happened at the start, by the value of its function; a sign has not changed yet."""
    if jax.tree.structure(value) != jax.tree.structure(0) or jnp.shape(value) != ():
        raise ValueError(f"The function of an event must return a number, got {value}.")
    kind = jnp.result_type(value)
    if not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.bool_)):
        raise ValueError(f"The function of an event must return a truth value or a float, got {kind}.")
    return value if jnp.issubdtype(kind, jnp.bool_) else False


def _proceeds(solve: Integration, state: Any) -> Any:
    """Whether another step is tried."""
    if isinstance(solve.stepsize_controller, diffrax.StepTo):
        before_end = state.num_steps < len(solve.stepsize_controller.ts) - 1
    else:
        before_end = state.tprev < solve.t1
    return before_end & diffrax.is_successful(state.result)


def _concrete_fields(state):
    """The fields of a state whose values the compiler knows."""
    fields = {"made_jump": state.made_jump} if isinstance(state.made_jump, bool) else {}
    return fields if state.result.is_traced() else fields | {"result": state.result}


def _buffers(state):
    """The tables in a state, which the loop may write in place."""
    series = state.saved
    dense = None if state.dense is None else (state.dense.ts, state.dense.infos)
    return [saved.ts for saved in series] + [saved.ys for saved in series] + [dense]


def _advanced(solve: Integration, state: Any) -> Any:
    """The state after one attempted step."""
    start, end = state.tprev, state.tnext
    y, error, dense, solver_state, of_solver = solve.solver.step(
        solve.terms, start, end, state.y, solve.args, state.solver_state, state.made_jump
    )
    # A step whose error is NaN is too long.
    error = jax.tree.map(lambda x: jnp.where(jnp.isnan(x), jnp.inf, x), error)
    times = start * solve.direction, end * solve.direction
    if solve.along.headings is not None:
        turned = turns_over(solve.along.headings, times, (state.y, y))
        error = map_error(lambda error: refuse(error, turned), error)
    order = solve.solver.error_order(solve.terms)
    keep, tprev, tnext, made_jump, controller_state, of_controller = solve.stepsize_controller.adapt_step_size(
        start, end, state.y, y, solve.args, error, order, state.controller_state
    )
    within = solve.solver.interpolation_cls(t0=start, t1=end, **dense)
    gaps = gaps_of(solve.terms) if solve.along.gaps else None
    if gaps is not None:
        found = hidden(gaps, solve.direction, (start, end), y, within.evaluate)
        again = keep & found.hides
        # The controller does not learn of a good step that hid a force.
        controller_state = jax.tree.map(
            lambda new, old: _chosen(again, old, new), controller_state, state.controller_state
        )
        keep, tprev, tnext = keep & ~again, jnp.where(again, start, tprev), jnp.where(again, found.target, tnext)
    turning = state.turning
    if turning is not None:
        turning = turning.after(solve.along.angles, solve.direction, (start, end), (state.y, y), keep)
    t1 = solve.t1
    tprev = jnp.minimum(tprev, t1)
    almost = t1 - _LAST * jnp.finfo(t1.dtype).eps * jnp.abs(t1) - jnp.finfo(t1.dtype).tiny
    ended = jnp.where(keep, t1, tprev + 0.5 * (t1 - tprev))
    tnext = jnp.where(tnext > lax.stop_gradient(almost), ended, tnext)

    kept = lambda new, old: _chosen(keep, jnp.asarray(new), jnp.asarray(old))
    y = jax.tree.map(kept, y, state.y)
    of_solver = _RESULTS.where(keep, of_solver, _RESULTS.successful)
    result = _RESULTS.where(diffrax.is_okay(state.result), of_solver, state.result)
    result = _RESULTS.where(diffrax.is_okay(result), of_controller, result)
    accepted = state.num_accepted_steps + jnp.where(keep, 1, 0)
    meter = solve.progress_meter
    new = changed(
        state,
        y=y,
        tprev=tprev,
        tnext=tnext,
        made_jump=_chosen(keep, made_jump, state.made_jump),
        solver_state=jax.tree.map(kept, solver_state, state.solver_state),
        controller_state=controller_state,
        meter_state=meter.step(state.meter_state, _share(solve.t0, tprev, t1)),
        num_steps=state.num_steps + 1,
        num_accepted_steps=accepted,
        num_rejected_steps=state.num_rejected_steps + jnp.where(keep, 0, 1),
        turning=turning,
    )
    saved = solve.on_series(lambda sub, saved: _with_times(solve, sub, saved, new, within, end, keep), state.saved)
    saved = solve.on_series(lambda sub, saved: _with_step(solve, sub, saved, new, (tprev, y), keep), saved)
    new = changed(new, saved=saved)
    if state.dense is not None:
        tables, place = state.dense, state.dense.count
        ts = buffer_set(tables.ts, place + 1, tprev, pred=keep)
        infos = jax.tree.map(lambda x, table: buffer_set(table, place, x, pred=keep), dense, tables.infos)
        new = changed(new, dense=Dense(ts, infos, place + jnp.where(keep, 1, 0)))
    if solve.event is not None and state.near is not None:
        values = jax.tree.map(lambda guard: solve.guard(guard, tprev, y), solve.event.cond_fn, is_leaf=callable)
        mask, happened = _first_of(_changes(solve.event, state.near.values, values, _is_finite(y)))
        result = _RESULTS.where(happened, _RESULTS.event_occurred, result)
        new = changed(new, near=EventNear(start, end, dense, values, mask))
    return changed(new, result=result)


def _chosen(keep, new, old):
    """One of two values; a Python one if `keep` is, or if both are the same. `select` is one instruction, and `where` a
    function.
    """
    if isinstance(keep, bool | np.bool_):
        return new if keep else old
    return new if new is old else lax.select(keep, new, old)


def _share(t0, t, t1):
    """The fraction of the run that lies before `t`, from 0 to 1; 0 for a run without length."""
    same = t0 == t1
    return jnp.where(same, 0.0, t - t0) / jnp.where(same, 1.0, t1 - t0)


def _seen(solve: Integration, sub: diffrax.SubSaveAt, turning: Turning | None, t: Any, y: PyTree) -> PyTree:
    """What a series saves of a state at a time in the last accepted step."""
    seen = y if sub.fn is _STATES else sub.fn(t * solve.direction, y, solve.args)
    return seen if turning is None else Counted(seen, turning.at(t))


def _saved(
    solve: Integration, sub: diffrax.SubSaveAt, saved: Any, state: Any, t: Any, y: PyTree, times: int = 1
) -> Any:
    """A series with a further state, written `times` times."""
    write = lambda table, x: lax.dynamic_update_slice_in_dim(
        table, jnp.broadcast_to(x, (times, *jnp.shape(x))), saved.count, axis=0
    )
    ys = jax.tree.map(write, saved.ys, _seen(solve, sub, state.turning, t, y))
    return changed(saved, ts=write(saved.ts, t), ys=ys, count=saved.count + times)


def _with_times(solve, sub, saved, state, within, end, keep):
    """A series with the states at its times in a step, if the step is kept."""
    if sub.ts is None:
        return saved
    count = len(sub.ts)

    def is_due(saved):
        return keep & (sub.ts[saved.passed] <= end) & (saved.passed < count)

    def save(saved):
        t = sub.ts[saved.passed]
        place = saved.count
        y = _seen(solve, sub, state.turning, t, within.evaluate(t))
        ys = jax.tree.map(lambda x, table: table.at[place].set(x), y, saved.ys)
        ts = saved.ts.at[place].set(t)
        return changed(saved, ts=ts, ys=ys, count=place + 1, passed=saved.passed + 1)

    tables = lambda saved: (saved.ts, saved.ys)
    return while_loop(is_due, save, saved, max_steps=count, buffers=tables, kind="lax")


def _with_step(solve, sub, saved, state, at, keep):
    """A series with the state at the end of a step, if it is saved."""
    if sub.steps == 0:
        return saved
    here = keep & (state.num_accepted_steps % sub.steps == 0)
    value = lambda: _seen(solve, sub, state.turning, *at)
    if sub.steps == 1:
        y = value()
    else:
        zeros = lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), eqx.filter_eval_shape(value))
        y = lax.cond(any_of_batch(here), value, zeros)
    place = saved.count
    ys = jax.tree.map(lambda x, table: buffer_set(table, place, x, pred=here), y, saved.ys)
    ts = buffer_set(saved.ts, place, at[0], pred=here)
    return changed(saved, ts=ts, ys=ys, count=place + jnp.where(here, 1, 0))


def _without_steps(solve, sub, saved, state, y):
    """A series of a run without steps, which ends where it starts: all its times are the start."""
    if sub.ts is None:
        return saved
    is_empty = solve.t0 == solve.t1

    def fill():
        filled = _saved(solve, sub, saved, state, solve.t0, y, len(sub.ts))
        return jax.tree.map(lambda new, old: jnp.where(is_empty, new, old), filled, saved)

    return lax.cond(any_of_batch(is_empty), fill, lambda: saved)


def _with_end(solve, sub, saved, state, at, finds):
    """A series with the end of the run, unless the last step saved it, and without states after an event."""
    by_step = sub.steps == 1 if sub.steps < 2 else state.num_accepted_steps % sub.steps == 0
    if finds:
        here = sub.t1 | by_step
    else:
        here = sub.t1 and (not by_step if sub.steps < 2 else ~by_step)
    if here is False:
        return saved
    with_end = _saved(solve, sub, saved, state, *at)
    if here is True:
        return with_end
    ts, ys = jax.tree.map(lambda new, old: jnp.where(here, new, old), (with_end.ts, with_end.ys), (saved.ts, saved.ys))
    return changed(with_end, ts=ts, ys=ys)


def _until(saved, t):
    """A series without the states saved after a time."""
    after = saved.ts > t
    count = jnp.sum(after & (saved.ts < jnp.inf))
    drop = lambda x: jnp.where(after.reshape(-1, *[1] * (x.ndim - 1)), jnp.inf, x)
    return changed(
        saved,
        ts=drop(saved.ts),
        ys=jax.tree.map(drop, saved.ys),
        count=saved.count - count,
        passed=saved.passed - count,
    )


def _is_finite(y: PyTree) -> Any:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(y)]))


def _changes(event: diffrax.Event, before: PyTree, values: PyTree, finite: Any) -> PyTree:
    """Which events happened in a step: a true value, or a change of sign in the event's direction.

    Without a direction also a new NaN, if the state after the step is `finite`.
    """

    def changes(_, old, new, upwards):
        if jnp.issubdtype(jnp.result_type(new), jnp.bool_):
            return new
        old, new = jnp.sign(old), jnp.sign(new)
        if upwards is None:
            change = old != new
        else:
            change = (old <= 0) & (new > 0) if upwards else (old > 0) & (new <= 0)
        return change & ~jnp.isnan(old) & (finite | ~jnp.isnan(new))

    return jax.tree.map(changes, event.cond_fn, before, values, event.direction, is_leaf=callable)


def _first_of(mask: PyTree) -> tuple[PyTree, Any]:
    """The first of several events that happened, and whether any did."""
    leaves, structure = jax.tree.flatten(mask)
    happened, first = False, []
    for leaf in leaves:
        first.append(leaf & jnp.logical_not(happened))
        happened = leaf | happened
    return jax.tree.unflatten(structure, first), happened


def _time_of_event(solve: Integration, last: Any, happened: Any) -> tuple[Any, PyTree, Any]:
    """The time of the event in the last step, the state there, and the result; without an event, at the end."""
    event: Any = solve.event
    near: Any = last.near
    finite = jnp.isfinite(near.end)
    end = jnp.where(finite, near.end, solve.t1)
    within = solve.solver.interpolation_cls(t0=near.start, t1=near.end, **near.info)

    def left(t, _):
        """Zero at the event."""

        def of(guard, mask):
            def guard_value():
                value = solve.guard(guard, t, within.evaluate(t))
                return value if jnp.issubdtype(jnp.result_type(value), jnp.floating) else end - t

            # A guard without an event is not evaluated, since its derivatives need not exist.
            shape = eqx.filter_eval_shape(guard_value)
            value = lax.cond(mask, guard_value, lambda: jnp.zeros(shape.shape, shape.dtype))
            return jnp.where(happened & finite, value, (end - t).astype(value.dtype))

        return jax.tree.map(of, event.cond_fn, near.mask, is_leaf=callable)

    limits = {"lower": jnp.where(finite, near.start, solve.t0), "upper": end}
    root = optx.root_find(left, event.root_finder, y0=end, options=limits, throw=False)
    # A NaN derivative, as of a failed member of a batch, does not reach the search.
    t = jnp.where(happened, root.value, last.tprev)
    moved = happened & (last.num_steps > 0)
    y = lax.cond(any_of_batch(moved), lambda: within.evaluate(t), lambda: last.y)
    y = jax.tree.map(lambda inside, y: jnp.where(moved, inside, y), y, last.y)
    lost = happened & (root.result != optx.RESULTS.successful)
    return t, y, _RESULTS.where(lost, _RESULTS.promote(root.result), last.result)
