"""A local spline through points, of degree five, with two continuous derivatives, and its integral.

A value depends on the four nearest points only. The slope and curvature at each point are taken from the parabola
through the point and its two neighbours. Beyond the first and the last point the spline continues as a straight line.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.arrays import is_traced


def check(label: str, names: tuple[str, str], x: Array, y: Array) -> None:
    """Raise a `ValueError` unless x ascends, or is traced, and x and y are vectors of one length, at least 3."""
    if x.ndim != 1 or x.shape[0] < 3 or y.shape != x.shape:
        raise ValueError(
            f"{label}: {names[0]} and {names[1]} must be vectors of the same length, at least 3, got shapes {x.shape} "
            f"and {y.shape}."
        )
    if not is_traced(x) and np.any(np.diff(x) <= 0):
        raise ValueError(f"{label}: {names[0]} must ascend; sort the points and remove repeated ones.")


def value(x: Float[Array, "n"], y: Float[Array, "n"], at: Scalar) -> Float[Array, ""]:
    """The spline through the points (x, y) at a place."""
    k, s = _interval(x, at)
    y0, y1, _, a, b, c, d = _piece(x, y, k)
    r = 1 - s
    inside = y0 + (y1 - y0) * s
    inside += a * s * r**3 * (1 + 3 * s) + b * s**3 * r * (1 + 3 * r) + c * s**2 * r**3 + d * s**3 * r**2
    before, after = at - x[0], at - x[-1]
    first, last = _end_slopes(x, y)
    return inside + jnp.minimum(before, 0.0) * first + jnp.maximum(after, 0.0) * last


def integral(x: Float[Array, "n"], y: Float[Array, "n"], at: Scalar) -> Float[Array, ""]:
    """The integral of `value` from the first point to a place."""
    k, s = _interval(x, at)
    all_pieces = jnp.arange(x.shape[0] - 1, dtype=k.dtype)
    whole = _integral_of_piece(_piece(x, y, all_pieces), 1.0)
    inside = jnp.sum(jnp.where(all_pieces < k, whole, 0.0)) + _integral_of_piece(_piece(x, y, k), s)
    before, after = jnp.minimum(at - x[0], 0.0), jnp.maximum(at - x[-1], 0.0)
    first, last = _end_slopes(x, y)
    return inside + before * (y[0] + 0.5 * before * first) + after * (y[-1] + 0.5 * after * last)


def _interval(x, at):
    """The number of the interval of a place, and the place in it from 0 to 1; of the nearest place within the table."""
    within = jnp.clip(at, x[0], x[-1])
    k = jnp.clip(jnp.searchsorted(x, within, side="right") - 1, 0, x.shape[0] - 2)
    return k, (within - x[k]) / (x[k + 1] - x[k])


def _piece(x, y, k):
    """The values at both ends of an interval, its length, and the polynomial's coefficients by slopes and curvatures at
    both ends: of its difference from the straight line through both points.
    """
    h = x[k + 1] - x[k]
    (y0, m0, c0), (y1, m1, c1) = _at_point(x, y, k), _at_point(x, y, k + 1)
    chord = (y1 - y0) / h
    return y0, y1, h, (m0 - chord) * h, (chord - m1) * h, 0.5 * c0 * h * h, 0.5 * c1 * h * h


def _integral_of_piece(piece, s):
    y0, y1, h, a, b, c, d = piece
    powers = (y0, y1 - y0 + a, c, 4 * b - 6 * a - 3 * c + d, 8 * a - 7 * b + 3 * c - 2 * d, 3 * b - 3 * a - c + d)
    out = jnp.zeros_like(y0)
    for k in reversed(range(6)):
        out = (out + powers[k] / (k + 1)) * s
    return h * out


def _end_slopes(x, y):
    """The slopes of the straight lines beyond the first and the last point."""
    return (y[1] - y[0]) / (x[1] - x[0]), (y[-1] - y[-2]) / (x[-1] - x[-2])


def _at_point(x, y, k):
    """Value, slope and curvature at a point; at the ends of the straight continuation."""
    n = x.shape[0]
    i = jnp.clip(k, 1, n - 2)
    left, right = x[i] - x[i - 1], x[i + 1] - x[i]
    back = (y[i] - y[i - 1]) / left
    ahead = (y[i + 1] - y[i]) / right
    slope = (back * right + ahead * left) / (left + right)
    curvature = 2 * (ahead - back) / (left + right)
    end = (k == 0) | (k == n - 1)
    return y[k], jnp.where(end, jnp.where(k == 0, back, ahead), slope), jnp.where(end, 0.0, curvature)
