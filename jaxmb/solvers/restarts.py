"""The tangents of a multistep method's start after a jump."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._compat import any_of_batch
from .evaluation import (
    after_jump,
    at_solution,
    chart_after_jump,
    field_of,
    found_at_jump,
    guards_of,
    next_chart,
    ravel,
    unravel_like,
)
from .times import twice_differentiable

# With more numbers than this, states and fields among them, tangents after a jump are computed one at a time.
_MOST_COLUMNS = 256


class AtRestart(eqx.Module):
    """The stored numbers of a restart after a jump.

    **Fields:** `found`: the term's numbers of the jump (`AbstractManifoldTerm.found_at_jump`); `f`: the field after it;
    `kept`: the numbers kept of the chart there.
    """

    found: PyTree[Array]
    f: Float[Array, " n"]
    kept: Any


class Jump(eqx.Module):
    """The stored numbers of a start.

    **Fields:** `made`: whether there was a jump; the times `before` and after it (`time`); the state `y`, the field `f`
    and the `chart` before it; `after`: the numbers after it, None if derivatives compute them again.
    """

    made: Any
    before: Any
    time: Any
    y: Float[Array, " n"]
    f: Float[Array, " n"]
    chart: Any
    after: AtRestart | None


def restarts(
    of, moved, like, jump: Jump, numbers: Callable[..., tuple[Array, ...]]
) -> Callable[..., tuple[Array, ...]]:
    """The tangents of the numbers after a jump, if there was a jump, as a linear function. Its arguments are the
    tangents of the run's numbers, and of the state and the field before the jump.

    **Arguments:** `numbers(field, t, y)`: the raveled state that a method starts from, and its derivatives there.
    """
    n, along_numbers = jump.y.size, sum(x.size for x in jax.tree.leaves(moved))
    guards = guards_of(of(moved.terms)[0])

    def tangents(at_jump, *along):
        restart = functools.partial(_restart, of, like, jump, numbers, at_jump)
        return jax.jvp(restart, (moved, jump.y, jump.f), along)[1]

    def restarted(*along):
        if moved.jumps is None or guards is None:
            return tangents(moved.jumps is not None, *along)
        # The start of a run, or of the motion after an impact, is not at a jump, and nothing precedes the start.
        is_jump = any_of_batch(_is_jump(moved.jumps, jump))
        return lax.cond(is_jump, lambda: tangents(True, *along), lambda: tangents(False, *along))

    still = jax.tree.map(jnp.zeros_like, (moved, jump.y, jump.f))
    blank = [jnp.zeros(x.shape, x.dtype) for x in jax.eval_shape(restarted, *still)]

    def push(dmoved, w, f):
        return lax.cond(any_of_batch(jump.made), lambda: restarted(dmoved, w, f), lambda: tuple(blank))

    columns = along_numbers + 2 * n
    if guards is None or columns > _MOST_COLUMNS:
        return push
    raveled = jax.numpy_dtype_promotion("standard")(ravel_pytree)
    _, unraveled = raveled((moved, jump.y, jump.f))
    # The transpose of a program that finds an event would be a second one of its size; a matrix needs none.
    column = lambda unit: jnp.concatenate(restarted(*unraveled(unit)))
    every = lambda: jax.vmap(column)(jnp.eye(columns, dtype=jump.y.dtype))
    none = jnp.zeros((columns, n * len(blank)), jump.y.dtype)
    matrix = lax.cond(any_of_batch(jump.made), every, lambda: none)

    def push_by_matrix(dmoved, w, f):
        new = raveled((dmoved, w, f))[0].astype(matrix.dtype) @ matrix
        return tuple(jnp.split(new, len(blank)))

    return push_by_matrix


def _restart(of, like, jump, numbers, at_jump, moved, flat, f):
    """The numbers after a restart, from the state and the field before it.

    **Arguments:** `at_jump`: whether the restart may be at a jump whose time has derivatives.
    """
    terms, args, _ = of(moved.terms)
    if not at_jump:
        delay = delayed = None
    else:
        # The jump is delayed by this time, whose value is zero: the state moves on before the jump, and back after it.
        time = moved.jumps[jnp.argmin(jnp.abs(moved.jumps - jump.time))]
        delay = twice_differentiable(time - lax.stop_gradient(time))
        delay = jnp.where(_is_jump(lax.stop_gradient(moved.jumps), jump), delay, 0.0)
        field = field_of(terms, jump.before, unravel_like(like, flat), jump.chart, args)
        flat = _moved_on(lambda t, y: field(t, y)[0][1], jump.before, flat, f, delay)
        delayed = jump.time + delay
    stored, y, time = jump.after, unravel_like(like, flat), jump.time if delayed is None else delayed
    y = after_jump(terms, time, y, found_at_jump(terms, time, y, args) if stored is None else stored.found, args)
    if delay is None and stored is not None:
        return at_solution(terms, jump.time, ravel(y), stored.f, like, stored.kept, args)
    chart = next_chart(terms, jump.time, y, chart_after_jump(terms, jump.chart), args)
    field = field_of(terms, jump.time, y, chart, args)
    if delay is None:
        return numbers(field, jump.time, ravel(y))
    (flat, f), _ = field(delayed, ravel(y))
    flat = _moved_on(lambda t, y: field(t, y)[0][1], delayed, flat, f, -delay)
    return numbers(field, jump.time, flat)


def _is_jump(jumps, jump):
    """Whether a restart is at one of the times of jumps."""
    return jnp.any((jump.before <= jumps) & (jumps <= jump.time)) & (jump.before < jump.time)


def _moved_on(field, t, flat, f, time):
    """A state moved on by a `time` of zero, with the first two derivatives by it; `f`: the field at the state."""
    step = time.astype(flat.dtype)
    return flat + step / 2 * (f + field(t + time, flat + step * f))
