"""Derivatives of a solve on its mesh.

A differentiated solve is integrated once, without derivatives, and leaves a row of numbers for each accepted step.
Forward mode pushes a tangent through the rows from first to last, one linear step at a time. Reverse mode pulls a
cotangent back from last to first. The derivatives contain no step size control, no rejected step and no second solution
of the equations, and all modes share one mesh. The linear map over the rows comes with its transpose, so modes can be
combined and batched.
"""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._compat import buffer_set, while_loop
from .closures import opened
from .evaluation import freeze, ravel, unravel_like
from .events import events_found
from .linear_map import filled, linear_map
from .packing import Layout
from .segments import Row, Segments, choice_of, first_of, remainder, row_of, start_of
from .stepping import Integration, Progress, constant_fields, ended, stepped
from .steps import AbstractSteps, LinearStep, Moving
from .turning import Counted
from .whole_steps import jump_times, steps_of

_TOO_LONG = (
    "Second derivatives need the rows of all steps, of which {} are kept. This run has more steps. In `simulate` a "
    "max_steps of at most 16384 keeps all; `integrate` has the argument `kept`."
)


class Saved(eqx.Module):
    """A series of saved states.

    **Fields:** `start`: whether it begins with the start; its `times`, or None; `steps`: the number of steps from one
    saved state to the next, 0 for none; `events`: whether it saves the state before each event; its `length`; `passed`:
    how many states and how many of the times were passed. For events the second number is 1 if the next step found the
    last event void.
    """

    start: bool = eqx.field(static=True)
    times: Any
    steps: int = eqx.field(static=True)
    events: bool = eqx.field(static=True)
    length: int = eqx.field(static=True)
    passed: Any

    def takes(self, k: Any, row: Row) -> Any:
        """Whether the state at the end of the step k is saved; False for a series without such states."""
        if self.events:
            return row.at_event.here
        return ((k + 1) % self.steps == 0) & (k >= 0) if self.steps else False


class Tangents(NamedTuple):
    """Tangents, or cotangents, of a run.

    **Fields:** `end`: of the raveled state and the memory at the end; of the `saved` states; of the `rows`; `dense`: of
    the dense output of all steps, or None; `last`: of the dense output of the last step, or None.
    """

    end: tuple[Array, PyTree]
    saved: tuple[Array, ...]
    rows: PyTree
    dense: PyTree
    last: PyTree


