"""Runs of more steps than rows are kept of, whose steps are taken again.

Of every step is kept what the step size controller and the error estimates chose, a few numbers, and at the start of
every segment of a run the whole state. The steps of a segment follow from these, without error estimates and without
the tangents whose errors were controlled.
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
    """Whether a step ends at an event (`here`), and whether the one at which it starts is `void`: nothing changed."""

    here: Any
    void: Any


class Row(NamedTuple):
    """What is stored of a step, or of the start of a run, in which no time lies.

    **Fields:** the end of the last step, which is the start of this one unless there was a jump, and minus infinity
    before the first; the `end` of this one; what is known of events there, None in a run that
    looks for none (`AbstractGuards`); what its linearisation needs, its `own`.
    """

    since: Any
    end: Any
    at_event: Any
    own: Any


class Choice(NamedTuple):
    """What was chosen for a step.

    **Fields:** its end `tnext`, its start `tprev`, and whether it `made_jump`, as in the states of diffrax's loop;
    where steps have no jumps, the last two are None, since it starts where the last one ended; `at_event` of its row;
    what its error estimate has `chosen` for the next step.
    """

    tnext: Any
    tprev: Any
    made_jump: Any
    at_event: Any
    chosen: PyTree[Array]


class Between(NamedTuple):
    """The parts of a state of diffrax's loop that steps are made of."""

    tprev: Any
    tnext: Any
    y: PyTree[Array]
    made_jump: Any
    solver_state: PyTree[Array]


def row_of(steps: AbstractSteps, terms: PyTree, since: Any, old: Any, new: Any) -> Row:
    """The row of the step between two states of diffrax's loop; `since`: the end of the last step before it."""
    return Row(since, old.tnext, _at_event(old, new), steps.row(terms, old, new))


def first_of(steps: AbstractSteps, terms: PyTree, old: Any, new: Any) -> Row:
    """The row of the start of a run, in which no time lies, from the states before and after its first step."""
    ever, nothing = jnp.full_like(old.tprev, jnp.inf), jax.tree.map(jnp.zeros_like, _at_event(old, new))
    return Row(ever, -ever, nothing, steps.start(terms, old, new))


def choice_of(steps: AbstractSteps, old: Any, new: Any) -> Choice:
    """What was chosen for the same step."""
    jump = (old.tprev, jnp.asarray(old.made_jump)) if steps.jumps else (None, None)
    chosen = steps.chosen(steps.alone(new.solver_state))
    return Choice(old.tnext, *jump, _at_event(old, new), chosen)


def start_of(steps: AbstractSteps, since: Any, state: Any) -> tuple[Any, Any, PyTree[Array], PyTree[Array]]:
    """What a segment starts with: `since` of its first row, its time, the state, and that of the solver itself."""
    return since, state.tprev, state.y, steps.alone(state.solver_state)


def _at_event(old, new):
    before, after = events_found(old.controller_state), events_found(new.controller_state)
    if before is None or after is None:
        return None
    return AtEvent(after.ended, before.count + after.ended.astype(before.count.dtype) > after.count)


def remainder(k: Any, size: int) -> Any:
    """The remainder of a number of steps, which is not negative: for any number it is ten operations, by a power of two
    one, and each kernel repeats them that uses it as an index.
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
        """The rows of a segment of a run of `count` steps, in these buffers; where they are not `lost`, the same.

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
            y, _, _, after, _ = solver.step(terms, old.tprev, old.tnext, y, args, solver_state, made_jump)
            if choice.chosen is not None:
                after = eqx.tree_at(steps.chosen, after, choice.chosen)
            own = steps.row(terms, old, Between(old.tnext, old.tnext, y, made_jump, after))
            packed = self.layout.packed(Row(since, old.tnext, choice.at_event, own))
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
