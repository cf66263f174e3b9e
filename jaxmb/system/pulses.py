"""Turns and pulses of functions of time, known by samples.

A function turns where it has made an excursion that is large in comparison with its range. A pulse is judged by the
values beside it: if these follow a cubic polynomial over three times its width, a step that ends there shows nothing of
the pulse.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._types import Scalar

# The largest excursion of a function that may be missed between two steps, relative to its range.
_HIDDEN = 0.1
# A value is that of a pulse if it differs from the polynomial this many times more than the values beside the pulse.
# Beside a pulse at a knot few values of a series differ, so it must stand out more.
_STANDS_OUT, _AT_KNOTS = 4.0, 16.0
# Differences below this many units in the last place of the largest value are rounding errors.
_ROUNDING = 64
# The places of the values on either side of a pulse, in units of its half width; irregular, so that no wave looks alike
# at all of them.
_BESIDE = np.array([1.0, 1.27, 1.6, 1.9, 2.13, 2.61, 3.0])
# Half widths of pulses, in samples of a function.
_WIDTHS = np.array([2, 3, 4, 6, 9, 13, 20, 30, 45, 64])
# The most segments of a piecewise linear function within a pulse between two segments on one line.
_SEGMENTS = 8
# Functions that are judged at the same time.
_TOGETHER = 64


def _rows(places):
    """In the rows: how far values at some places are off the nearest cubic polynomial, in ten directions, and the
    polynomial's value at zero.
    """
    powers = np.vander(places / np.max(places), 4)
    return np.concatenate([np.linalg.svd(powers)[0][:, 4:].T, np.linalg.pinv(powers)[-1:]])


def _both_sides(places):
    return np.concatenate([-places[::-1], places])


def _offsets(width):
    """The places beside a pulse of samples, as whole numbers that differ."""
    nearest, order = np.round(width * _BESIDE).astype(int), np.arange(_BESIDE.size)
    return _both_sides(np.maximum.accumulate(nearest - order) + order)


_OFFSETS = np.array([_offsets(width) for width in _WIDTHS])


class _Beside(NamedTuple):
    """The half `width` of a pulse around each time; the `values` beside it; the `rows` of the polynomial."""

    width: Float[Array, "n"]
    values: Float[Array, "14 n columns"]
    rows: Float[Array, "11 14"]


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
    values = jnp.where(jnp.all(jnp.isfinite(values), axis=0, keepdims=True), values, 0.0)
    (n, columns), most = values.shape, int(np.max(_OFFSETS))
    together = min(columns, _TOGETHER)
    blocks = jnp.pad(values, ((0, 0), (0, -columns % together))).reshape(n, -1, together)
    rows = np.array([_rows(offsets) for offsets in _OFFSETS]).astype(values.dtype)

    def of_block(ended, block):
        before, after = 2 * block[:1] - block[most:0:-1], 2 * block[-1:] - block[-2 : -most - 2 : -1]
        extended = jnp.concatenate([before, block, after])

        def beside(of_width):
            width, offsets, rows = of_width
            places = offsets[:, None] + jnp.arange(most, most + n)[None]
            return _Beside(width * jnp.full_like(ts, ts[1] - ts[0]), extended[places], rows)

        widths = jnp.asarray(_WIDTHS, ts.dtype), jnp.asarray(_OFFSETS), jnp.asarray(rows)
        return _pulses(ts, block, beside, widths, ended, _STANDS_OUT), None

    return lax.scan(of_block, ended, jnp.moveaxis(blocks, 1, 0))[0]


def pulses_at_knots(
    ts: Float[Array, "n"],
    values: Float[Array, "n columns"],
    sampled: tuple[Float[Array, "m"], Float[Array, "m columns"]],
    function: Callable[[Any], Array],
    ended: Bool[Array, "n"],
) -> Bool[Array, "n"]:
    """At which of its knots a series is at the peak of a pulse; or where steps are `ended` anyway.

    **Arguments:** `sampled`: times from the first to the last one of a run, and the values then; `function`: the values
    at some times.
    """
    n, first, last = ts.shape[0], sampled[0][0], sampled[0][-1]
    # Wider pulses of long series are seen in samples.
    widest = min(max(n // 3, 1), max(8, n // 128))
    reaches = 2 ** np.arange(int(np.log2(widest)) + 1)
    before, after = 2 * sampled[1][0][None, None], 2 * sampled[1][-1][None, None]
    sides = _both_sides(_BESIDE)
    rows = jnp.asarray(_rows(sides), values.dtype)

    def beside(reach):
        knots = jnp.clip(jnp.arange(n) + reach, 0, n - 1)
        width = jnp.abs(ts[knots] - ts)
        at = ts[None] + width[None] * jnp.asarray(sides, ts.dtype)[:, None]
        inside = jnp.clip(jnp.where(at < first, 2 * first - at, jnp.where(at > last, 2 * last - at, at)), first, last)
        around = function(inside.reshape(-1)).reshape(*at.shape, -1)
        early, late = (at < first)[..., None], (at > last)[..., None]
        return _Beside(width, jnp.where(early, before - around, jnp.where(late, after - around, around)), rows)

    return _pulses(ts, values, beside, jnp.asarray(np.concatenate([reaches, -reaches])), ended, _AT_KNOTS)


def between_segments_on_one_line(
    ts: Float[Array, "n"], values: Float[Array, "n columns"], first: Scalar, last: Scalar
) -> Bool[Array, "n"]:
    """At which of its knots a piecewise linear function is at the peak of a pulse between two segments on one line.

    A step that passes both segments shows nothing of the pulse. `first` and `last` are the ends of a run; beyond them
    there are no segments, and `values` are those at the ends.
    """
    n, ts = ts.shape[0], jnp.clip(ts, first, last)
    gaps = (ts[1:] - ts[:-1])[:, None]
    slopes = (values[1:] - values[:-1]) / jnp.where(gaps > 0, gaps, 1.0)
    beyond = ((ts <= first) | (ts >= last))[:, None]
    left, within = jnp.arange(n), np.arange(1, _SEGMENTS)[:, None]

    def look(peaks, segments):
        right = jnp.minimum(left + segments, n - 1)
        rise, width = values[right] - values[left], (ts[right] - ts[left])[:, None]
        off_before = jnp.where(beyond[left], 0.0, jnp.abs(rise - width * slopes[jnp.maximum(left - 1, 0)]))
        off_after = jnp.where(beyond[right], 0.0, jnp.abs(rise - width * slopes[jnp.minimum(right, n - 2)]))
        slope = rise / jnp.where(width > 0, width, 1.0)
        inner = jnp.minimum(left[None] + within, right[None])
        lengths = (ts[inner] - ts[left][None])[..., None]
        heights = jnp.abs(values[inner] - values[left][None] - lengths * slope[None])
        stands_out = jnp.max(heights, axis=0) > _AT_KNOTS * (off_before + off_after) + _rounding(values)
        highest = left[:, None] + 1 + jnp.argmax(heights, axis=0)
        return peaks.at[jnp.where(stands_out, highest, n)].set(True, mode="drop"), None

    return lax.scan(look, jnp.zeros(n, bool), jnp.arange(2, _SEGMENTS + 1))[0]


def on_straight_lines(ts: Float[Array, "n"], values: Float[Array, "n columns"]) -> Bool[Array, "n"]:
    """At which times some column is on the straight line through the values before and after."""
    middle = ((ts[1:-1] - ts[:-2]) / (ts[2:] - ts[:-2]))[:, None]
    off = jnp.abs(values[1:-1] - values[:-2] - middle * (values[2:] - values[:-2]))
    return jnp.pad(jnp.any(off <= _rounding(values), axis=1), 1)


def _pulses(ts, values, beside: Callable[[Any], _Beside], widths, ended, most):
    """At which times some column is at the peak of a pulse of one of the widths; or where steps are `ended` anyway."""
    rounding = _rounding(values)

    def look(ended, of_width):
        width, around, rows = beside(of_width)
        out = jnp.tensordot(rows, around, 1)
        height = jnp.abs(values - out[-1])
        stands_out = height > most * jnp.sqrt(jnp.sum(out[:-1] ** 2, axis=0)) + rounding
        height = jnp.where(stands_out, height, 0.0)
        highest = jnp.max(height, axis=0, keepdims=True)
        relative = jnp.max(height / jnp.where(highest > 0, highest, 1.0), axis=1)
        padded = jnp.pad(relative, 1)
        peak = (relative > padded[:-2]) & (relative >= padded[2:])
        # A step that ends near the peak shows the pulse.
        before = lax.cummax(jnp.where(ended, ts, -jnp.inf))
        after = lax.cummin(jnp.where(ended, ts, jnp.inf), reverse=True)
        shown = jnp.minimum(ts - before, after - ts) <= 0.5 * width
        return ended | (peak & ~shown), None

    return lax.scan(look, ended, widths)[0]


def _rounding(values):
    return _ROUNDING * jnp.finfo(values.dtype).eps * jnp.max(jnp.abs(values), axis=0, keepdims=True)
