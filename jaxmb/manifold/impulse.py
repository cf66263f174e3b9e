"""Jumps of prescribed rates: the velocities after them, and a search for jumps."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from .._types import Coordinates, Scalar, State
from ..contacts.guards import ContactGuards
from ..contacts.impacting import Event
from ..solvers.directed import next_number
from ..system.equation import AbstractEquation
from ..system.instant import Instant
from .orthogonal_projection import project_velocities

# Jumps are searched in this number of intervals in all, and in at least the second number between two restarts.
_INTERVALS, _FEWEST = 256, 16
# Each row's least smooth place between two restarts is followed, up to this number of places, the likeliest jumps
# first. The program follows some at once.
_PLACES, _AT_ONCE = 64, 8
# A place is divided into this number of parts, and three of them are kept, this number of times: down to rounding.
_PARTS, _ROUNDS = 8, 38
# Variations smaller than these fractions of the largest value, of their row and of all rows, are ignored.
_VISIBLE, _ROUNDED = 1e-6, 1e-11
# At a jump the second difference of the changes is at least the first fraction of the largest change. At least the
# second fraction of that change remains in the end; of a smooth function next to nothing remains.
_UNEVEN, _LEFT = 0.02, 0.01
# Rows are examined at this number of configurations beside the state's.
_OTHERS = 2


def after_jumps(
    t: Float[Array, "*batch"], jumps: Float[Array, "jumps"], t0: Scalar, t1: Scalar
) -> Float[Array, "*batch"]:
    """Times of a run from `t0` to `t1`, with the next number for times at jumps, and the previous number for the last
    time; the derivative is one.

    They are then on the same side of a jump as the states of a solver that stops just before and restarts just after.
    """
    fixed = lax.stop_gradient(t)
    at_jump = jnp.isin(fixed, jumps, method="binary_search")
    # A run backward from a jump begins at the number before the jump, which is then the last time of the run. A run
    # without steps has one time.
    last, earlier = jnp.maximum(t0, t1), next_number(fixed, -1)
    at_end = ((fixed == last) | (earlier == last)) & (t0 != t1)
    moved = jnp.where(at_end, earlier, jnp.where(at_jump, next_number(fixed, 1), fixed))
    return t + (moved - fixed)


def after_impulse(system: AbstractEquation, t: Scalar, y: State) -> State:
    """The state just after a time at which prescribed rates jump: `M (u⁺ − u⁻) = Aᵀ Λ`, `ψ(t, q, u⁺) = 0`.

    If no rate jumps, the impulses Λ are zero. Constraints are taken as ideal. Velocities are NaN if Newton's method
    fails, as it can for constraints that are not linear in the velocities.

    Source: L. A. Pars, "A Treatise on Analytical Dynamics", Heinemann, 1965 (impulsive motion).
    """
    at = Instant.of(system, t, y)
    u, failed = project_velocities(at, at.inertia)
    return dataclasses.replace(y, u=jnp.where(failed, jnp.nan, u))


def found_at_jump(guards: ContactGuards | None, t: Scalar, y: State) -> Event | None:
    """The event of contacts that close or open at a jump; None without contacts."""
    return None if guards is None else guards.event(t, y)


def after_jump(
    system: AbstractEquation, guards: ContactGuards | None, t: Scalar, y: State, event: Event | None = None
) -> State:
    """The state after prescribed rates have jumped, or contacts closed or opened.

    **Arguments:** `guards`: None without contacts; `event`: the event, if it is known.
    """
    return after_impulse(system, t, y) if guards is None else guards.impact(t, y, event=event).after


class Jump(NamedTuple):
    """A jump of a prescribed rate or of its derivative.

    **Fields:** `t`: the first time after it [s], in the precision of the state; `row`: the index of its row among the
    rows of ψ followed by the rows of A.
    """

    t: np.floating
    row: int


def find_jumps(
    system: AbstractEquation, q: Coordinates, t0: Scalar, t1: Scalar, restarts: Float[ArrayLike, "times"]
) -> list[Jump]:
    """Search for times between `t0` and `t1` at which prescribed rates, or their derivatives, jump.

    Each row is examined between each two neighbouring `restarts`. The place with the least even changes in equal
    intervals is divided, and the least even part is followed, again and again. A smooth function becomes even, a jump
    does not. At most one jump of a row is found between two restarts.

    Coordinates are the same at all times. An angle's row wraps where the prescribed angle is half a turn away from the
    coordinates, and its rates jump there. With other coordinates it wraps at other times, but prescribed rates jump at
    the same times. So a place counts only if it is uneven with all of several coordinates. Kinks of an angle in space
    that makes a turn in fewer than about 20 intervals may be missed.
    """
    dtype = q.dtype
    first, last = sorted((np.asarray(t0, dtype), np.asarray(t1, dtype)))
    inside = np.unique(np.asarray(restarts, dtype))
    inside = inside[(inside > first) & (inside < last)]
    # A restart is not part of the intervals beside it.
    starts = np.append(first, np.nextafter(inside, np.array(np.inf, dtype)))
    ends = np.append(np.nextafter(inside, np.array(-np.inf, dtype)), last)
    count = max(_INTERVALS // starts.size, _FEWEST)
    shifts = np.random.default_rng(0).standard_normal((_OTHERS, q.size)).astype(dtype)
    shifts = np.concatenate([np.zeros_like(shifts[:1]), shifts])
    by_shift = [np.asarray(_unevenness(system, q, shift, starts, ends, count)) for shift in shifts]
    # With some coordinates a row may not be defined.
    uneven = np.nan_to_num(np.fmin.reduce(by_shift))
    likeness, k = np.max(uneven, axis=1), np.argmax(uneven, axis=1) + 1
    between, rows = np.nonzero(likeness > _UNEVEN)
    order = np.argsort(-likeness[between, rows], kind="stable")[:_PLACES]
    between, rows = between[order], rows[order]
    width = (ends[between] - starts[between]) / count
    at = starts[between] + k[between, rows] * width
    a, b = np.maximum(at - width, starts[between]), np.minimum(at + 2 * width, ends[between])
    all_jumps = []
    for n in range(0, rows.size, _AT_ONCE):
        several = slice(n, n + _AT_ONCE)
        batch = [np.resize(x[several], _AT_ONCE) for x in (a.astype(dtype), b.astype(dtype), rows)]
        times, jumps = (np.asarray(x)[: rows[several].size] for x in _followed(system, q, shifts, *batch))
        all_jumps += [Jump(t, int(row)) for t, jump, row in zip(times, jumps, rows[several], strict=True) if jump]
    return sorted(all_jumps)


def _prescribed(system, q, shift, t):
    """The residuals of ψ and A where nothing moves, with shifted coordinates."""
    rest = jnp.zeros(system.nu, q.dtype)
    at = Instant(system, t, system.normalize(t, q + system.coordinate_scale() * shift), rest)
    return jnp.concatenate([at.velocity_residual, at.acceleration_residual(rest)])


@eqx.filter_jit
def _unevenness(system, q, shift, starts, ends, count):
    """The likeness of each row to a jump in each interval, between all restarts."""
    share = jnp.arange(count + 1, dtype=q.dtype) / count
    grid = starts[:, None] + (ends - starts)[:, None] * share[None]
    values = lax.map(jax.vmap(lambda t: _prescribed(system, q, shift, t)), grid)
    changes = jnp.diff(values, axis=1)
    largest = jnp.max(jnp.abs(changes), axis=1)
    sizes = jnp.max(jnp.abs(values), axis=(0, 1))
    visible = (largest > _VISIBLE * sizes[None]) & (largest > _ROUNDED * jnp.max(sizes))
    return jnp.abs(jnp.diff(changes, n=2, axis=1)) / jnp.where(visible, largest, jnp.inf)[:, None]


@eqx.filter_jit
def _followed(system, q, shifts, starts, ends, rows):
    """The times at which rows jump between given times, and whether they do."""
    share = jnp.arange(_PARTS + 1, dtype=q.dtype) / _PARTS

    def follow(a, b, row):
        def values(a, b):
            grid = a + (b - a) * share
            at = lambda shift, t: _prescribed(system, q, shift, t)[row]
            return grid, jax.vmap(lambda shift: jax.vmap(lambda t: at(shift, t))(grid))(shifts)

        largest = jnp.max(jnp.abs(jnp.diff(values(a, b)[1])), axis=1, keepdims=True)
        largest = jnp.where(largest > 0, largest, jnp.inf)
        least = lambda changes: jnp.nan_to_num(jnp.nanmin(jnp.abs(changes) / largest, axis=0))

        def narrow(_, ends):
            grid, rows_there = values(*ends)
            k = jnp.argmax(least(jnp.diff(rows_there, n=3)))
            return grid[k], grid[k + 3]

        grid, rows_there = values(*lax.fori_loop(0, _ROUNDS, narrow, (a, b)))
        remaining = least(jnp.diff(rows_there))
        k = jnp.argmax(remaining)
        return grid[k + 1], remaining[k] > _LEFT

    return jax.vmap(follow)(starts, ends, rows)