class Mesh(eqx.Module):
    """The steps of a run.

    **Fields:** `moved`: the numbers that have tangents; `still`: the rest of the terms, their arguments and the solver;
    `steps`; `rows`: buffers of packed rows, then the row of the start if there is one; `layout` of a row; their
    `count`; the `saved` series; `like`: a state; `memory` of the solver at the start; `dense`: the number of steps with
    dense output; `event`: whether the run ends at an event; its `segments`, None for a single one.
    """

    moved: Moving
    still: PyTree
    steps: AbstractSteps
    rows: list[Array]
    layout: Layout = eqx.field(static=True)
    count: Any
    saved: tuple[Saved, ...]
    like: PyTree
    memory: PyTree
    dense: int = eqx.field(static=True)
    event: bool = eqx.field(static=True)
    segments: Segments | None

    @property
    def size(self) -> int:
        return self.rows[0].shape[0] - self.steps.starts

    def row(self, rows: list[Array], k: Any) -> Row:
        """The row of a step, from the rows of its segment."""
        place = self._place(k)
        return self.layout.unpacked([buffer[place] for buffer in rows])

    @property
    def _begin(self) -> Any:
        """The index of the first row: -1 for the row of the start, if steps follow it."""
        return -(self.count > 0).astype(self.count.dtype) if self.steps.starts else jnp.zeros_like(self.count)

    def _is_step(self, k: Any) -> Any:
        """Whether a row belongs to a step, and not to the start."""
        return k >= 0 if self.steps.starts else True

    def _place(self, k: Any) -> Any:
        """The index of the row of a step among the rows of its segment."""
        place = k if self.segments is None else remainder(k, self.size)
        return jnp.where(k < 0, self.size, place) if self.steps.starts else place

    def linearised(self, row: Row) -> LinearStep:
        return self.steps.linearised(lambda terms: eqx.combine(terms, self.still), self.moved, self.like, row.own)

    def blank(self) -> Tangents:
        """Zeros."""
        n, memory = ravel(self.like), self.memory
        step = self._shapes() if self.dense or self.event else None
        table = lambda x: jnp.zeros((self.dense, *x.shape), x.dtype)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), step)
        return Tangents(
            (jnp.zeros_like(n), jax.tree.map(jnp.zeros_like, memory)),
            tuple(jnp.zeros((series.length, n.size), n.dtype) for series in self.saved),
            [jnp.zeros_like(rows) for rows in self.rows if jnp.issubdtype(rows.dtype, jnp.floating)],
            jax.tree.map(table, step) if self.dense else None,
            zeros if self.event else None,
        )

    def _shapes(self) -> PyTree:
        """The shapes of the tangent of a step's dense output."""
        run: Any = lambda moved, memory: self.linearised(self.row(self.rows, 0)).push(moved, ravel(self.like), memory)[
            2
        ]
        return eqx.filter_eval_shape(run, self.moved, self.memory)

    def push(self, x: PyTree, used: Tangents) -> Tangents:
        """The tangents caused by `x`: tangents of the terms, of the first state and of its memory. The tangents of the
        rows are zeros unless they are `used`.
        """
        blank, (w, memory) = self.blank(), x[1]
        first = self._first(w, memory, blank if any(used.rows) else blank._replace(rows=[]))
        if self.segments is None:
            return self._out(self._pushed(x[0], first, self.rows, self.count), blank)

        def body(carry):
            segment, inner, rows = carry
            rows = self._rows_again(segment, rows, self.count > self.size)
            last = jnp.minimum((segment + 1) * self.size, self.count)
            return segment + 1, self._pushed(x[0], inner, rows, last), rows

        carry = while_loop(
            lambda carry: carry[0] * self.size < self.count,
            body,
            (0, first, self.rows),
            max_steps=None,
            buffers=lambda carry: (_tables(carry[1]), carry[2]),
            kind="lax",
        )
        return self._out(carry[1], blank)

    def of_one_segment(self) -> "Mesh":
        """The same mesh, whose maps can be differentiated by the rows; an error for a run with more steps than rows."""
        if self.segments is None:
            return self
        rows = eqx.error_if(self.rows, self.count > self.size, _TOO_LONG.format(self.size))
        return dataclasses.replace(self, rows=rows, segments=None)

    def _rows_again(self, segment: Any, rows: list[Array], lost: Any) -> list[Array]:
        """The rows of a segment of the run, recomputed in these buffers where they are `lost`."""
        segments: Any = self.segments
        equations = freeze(eqx.combine(self.moved.terms, self.still))
        return segments.rows(self.steps, equations, segment, self.count, rows, lost)

    def _first(self, w, memory, out: Tangents):
        """The carry of the loop over steps at its start, with tables for its results."""
        saved = tuple(
            table.at[0].set(w) if series.start else table for series, table in zip(self.saved, out.saved, strict=True)
        )
        places = tuple(jnp.array([int(series.start), 0]) for series in self.saved)
        return self._begin, (w, memory), saved, places, out.rows, out.dense, out.last

    def _out(self, carry, blank: Tangents) -> Tangents:
        _, end, saved, _, rows, dense, last = carry
        return Tangents(end, saved, rows or blank.rows, dense, last)

    def _pushed(self, dmoved, carry, rows_of_segment, count):
        """The carry after the steps before `count`."""

        def body(carry):
            k, before, saved, places, rows, dense, _ = carry
            row = self.row(rows_of_segment, k)
            step = self.linearised(row)
            w, memory, ddense = step.push(dmoved, *before)
            after = w, memory
            if rows:
                row_tangent = self.steps.row_tangent(row.own, self.like, before, after)
                none = jax.tree.map(lambda _: None, row)
                along = self.layout.packed_tangent(row, none._replace(own=row_tangent))
                rows = [buffer_set(buffer, self._place(k), x) for buffer, x in zip(rows, along, strict=True)]
            if self.dense:
                dense = jax.tree.map(lambda x, buffer: buffer_set(buffer, k, x, self._is_step(k)), ddense, dense)
            parts = zip(self.saved, saved, places, strict=True)
            new = [_saved(series, table, place, k, row, after[0], ddense, step.at) for series, table, place in parts]
            saved, places = tuple(x[0] for x in new), tuple(x[1] for x in new)
            return k + 1, after, saved, places, rows, dense, ddense if self.event else None

        return while_loop(lambda carry: carry[0] < count, body, carry, max_steps=None, buffers=_tables, kind="lax")

    def pull(self, cotangents: Tangents) -> PyTree:
        """The transpose of `push`; None stands for a zero cotangent."""
        end = filled((ravel(self.like), self.memory), cotangents.end)
        places = tuple(series.passed for series in self.saved)
        carry = self.count, *end, places, jax.tree.map(jnp.zeros_like, self.moved)
        if self.segments is None:
            carry = self._pulled(cotangents, carry, self.rows, self._begin)
        else:

            def body(carry):
                segment, inner, rows = carry
                rows = self._rows_again(segment, rows, segment < last)
                first = jnp.where(segment == 0, self._begin, segment * self.size)
                return segment - 1, self._pulled(cotangents, inner, rows, first), rows

            last = (self.count - 1) // self.size
            carry = last, carry, self.rows
            kept = lambda carry: carry[2]
            _, carry, _ = while_loop(lambda c: c[0] >= 0, body, carry, max_steps=None, buffers=kept, kind="lax")
        _, lw, lmemory, places, total = carry
        for series, table in zip(self.saved, cotangents.saved, strict=True):
            if series.start and table is not None:
                lw = lw + table[0]
        return total, (lw, lmemory)

    def _pulled(self, cotangents: Tangents, carry, rows, first):
        """The carry of the loop over steps before the step `first`."""
        nothing = jax.tree.map(jnp.zeros_like, self.moved)

        def body(carry):
            k, lw, lmemory, places, total = carry
            k = k - 1
            row = self.row(rows, k)
            step = self.linearised(row)
            shapes = eqx.filter_eval_shape(step.push, nothing, lw, lmemory)[2]
            ldense = zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
            if cotangents.dense is not None:
                with_cotangent = lambda z, c: z if c is None else z + jnp.where(self._is_step(k), c[k], 0)
                ldense = jax.tree.map(with_cotangent, zeros, cotangents.dense)
            if cotangents.last is not None:
                is_last = k + 1 == self.count
                ldense = jax.tree.map(
                    lambda z, c: z if c is None else z + jnp.where(is_last, c, 0), ldense, cotangents.last
                )
            places_before = []
            for series, table, place in zip(self.saved, cotangents.saved, places, strict=True):
                lw, ldense, place = _unsaved(series, table, place, k, row, lw, ldense, step.at)
                places_before.append(place)
            dmoved, lw, lmemory = jax.linear_transpose(step.push, nothing, lw, lmemory)((lw, lmemory, ldense))
            return k, lw, lmemory, tuple(places_before), jax.tree.map(jnp.add, total, dmoved)

        return while_loop(lambda carry: carry[0] > first, body, carry, max_steps=None, buffers=None, kind="lax")


