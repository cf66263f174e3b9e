"""The loop over the steps of a solve, in place of diffrax's loop.

From the same state it computes the same, for `diffrax.diffeqsolve` and the adjoints of this package. A step that would
end within a hundred rounding errors of the end of the run ends there. One operation finds that time: diffrax takes
fifteen hundred, a tenth of the time to trace and compile a small mechanism. A run that fails has no event. The time of
an event is searched only in members of a batch that have an event, so a failed member does not stop the others.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import PyTree

from .._compat import any_of_batch, buffer_set, save_states, while_loop, with_save_states
from .turning import Counted, turning_of

_RESULTS = diffrax.RESULTS
# A step that would end within this many rounding errors of the end of the run ends there.
_LAST = 100


class _Solve(NamedTuple):
    """The arguments of `diffrax.diffeqsolve` that the loop does not change."""

    terms: PyTree
    args: PyTree
    solver: Any
    stepsize_controller: Any
    event: diffrax.Event | None
    saveat: diffrax.SaveAt
    t0: Any
    t1: Any
    dt0: Any
    max_steps: int | None
    progress_meter: Any

    def on_series(self, function: Callable[[diffrax.SubSaveAt, Any], Any], saved: PyTree) -> PyTree:
        """Map a function of `(series, saved)` over the series of saved states."""
        return jax.tree.map(function, self.saveat.subs, saved, is_leaf=lambda x: isinstance(x, diffrax.SubSaveAt))

    def guard(self, function: Callable[..., Any], t: Any, y: PyTree) -> Any:
        """The value of a function of the event."""
        names = ("terms", "solver", "t0", "t1", "dt0", "saveat", "stepsize_controller", "max_steps")
        return function(t, y, self.args, **{name: getattr(self, name) for name in names})


def loop(*, init_state: Any, outer_while_loop: Callable[..., Any], **given: Any) -> tuple[Any, dict[str, Any]]:
    """The last state of the loop, and its statistics (none), for an adjoint.

    **Arguments:** as of diffrax's loop. The loop over steps is `outer_while_loop(proceed, advance, state, max_steps=,
    buffers=)`.
    """
    constants = constant_fields(init_state, **given)
    return ended(stepped(init_state, outer_while_loop, constants, **given), constants, **given), {}


def with_tables_of_angles(state: Any) -> Any:
    """The state before the loop, with tables for the angles that its controller counts, if any."""
    turning = turning_of(state.controller_state)
    if turning is None:
        return state
    table = lambda saved: jnp.full((*saved.ts.shape, turning.angles.shape[1]), jnp.inf, turning.angles.dtype)
    return with_save_states(state, lambda saved: dataclasses.replace(saved, ys=Counted(saved.ys, table(saved))))


def constant_fields(state: Any, **given: Any) -> dict[str, Any]:
    """The fields of the state that are the same constants in all steps, by name: for example, that nothing fails and
    that there are no jumps. The compiler then knows them.

    **Arguments:** as of `loop`.
    """
    solve, constants = _Solve(**given), _concrete_fields(state)
    while True:
        # A constant that turns out to vary may make others vary.
        fields_after = lambda state, constants=constants: _concrete_fields(
            _advanced(solve, dataclasses.replace(state, **constants))
        )
        shapes = eqx.filter_eval_shape(fields_after, state)
        same = {name: value for name, value in constants.items() if name in shapes and shapes[name] == value}
        if len(same) == len(constants):
            return constants
        constants = same


def stepped(state: Any, outer_while_loop: Callable[..., Any], constants: dict[str, Any], **given: Any) -> Any:
    """The state after the last step, with the constants of `constant_fields`."""
    solve = _Solve(**given)
    if solve.saveat.dense:
        state = dataclasses.replace(state, dense_ts=state.dense_ts.at[0].set(solve.t0))
    at_start = lambda sub, saved: _saved(solve, sub, saved, state, solve.t0, state.y) if sub.t0 else saved
    state = dataclasses.replace(state, save_state=solve.on_series(at_start, state.save_state))
    proceed = lambda state: _proceeds(solve, dataclasses.replace(state, **constants))
    advance = lambda state: _advanced(solve, dataclasses.replace(state, **constants))
    return outer_while_loop(proceed, advance, state, max_steps=solve.max_steps, buffers=_buffers)


def ended(last: Any, constants: dict[str, Any], **given: Any) -> Any:
    """The last state with its result, the end of the run among the saved states, and an event at its time."""
    solve = _Solve(**given)
    t, y, result, saved = last.tprev, last.y, last.result, last.save_state
    finds = solve.event is not None and solve.event.root_finder is not None
    if finds:
        happened = jnp.any(jnp.stack(jax.tree.leaves(last.event_mask)))
        find = lambda: _time_of_event(solve, last, happened)
        t, y, result = lax.cond(any_of_batch(happened), find, lambda: (t, y, result))
        saved = solve.on_series(lambda _, saved: _until(saved, t), saved)
    saved = solve.on_series(lambda sub, saved: _without_steps(solve, sub, saved, last, y), saved)
    saved = solve.on_series(lambda sub, saved: _with_end(solve, sub, saved, last, (t, y), finds), saved)
    last = dataclasses.replace(last, **constants | {"save_state": saved})
    result = _RESULTS.where(_proceeds(solve, last), _RESULTS.max_steps_reached, result)
    return dataclasses.replace(last, result=result)


def _proceeds(solve: _Solve, state: Any) -> Any:
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
    series = save_states(state)
    return [saved.ts for saved in series] + [saved.ys for saved in series] + [state.dense_ts, state.dense_infos]


def _advanced(solve: _Solve, state: Any) -> Any:
    """The state after one attempted step."""
    start, end = state.tprev, state.tnext
    y, error, dense, solver_state, of_solver = solve.solver.step(
        solve.terms, start, end, state.y, solve.args, state.solver_state, state.made_jump
    )
    # A step whose error is NaN is too long.
    error = jax.tree.map(lambda x: jnp.where(jnp.isnan(x), jnp.inf, x), error)
    order = solve.solver.error_order(solve.terms)
    keep, tprev, tnext, made_jump, controller_state, of_controller = solve.stepsize_controller.adapt_step_size(
        start, end, state.y, y, solve.args, error, order, state.controller_state
    )
    t1 = solve.t1
    tprev = jnp.minimum(tprev, t1)
    almost = t1 - _LAST * jnp.finfo(t1.dtype).eps * jnp.abs(t1) - jnp.finfo(t1.dtype).tiny
    ended = jnp.where(keep, t1, tprev + 0.5 * (t1 - tprev))
    tnext = jnp.where(tnext > lax.stop_gradient(almost), ended, tnext)

    kept = lambda new, old: jnp.where(keep, new, old)
    y = jax.tree.map(kept, y, state.y)
    of_solver = _RESULTS.where(keep, of_solver, _RESULTS.successful)
    result = _RESULTS.where(diffrax.is_okay(state.result), of_solver, state.result)
    result = _RESULTS.where(diffrax.is_okay(result), of_controller, result)
    accepted = state.num_accepted_steps + jnp.where(keep, 1, 0)
    meter = solve.progress_meter
    new = dataclasses.replace(
        state,
        y=y,
        tprev=tprev,
        tnext=tnext,
        made_jump=_chosen(keep, made_jump, state.made_jump),
        solver_state=jax.tree.map(kept, solver_state, state.solver_state),
        controller_state=controller_state,
        progress_meter_state=meter.step(state.progress_meter_state, _share(solve.t0, tprev, t1)),
        num_steps=state.num_steps + 1,
        num_accepted_steps=accepted,
        num_rejected_steps=state.num_rejected_steps + jnp.where(keep, 0, 1),
    )
    within = solve.solver.interpolation_cls(t0=start, t1=end, **dense)
    saved = solve.on_series(lambda sub, saved: _with_times(solve, sub, saved, new, within, end, keep), state.save_state)
    saved = solve.on_series(lambda sub, saved: _with_step(solve, sub, saved, new, (tprev, y), keep), saved)
    new = dataclasses.replace(new, save_state=saved)
    if solve.saveat.dense:
        place = state.dense_save_index
        new = dataclasses.replace(
            new,
            dense_ts=buffer_set(state.dense_ts, place + 1, tprev, pred=keep),
            dense_infos=jax.tree.map(lambda x, table: buffer_set(table, place, x, pred=keep), dense, state.dense_infos),
            dense_save_index=place + jnp.where(keep, 1, 0),
        )
    if solve.event is not None:
        values = jax.tree.map(lambda guard: solve.guard(guard, tprev, y), solve.event.cond_fn, is_leaf=callable)
        mask, happened = _first_of(_changes(solve.event, state.event_values, values, _is_finite(y)))
        result = _RESULTS.where(happened, _RESULTS.event_occurred, result)
        new = dataclasses.replace(
            new,
            event_tprev=start,
            event_tnext=end,
            event_dense_info=dense,
            event_values=values,
            event_mask=mask,
        )
    return dataclasses.replace(new, result=result)


def _chosen(keep, new, old):
    """One of two truth values; a Python one if `keep` is, or if both are the same."""
    if isinstance(keep, bool | np.bool_):
        return new if keep else old
    return new if new is old else lax.select(keep, new, old)


def _share(t0, t, t1):
    """The fraction of the run that lies before `t`, from 0 to 1; 0 for a run without length."""
    same = t0 == t1
    return jnp.where(same, 0.0, t - t0) / jnp.where(same, 1.0, t1 - t0)


def _seen(solve: _Solve, sub: diffrax.SubSaveAt, state: Any, t: Any, y: PyTree) -> PyTree:
    """What a series saves of a state at a time in the last accepted step."""
    seen, turning = sub.fn(t, y, solve.args), turning_of(state.controller_state)
    return seen if turning is None else Counted(seen, turning.at(t))


def _saved(solve: _Solve, sub: diffrax.SubSaveAt, saved: Any, state: Any, t: Any, y: PyTree, times: int = 1) -> Any:
    """A series with a further state, written `times` times."""
    write = lambda table, x: lax.dynamic_update_slice_in_dim(
        table, jnp.broadcast_to(x, (times, *jnp.shape(x))), saved.save_index, axis=0
    )
    ys = jax.tree.map(write, saved.ys, _seen(solve, sub, state, t, y))
    return dataclasses.replace(saved, ts=write(saved.ts, t), ys=ys, save_index=saved.save_index + times)


def _with_times(solve, sub, saved, state, within, end, keep):
    """A series with the states at its times in a step, if the step is kept."""
    if sub.ts is None:
        return saved
    count = len(sub.ts)

    def is_due(saved):
        return keep & (sub.ts[saved.saveat_ts_index] <= end) & (saved.saveat_ts_index < count)

    def save(saved):
        t = sub.ts[saved.saveat_ts_index]
        place = saved.save_index
        y = _seen(solve, sub, state, t, within.evaluate(t))
        ys = jax.tree.map(lambda x, table: table.at[place].set(x), y, saved.ys)
        ts = saved.ts.at[place].set(t)
        return dataclasses.replace(saved, ts=ts, ys=ys, save_index=place + 1, saveat_ts_index=saved.saveat_ts_index + 1)

    tables = lambda saved: (saved.ts, saved.ys)
    return while_loop(is_due, save, saved, max_steps=count, buffers=tables, kind="lax")


def _with_step(solve, sub, saved, state, at, keep):
    """A series with the state at the end of a step, if it is saved."""
    if sub.steps == 0:
        return saved
    here = keep & (state.num_accepted_steps % sub.steps == 0)
    value = lambda: _seen(solve, sub, state, *at)
    if sub.steps == 1:
        y = value()
    else:
        zeros = lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), eqx.filter_eval_shape(value))
        y = lax.cond(any_of_batch(here), value, zeros)
    place = saved.save_index
    ys = jax.tree.map(lambda x, table: buffer_set(table, place, x, pred=here), y, saved.ys)
    ts = buffer_set(saved.ts, place, at[0], pred=here)
    return dataclasses.replace(saved, ts=ts, ys=ys, save_index=place + jnp.where(here, 1, 0))


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
    return dataclasses.replace(with_end, ts=ts, ys=ys)


def _until(saved, t):
    """A series without the states saved after a time."""
    after = saved.ts > t
    count = jnp.sum(after & (saved.ts < jnp.inf))
    drop = lambda x: jnp.where(after.reshape(-1, *[1] * (x.ndim - 1)), jnp.inf, x)
    return dataclasses.replace(
        saved,
        ts=drop(saved.ts),
        ys=jax.tree.map(drop, saved.ys),
        save_index=saved.save_index - count,
        saveat_ts_index=saved.saveat_ts_index - count,
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


def _time_of_event(solve: _Solve, last: Any, happened: Any) -> tuple[Any, PyTree, Any]:
    """The time of the event in the last step, the state there, and the result; without an event, at the end."""
    event: Any = solve.event
    finite = jnp.isfinite(last.event_tnext)
    end = jnp.where(finite, last.event_tnext, solve.t1)
    within = solve.solver.interpolation_cls(t0=last.event_tprev, t1=last.event_tnext, **last.event_dense_info)

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

        return jax.tree.map(of, event.cond_fn, last.event_mask, is_leaf=callable)

    limits = {"lower": jnp.where(finite, last.event_tprev, solve.t0), "upper": end}
    root = optx.root_find(left, event.root_finder, y0=end, options=limits, throw=False)
    # A NaN derivative, as of a failed member of a batch, does not reach the search.
    t = jnp.where(happened, root.value, last.tprev)
    moved = happened & (last.num_steps > 0)
    y = lax.cond(any_of_batch(moved), lambda: within.evaluate(t), lambda: last.y)
    y = jax.tree.map(lambda inside, y: jnp.where(moved, inside, y), y, last.y)
    lost = happened & (root.result != optx.RESULTS.successful)
    return t, y, _RESULTS.where(lost, _RESULTS.promote(root.result), last.result)
