"""A local spline through points, of degree five, with two continuous derivatives, and its integral.

The slope and curvature at each point are those of the parabola through the point and its two neighbours, reduced by one
factor where the spline would overshoot. So points that never fall give a curve that never falls, and likewise for
points that never rise; this also holds between two points if it holds for these and the points beside them. Next to a
highest or a lowest point the curve may pass that point. A value depends on the six nearest points only. Beyond the
first and the last point the spline continues as a straight line.

Proof: with the chord d of an interval of length h the parabola's slope m and curvature c at the left end obey `h c =
2 (d − m)`, and `h c = 2 (m − d)` at the right end. The derivative of the spline is a polynomial of degree four with the
Bernstein coefficients `m₀`, `m₀ + h c₀/4`, `5 d − 2 (m₀ + m₁) + h (c₁ − c₀)/4`, `m₁ − h c₁/4`, `m₁`. With any factors
from 0 to 1 it does not change its sign if both slopes are at most 7/3 d. The bound is the largest: for `m₀ = m₁ =
7/3 d`, not reduced, the derivative vanishes in the middle.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ..linalg.arrays import is_traced

# The largest slope at a point over the slope of the chord, for a curve that does not overshoot.
_STEEPEST = 7 / 3


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
    whole = jax.vmap(lambda k: _integral_of_piece(_piece(x, y, k), 1.0))(all_pieces)
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
    # With two intervals on either side; beyond the ends of the table the last chord continues.
    near = jnp.clip(k + jnp.arange(-2, 3, dtype=k.dtype), 0, x.shape[0] - 2)
    left, right = y[near], y[near + 1]
    lengths = x[near + 1] - x[near]
    chords = (right - left) / lengths
    h, back, ahead = lengths[1:4], chords[1:3], chords[2:4]
    slopes = (back * h[1:] + ahead * h[:-1]) / (h[:-1] + h[1:])
    curvatures = 2 * (ahead - back) / (h[:-1] + h[1:])
    steepest = _steepest(chords)
    most = jnp.minimum(steepest[:-1], steepest[1:])
    steep = jnp.abs(slopes) > most
    factors = jnp.where(steep, most / jnp.where(steep, jnp.abs(slopes), 1.0), 1.0)
    (m0, m1), (c0, c1) = factors * slopes, factors * curvatures
    size, chord = lengths[2], chords[2]
    polynomial = (m0 - chord) * size, (chord - m1) * size, 0.5 * c0 * size * size, 0.5 * c1 * size * size
    return left[2], right[2], size, *polynomial


def _steepest(chords):
    """The largest slopes at the ends of the three intervals in the middle, from the slopes of five chords.

    Where the slopes of an interval and its neighbours differ in sign, it may rise and fall.
    """
    triples = jnp.stack([chords[:-2], chords[1:-1], chords[2:]])
    both = jnp.minimum(jnp.max(triples, axis=0), -jnp.min(triples, axis=0))
    return _STEEPEST * (jnp.abs(chords[1:-1]) + jnp.maximum(both, 0.0))


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