def _tables(carry):
    """The buffers in the carry of the loop over steps."""
    _, _, saved, _, rows, dense, _ = carry
    return saved, rows, dense


def _saved(series: Saved, table, place, k, row, w, dense, at):
    """The table of a series with the states of a step, and the place of the series after it."""
    if series.times is not None:
        times = series.times

        def is_due(carry):
            _, place = carry
            return (place[1] < times.size) & (times[jnp.minimum(place[1], times.size - 1)] <= row.end)

        def save(carry):
            table, place = carry
            return buffer_set(table, place[0], at(dense, times[place[1]])), place + 1

        carry = table, place
        table, place = while_loop(is_due, save, carry, max_steps=None, buffers=lambda carry: carry[0], kind="lax")
    here = series.takes(k, row)
    if series.events:
        # The next event takes the place of a void one.
        place = place.at[0].add(-row.at_event.void.astype(place.dtype))
    if here is not False:
        table = buffer_set(table, place[0], w, here)
        place = place.at[0].add(here.astype(place.dtype))
    return table, place


def _unsaved(series: Saved, table, place, k, row, lw, ldense, at):
    """The transpose of `_saved`: the cotangents of a step's end and dense output, including the states saved in the
    step, and the place of the series before it.
    """
    here = series.takes(k, row)
    if here is not False:
        place, counts = place.at[0].add(-here.astype(place.dtype)), here
        of_step = place[0]
        if series.events:
            # A step that begins at a void event may end at the event that takes its place.
            void = row.at_event.void.astype(place.dtype)
            counts, place = here & (place[1] == 0), jnp.stack([of_step + void, void])
        if table is not None:
            lw = lw + jnp.where(counts, table[of_step], 0.0)
    if series.times is not None:
        times = series.times

        def is_due(carry):
            _, place = carry
            return (place[1] > 0) & (times[jnp.maximum(place[1] - 1, 0)] > row.since)

        def unsave(carry):
            ldense, place = carry
            place = place - 1
            if table is not None:
                (by_state,) = jax.linear_transpose(lambda x: at(x, times[place[1]]), ldense)(table[place[0]])
                ldense = jax.tree.map(jnp.add, ldense, by_state)
            return ldense, place

        carry = ldense, place
        ldense, place = while_loop(is_due, unsave, carry, max_steps=None, buffers=None, kind="lax")
    return lw, ldense, place


