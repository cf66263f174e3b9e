"""Turns and pulses of functions of time, known by samples.

A function turns where it has made an excursion that is large in comparison with its range. A pulse is judged by the
values beside it: if these follow a cubic polynomial over three times its width, a step that ends there shows nothing of
the pulse.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

# The largest excursion of a function that may be missed between two steps, relative to its range.
_HIDDEN = 0.1
# A value is that of a pulse if it differs from the polynomial this many times more than the values beside the pulse.
_STANDS_OUT = 8.0
# Differences below this many units in the last place of the largest value are rounding errors.
_ROUNDING = 64
# The places of the values beside a pulse, in units of its half width; the unmet part of these values and, in the last
# row, the value in their middle, by the cubic polynomial nearest to them.
_BESIDE = np.array([-3.0, -2.5, -2.0, -1.5, -1.0, 1.0, 1.5, 2.0, 2.5, 3.0])
_POWERS = np.vander(_BESIDE, 4)
_FIT = np.linalg.pinv(_POWERS)
_POLYNOMIAL = np.concatenate([np.eye(_BESIDE.size) - _POWERS @ _FIT, _FIT[-1:]])
# Half widths of pulses, in samples of a function. Even numbers, so that the values beside are at samples.
_WIDTHS = np.array([2, 4, 6, 8, 12, 16, 24, 32, 48, 64])
# Functions that are judged at the same time.
_TOGETHER = 64

# The half width of a pulse at each time, and the values beside it.
Beside = tuple[Float[Array, "n"], Float[Array, "n 10 columns"]]


def turned(values: Float[Array, "n columns"]) -> Bool[Array, "n"]:
    """At which values some column has turned since the last turn: its path is longer than the net change."""
    range_ = jnp.max(values, axis=0) - jnp.min(values, axis=0)
    rounding = 16 * jnp.finfo(values.dtype).eps * jnp.max(jnp.abs(values), axis=0)
    most = jnp.where(range_ > rounding, _HIDDEN * range_, jnp.inf)

    def passed(carry, value):
        start, before, way = carry
        step = jnp.abs(value - before)
        turned = jnp.any(way + step - jnp.abs(value - start) > most)
        return (jnp.where(turned, before, start), value, jnp.where(turned, step, way + step)), turned

    before = lax.scan(passed, (values[0], values[0], jnp.zeros_like(most)), values[1:])[1]
    return jnp.append(before, False)


def pulses_of_samples(
    ts: Float[Array, "n"], values: Float[Array, "n columns"], ended: Bool[Array, "n"]
) -> Bool[Array, "n"]:
    """At which of equidistant times some column is at the peak of a pulse; or where steps are `ended` anyway."""
    # Other states than those of the run may make a function infinite.
    values = jnp.where(jnp.all(jnp.isfinite(values), axis=0), values, 0.0)
    (n, columns), most = values.shape, int(np.max(_WIDTHS * _BESIDE[-1]))
    together = min(columns, _TOGETHER)
    blocks = jnp.pad(values, ((0, 0), (0, -columns % together))).reshape(n, -1, together)
    places = jnp.arange(n)[:, None] + most

    def of_block(ended, block):
        before, after = 2 * block[0] - block[most:0:-1], 2 * block[-1] - block[-2 : -most - 2 : -1]
        extended = jnp.concatenate([before, block, after])

        def beside(width):
            offsets = (width * (2 * _BESIDE).astype(int)) // 2
            return jnp.broadcast_to(width * (ts[1] - ts[0]), ts.shape), extended[places + offsets]

        return _pulses(ts, block, beside, jnp.asarray(_WIDTHS), ended), None

    return lax.scan(of_block, ended, jnp.moveaxis(blocks, 1, 0))[0]


def pulses_at_knots(
    ts: Float[Array, "n"], function: Callable[[Any], Array], span: tuple[Any, Any], ended: Bool[Array, "n"]
) -> Bool[Array, "n"]:
    """At which of its knots a series is at the peak of a pulse; or where steps are `ended` anyway.

    **Arguments:** `function`: the values, of columns, at some times; `span`: the first and the last time of a run.
    """
    n, (first, last) = ts.shape[0], span
    # Wider pulses of long series are seen in samples.
    widest = min(max(n // 3, 1), max(8, n // 128))
    reaches = 2 ** np.arange(int(np.log2(widest)) + 1)
    at_ends, known = function(jnp.stack([first, last])), function(jnp.clip(ts, first, last))

    def beside(reach):
        knots = jnp.clip(jnp.arange(n) + reach, 0, n - 1)
        width = jnp.abs(ts[knots] - ts)
        at = ts[:, None] + width[:, None] * _BESIDE.astype(ts.dtype)
        inside = jnp.clip(jnp.where(at < first, 2 * first - at, jnp.where(at > last, 2 * last - at, at)), first, last)
        values = function(inside.reshape(-1)).reshape(*at.shape, -1)
        early, late = (at < first)[..., None], (at > last)[..., None]
        return width, jnp.where(early, 2 * at_ends[0] - values, jnp.where(late, 2 * at_ends[1] - values, values))

    return _pulses(ts, known, beside, jnp.asarray(np.concatenate([reaches, -reaches])), ended)


def on_straight_lines(ts: Float[Array, "n"], values: Float[Array, "n columns"]) -> Bool[Array, "n"]:
    """At which times some column is on the straight line through the values before and after."""
    middle = ((ts[1:-1] - ts[:-2]) / (ts[2:] - ts[:-2]))[:, None]
    off = jnp.abs(values[1:-1] - values[:-2] - middle * (values[2:] - values[:-2]))
    return jnp.pad(jnp.any(off <= _rounding(values), axis=1), 1)


def _pulses(ts, values, beside: Callable[[Any], Beside], widths, ended):
    """At which times some column is at the peak of a pulse of one of the widths; or where steps are `ended` anyway."""
    rounding, polynomial = _rounding(values), _POLYNOMIAL.astype(values.dtype)

    def look(ended, of_width):
        half, around = beside(of_width)
        out = jnp.einsum("kj,njc->knc", polynomial, around)
        height = jnp.abs(values - out[-1])
        stands_out = height > _STANDS_OUT * jnp.max(jnp.abs(out[:-1]), axis=0) + rounding
        height = jnp.where(stands_out, height, 0.0)
        highest = jnp.max(height, axis=0)
        relative = jnp.max(height / jnp.where(highest > 0, highest, 1.0), axis=1)
        padded = jnp.pad(relative, 1)
        peak = (relative > padded[:-2]) & (relative >= padded[2:])
        # A step that ends near the peak shows the pulse.
        count = jnp.cumsum(jnp.pad(ended, (1, 0)).astype(int))
        near = lambda time, side: count[jnp.searchsorted(ts, time, side=side)]
        shown = near(ts + 0.5 * half, "right") > near(ts - 0.5 * half, "left")
        return ended | (peak & ~shown), None

    return lax.scan(look, ended, widths)[0]


def _rounding(values):
    return _ROUNDING * jnp.finfo(values.dtype).eps * jnp.max(jnp.abs(values), axis=0)
