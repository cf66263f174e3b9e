"""Straight parts of ropes, tangents of the circles of two pulleys; a point is a circle of radius zero."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from ..linalg.arrays import namespace
from ..linalg.rotations import cross


def tangent_lines(
    between: Float[Array, "n d"], offsets: Float[Array, "n"], axes: Float[Array, "n 3"] | None
) -> tuple[Float[Array, "n"], Float[Array, "n d"]]:
    """Lengths of tangents [m], and unit vectors along them in the planes of the circles. NumPy in, NumPy out.

    **Arguments:** vectors `between` the centres [m]; `offsets` [m]: the radius of the second circle less that of the
    first one, negative where the rope turns right; in space the unit vectors `axes` of the circles.

    Circles without a common tangent, and points in a circle, give NaN.
    """
    lines = _lines.fun if namespace(between, offsets) is np else _lines
    with np.errstate(invalid="ignore", divide="ignore"):
        return lines(between, offsets, axes)


def quarter_turn(v: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    """Vectors of the plane, turned counter-clockwise."""
    return namespace(v).stack([-v[:, 1], v[:, 0]], axis=1)


def _dots(a, b):
    return namespace(a, b).sum(a * b, axis=1, keepdims=True)


def _left(axes, v):
    """Vectors of the planes of circles, turned by a quarter turn to the left."""
    return quarter_turn(v) if axes is None else cross(axes, v)


def _in_plane(between, axes):
    """The parts of vectors in the planes of circles, and beside them."""
    if axes is None:
        return between, 0.0
    beside = _dots(between, axes)
    return between - beside * axes, beside


@jax.custom_jvp
def _lines(between, offsets, axes):
    xp = namespace(between, offsets)
    flat, beside = _in_plane(between, axes)
    square, more = _dots(flat, flat), offsets[:, None]
    length = xp.sqrt(square - more**2)
    # The rope is to the right of the centre of a pulley on which it turns left.
    along = (length * flat - more * _left(axes, flat)) / square
    return (length if axes is None else xp.sqrt(length**2 + beside**2))[:, 0], along


def _derivatives(primals, rates):
    """From the turn of the tangents, with fewer operations than from the root and the quotient."""
    (between, offsets, axes), (moved, changed, tilted) = primals, rates
    lengths, along = _lines(*primals)
    left, length, more = _left(axes, along), _dots(along, between), offsets[:, None]
    moved = jnp.zeros_like(between) if isinstance(moved, SymbolicZero) else moved
    changed = 0.0 if isinstance(changed, SymbolicZero) else changed[:, None]
    if axes is None:
        turned = (_dots(left, moved) - changed) / length
        return (lengths, along), ((_dots(along, moved) + more * turned)[:, 0], turned * left)
    tilted = jnp.zeros_like(axes) if isinstance(tilted, SymbolicZero) else tilted
    beside = _dots(between, axes)
    in_plane = moved - beside * tilted
    turned = (_dots(left, in_plane) - changed) / length
    rate, rate_beside = _dots(along, in_plane) + more * turned, _dots(moved, axes) + _dots(between, tilted)
    along_rate = turned * left - _dots(along, tilted) * axes
    return (lengths, along), (((length * rate + beside * rate_beside) / lengths[:, None])[:, 0], along_rate)


_lines.defjvp(_derivatives, symbolic_zeros=True)