def on_mesh(solve: Integration, first: Progress, limit: Any, most: int) -> Progress:
    """The end of an integration after at most `limit` steps, with derivatives on its mesh, in every mode.

    **Arguments:** `most`: the number of steps whose rows are kept at once.
    """
    # Values that a function closes over are arguments of the rule below; otherwise their derivatives would be zero.
    terms, event = jax.tree.map(opened, (solve.terms, solve.event))
    solve = solve._replace(terms=terms, event=event)
    steps, untracked = steps_of(solve.solver, solve.stepsize_controller)
    # A first step after a jump uses nothing from before.
    steps = (steps if first.made_jump is False else steps.after_first_jump()).from_start()
    jumps, args = jump_times(solve.stepsize_controller), solve.args
    fixed = alone, steps = freeze((solve._replace(terms=None, args=None), steps))
    still, start = freeze((terms, args)), freeze(first)
    whole = alone._replace(terms=still[0], args=still[1])
    constants = constant_fields(whole, start)
    recorded = _recorded(whole, start, steps, constants, freeze(limit), most)
    final, *_ = _with_derivatives(recorded, (terms, args, untracked), jumps, first, fixed)
    # The time of an event depends on its function, after the steps are taken.
    return ended(alone._replace(terms=terms, args=args, event=event), final, constants)


