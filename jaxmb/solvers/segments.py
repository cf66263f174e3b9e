"""Runs with more steps than kept rows, whose steps are repeated.

Every step keeps a few numbers: the choices of the step size controller and of the error estimates. Every segment keeps
its whole first state. The steps of a segment follow from these, without error estimates and without the tangents whose
errors were controlled.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, PyTree

from .._compat import buffer_set, while_loop
from .events import events_found
from .packing import Layout
from .steps import AbstractSteps


class AtEvent(NamedTuple):
    """**Fields:** `here`: whether a step ends at an event; `void`: whether the event at its start changed nothing."""

    here: Any
    void: Any


class Row(NamedTuple):
    """The row of a step, or of the start of a run, which has no duration.

    **Fields:** `since`: the end of the last step, which is the start of this step unless there was a jump, and minus
    infinity before the first; its `end`; `at_event`: the events there, None for a run without them (`AbstractGuards`);
    `own`: the numbers for its linearisation.
    """

    since: Any
    end: Any
    at_event: Any
    own: Any


class Choice(NamedTuple):
    """The choices made for a step.

    **Fields:** its end `tnext`, its start `tprev`, and whether it `made_jump`, as in the states of an integration.
    Without jumps the last two are None: a step starts at the end of the last. `at_event` of its row; `chosen`: the
    choices of its error estimate for the next step.
    """

    tnext: Any
    tprev: Any
    made_jump: Any
    at_event: Any
    chosen: PyTree[Array]


class Between(NamedTuple):
    """The parts of the state of an integration that determine a step."""

    tprev: Any
    tnext: Any
    y: PyTree[Array]
    made_jump: Any
    solver_state: PyTree[Array]


def row_of(steps: AbstractSteps, terms: PyTree, since: Any, old: Any, new: Any) -> Row:
    """The row of the step between two states of an integration; `since`: the end of the step before it."""
    return Row(since, old.tnext, _at_event(old, new), steps.row(terms, old, new))


def first_of(steps: AbstractSteps, terms: PyTree, old: Any, new: Any) -> Row:
    """The row of the start of a run, without duration, from the states before and after the first step."""
    ever, nothing = jnp.full_like(old.tprev, jnp.inf), jax.tree.map(jnp.zeros_like, _at_event(old, new))
    return Row(ever, -ever, nothing, steps.start(terms, old, new))


def choice_of(steps: AbstractSteps, old: Any, new: Any) -> Choice:
    """The choices made for the step between two states of an integration."""
    jump = (old.tprev, jnp.asarray(old.made_jump)) if steps.jumps else (None, None)
    chosen = steps.chosen(steps.alone(new.solver_state))
    return Choice(old.tnext, *jump, _at_event(old, new), chosen)


def start_of(steps: AbstractSteps, since: Any, state: Any) -> tuple[Any, Any, PyTree[Array], PyTree[Array]]:
    """The start of a segment: `since` of its first row, its time, the state, and the solver's plain state."""
    return since, state.tprev, state.y, steps.alone(state.solver_state)


def _at_event(old, new):
    before, after = events_found(old.controller_state), events_found(new.controller_state)
    if before is None or after is None:
        return None
    return AtEvent(after.ended, before.count + after.ended.astype(before.count.dtype) > after.count)


def remainder(k: Any, size: int) -> Any:
    """The remainder of a nonnegative number of steps. It is one operation for a power of two, else ten, and every
    kernel that uses it as an index repeats them.
    """
    k = jnp.asarray(k)
    return k & (size - 1) if size & (size - 1) == 0 else lax.rem(k, jnp.asarray(size, k.dtype))


class Segments(eqx.Module):
    """The segments of a run.

    **Fields:** packed `starts` of segments and `choices` of steps, with their layouts; the `layout` of rows.
    """

    starts: list[Array]
    choices: list[Array]
    of_starts: Layout = eqx.field(static=True)
    of_choices: Layout = eqx.field(static=True)
    layout: Layout = eqx.field(static=True)

    def rows(
        self, steps: AbstractSteps, equations: PyTree, segment: Any, count: Any, rows: list[Array], lost: Any
    ) -> list[Array]:
        """The rows of a segment of a run of `count` steps, in these buffers; unchanged where they are not `lost`.

        **Arguments:** `equations`: the terms, their arguments and the solver without tangents.
        """
        terms, args, solver = equations
        steps, size = steps.of_solver_alone(), rows[0].shape[0] - steps.starts
        first = segment * size
        last = jnp.where(lost, jnp.minimum(first + size, count), first)

        def body(carry):
            k, since, t, y, solver_state, rows = carry
            choice = self.of_choices.unpacked([buffer[k] for buffer in self.choices])
            tprev = t if choice.tprev is None else choice.tprev
            made_jump = False if choice.made_jump is None else choice.made_jump
            old = Between(tprev, choice.tnext, y, made_jump, solver_state)
            y, after = steps.again(solver, terms, old.tprev, old.tnext, y, args, solver_state, made_jump)
            if choice.chosen is not None:
                after = eqx.tree_at(steps.chosen, after, choice.chosen)
            row_numbers = steps.row(terms, old, Between(old.tnext, old.tnext, y, made_jump, after))
            packed = self.layout.packed(Row(since, old.tnext, choice.at_event, row_numbers))
            place = remainder(k, size)
            rows = [buffer_set(buffer, place, x) for buffer, x in zip(rows, packed, strict=True)]
            return k + 1, old.tnext, old.tnext, y, after, rows

        start = self.of_starts.unpacked([buffer[segment] for buffer in self.starts])
        carry = while_loop(
            lambda carry: carry[0] < last,
            body,
            (first, *start, rows),
            max_steps=None,
            buffers=lambda carry: carry[-1],
            kind="lax",
        )
        return carry[-1]