def _recorded(solve, init_state, steps, constants, limit, most):
    """The last state, the rows of the last segment, and the data to repeat steps: the starts of all segments and the
    choices of all steps, None for a single segment. All but the state are packed.

    A segment has at most `most` steps. The row of the start, if there is one, follows behind its rows.
    """
    terms = solve.terms
    size = min(most, solve.max_steps)
    segments = -(-solve.max_steps // size)

    def outer(cond_fun, body_fun, init, buffers):
        since = jnp.asarray(-jnp.inf, init.tprev.dtype)
        layout = Layout(eqx.filter_eval_shape(lambda init: row_of(steps, terms, since, init, body_fun(init)), init))
        of_starts, of_choices = _layouts_again(steps, init, eqx.filter_eval_shape(body_fun, init))

        def body(carry):
            old, since, first, rows, starts, choices = carry
            new = body_fun(old)
            k, kept = old.num_accepted_steps, new.num_accepted_steps > old.num_accepted_steps
            if steps.starts:
                first = _written(first, 0, layout.packed(first_of(steps, terms, old, new)), kept & (k == 0))
            if starts is not None:
                # In the middle of a segment the state is written behind the starts.
                place = jnp.where(remainder(k, size) == 0, k // size, segments)
                starts = _written(starts, place, of_starts.packed(start_of(steps, since, old)), True)
                choices = _written(choices, k, of_choices.packed(choice_of(steps, old, new)), kept)
            rows = _written(
                rows,
                k if starts is None else remainder(k, size),
                layout.packed(row_of(steps, terms, since, old, new)),
                kept,
            )
            return new, jnp.where(kept, old.tnext, since), first, rows, starts, choices

        several = segments > 1
        starts = of_starts.blank(segments + 1) if several else None
        choices = of_choices.blank(segments * size) if several else None
        # A place for the start even without its row: XLA loses the types of calls beside empty arrays.
        last, _, first, rows, starts, choices = while_loop(
            lambda carry: cond_fun(carry[0]) & (carry[0].num_steps < limit),
            body,
            (init, since, layout.blank(1), layout.blank(size + steps.starts), starts, choices),
            max_steps=None,
            buffers=lambda carry: (buffers(carry[0]), *carry[2:]),
            kind="lax",
        )
        if steps.starts:
            # Outside the loop: two rows written in it would copy the whole buffer.
            rows = _written(rows, size, [table[0] for table in first], True)
        return last, rows, None if starts is None else (starts, choices)

    return stepped(solve, init_state, constants, outer)


def _written(tables, index, row, kept):
    return [buffer_set(table, index, x, kept) for table, x in zip(tables, row, strict=True)]


def _layouts_again(steps, old, new):
    """The layouts of the starts of segments and of choices, from two states."""
    return (
        Layout(eqx.filter_eval_shape(lambda new: start_of(steps, new.tprev, new), new)),
        Layout(eqx.filter_eval_shape(lambda old, new: choice_of(steps, old, new), old, new)),
    )


@eqx.filter_custom_jvp
def _with_derivatives(recorded, equations, jumps, init_state, fixed):
    """The `recorded` run, with derivatives by the other arguments.

    **Arguments:** `equations`: terms, their arguments and the solver without tangents; `jumps`: the times of jumps,
    which the step size controller knows as well. The solver and these times are here for their tangents.
    """
    del jumps, fixed
    # In a batch all outputs must be batched if their tangents are, and tangents are batched if any input is. Under
    # `jit`, JAX gives the outputs of a rule the batch axes of the outputs of its function.
    numbers = [x for x in jax.tree.leaves((recorded, equations, init_state)) if eqx.is_array(x) and x.size]
    same = jnp.any(jnp.stack([jnp.ravel(x)[0] != jnp.ravel(x)[0] for x in numbers]))
    return jax.tree.map(lambda x: jnp.where(same, x, x) if eqx.is_array(x) else x, recorded)


@_with_derivatives.def_jvp
def _with_derivatives_jvp(primals, tangents):
    _, equations, jumps, init_state, fixed = primals
    _, dequations, djumps, dinit, *_ = tangents
    # Second derivatives need the derivatives of the rows.
    out = _with_derivatives(*primals)
    final, rows, again = out
    solve, steps = fixed
    saveat = solve.saveat
    moved, still = eqx.partition(equations, jax.tree.map(_is_known, dequations, is_leaf=_is_none))
    y0, memory = init_state.y, steps.memory(init_state.solver_state)
    w, inner = ravel(filled(y0, dinit.y)), filled(memory, steps.memory(dinit.solver_state))
    x = Moving(dequations, djumps), (w, inner)
    series = solve.subs
    if any(sub.fn is not diffrax.SubSaveAt(t1=True).fn for sub in series):
        raise ValueError("Derivatives are those of saved states: apply the function of SaveAt(fn=...) to them.")
    saved = tuple(
        Saved(sub.t0, sub.ts, sub.steps, False, state.ts.shape[0], jnp.stack([state.count, state.passed]))
        for sub, state in zip(series, final.saved, strict=True)
    )
    events = events_found(final.controller_state)
    if events is not None:
        saved += (Saved(False, None, 0, True, len(events.states), jnp.stack([events.count, jnp.array(0)])),)
    row = lambda a, b: row_of(steps, equations[0], b.tprev, a, b)
    layout = Layout(eqx.filter_eval_shape(row, init_state, final))
    mesh = Mesh(
        moved=Moving(moved, None if djumps is None else jumps),
        still=still,
        steps=steps,
        rows=rows,
        layout=layout,
        count=final.num_accepted_steps,
        saved=saved,
        like=y0,
        memory=memory,
        dense=solve.max_steps if saveat.dense else 0,
        event=solve.event is not None,
        segments=_segments(again, layout, steps, init_state, final),
    )
    like = eqx.filter_eval_shape(Mesh.blank, mesh)
    of_one = lambda mesh, *x: mesh.of_one_segment().push(*x), lambda mesh, x: mesh.of_one_segment().pull(x)
    along = linear_map(Mesh.push, Mesh.pull, of_one, mesh, x, like)
    return out, (_of_loop(final, along, y0), _of_rows(rows, along.rows), jax.tree.map(lambda _: None, again))


def _segments(again, layout, steps, old, new):
    if again is None:
        return None
    (starts, choices), (of_starts, of_choices) = again, _layouts_again(steps, old, new)
    return Segments(starts, choices, of_starts, of_choices, layout)


def _of_loop(final, along: Tangents, like):
    """The tangent of the last state."""
    state = lambda flat: unravel_like(like, flat)
    none, event_state = jax.tree.map(lambda _: None, final), lambda final: events_found(final.controller_state)
    has_dense, has_event = final.dense is not None, final.near is not None
    parts = lambda final: (
        final.y,
        *((final.dense.infos,) if has_dense else ()),
        *((final.near.info,) if has_event else ()),
        *(_states(saved.ys) for saved in final.saved),
        *(() if (events := event_state(final)) is None else (events.states,)),
    )
    series = len(final.saved)
    tables, events = along.saved[:series], along.saved[series:]
    outputs = [x for x in (along.dense, along.last) if x is not None]
    new = state(along.end[0]), *outputs, *(jax.vmap(state)(table) for table in tables), *events
    return eqx.tree_at(parts, none, new, is_leaf=_is_none)


def _states(ys):
    """The states of a series; counted angles beside them have no tangents."""
    return ys.states if isinstance(ys, Counted) else ys


def _of_rows(rows, along):
    tangents = iter(along)
    return [next(tangents) if jnp.issubdtype(x.dtype, jnp.floating) else None for x in rows]


def _is_none(x):
    return x is None


def _is_known(x):
    return x is not None
