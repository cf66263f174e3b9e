"""Turning what a user may give (world points and axes) into what kernels need (body-fixed ones), with checks that name
the part.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .base import AbstractPart, number
from .space import AbstractSpace


def label(part: AbstractPart) -> str:
    """How messages call a part."""
    return f"{type(part).__name__} {part.name!r}"


def vector(part: AbstractPart, field: str, value: Array, size: int) -> Float[Array, "size"]:
    """Check shape and finiteness of a vector field."""
    if value.shape != (size,):
        raise ValueError(f"{label(part)}: {field} must have shape ({size},), got {value.shape}.")
    if not np.all(np.isfinite(value)):
        raise ValueError(f"{label(part)}: {field} must be finite, got {np.asarray(value)}.")
    return value


def unit(part: AbstractPart, field: str, value: Array, size: int) -> Float[Array, "size"]:
    """Check that a vector is of unit length."""
    value = vector(part, field, value, size)
    length = float(np.linalg.norm(value))
    if abs(length - 1.0) > 1e-6:
        fix = "divide it by its length" if length > 0 else "give a direction"
        raise ValueError(
            f"{label(part)}: {field} must be a unit vector, got {np.asarray(value)} of length {length:.6g}; {fix}."
        )
    return value / length


def point_pair(part, space: AbstractSpace, poses: Float[Array, "k p"]):
    """Fill `point_a` and `point_b` of a two-body part from its world point, or check them."""
    if part.point is not None:
        if part.point_a is not None or part.point_b is not None:
            raise ValueError(f"{label(part)}: give either point (world) or point_a and point_b (body-fixed), not both.")
        point = vector(part, "point", part.point, space.dimension)
        points = (space.body_point(poses[0], point), space.body_point(poses[1], point))
    else:
        if part.point_a is None or part.point_b is None:
            raise ValueError(f"{label(part)}: give point_a and point_b (body-fixed), or point (world).")
        points = (
            vector(part, "point_a", part.point_a, space.dimension),
            vector(part, "point_b", part.point_b, space.dimension),
        )
    return eqx.tree_at(lambda p: (p.point_a, p.point_b, p.point), part, (*points, None), is_leaf=lambda x: x is None)


def axis_pair(part, space: AbstractSpace, poses: Float[Array, "k p"]):
    """Fill `axis_a` and `axis_b` of a two-body part from its world axis, or check them."""
    if part.axis is not None:
        if part.axis_a is not None or part.axis_b is not None:
            raise ValueError(f"{label(part)}: give either axis (world) or axis_a and axis_b (body-fixed), not both.")
        axis = unit(part, "axis", part.axis, space.dimension)
        axes = (space.body_direction(poses[0], axis), space.body_direction(poses[1], axis))
    else:
        if part.axis_a is None or part.axis_b is None:
            raise ValueError(f"{label(part)}: give axis_a and axis_b (body-fixed), or axis (world).")
        axes = (
            unit(part, "axis_a", part.axis_a, space.dimension),
            unit(part, "axis_b", part.axis_b, space.dimension),
        )
    return eqx.tree_at(lambda p: (p.axis_a, p.axis_b, p.axis), part, (*axes, None), is_leaf=lambda x: x is None)


def fill(part, field: str, value: ArrayLike):
    """Give a missing number its value at the given poses."""
    if getattr(part, field) is None:
        part = eqx.tree_at(lambda p: getattr(p, field), part, number(value), is_leaf=lambda x: x is None)
    return part


def positive(part: AbstractPart, field: str, value: Array, *, zero: bool = False) -> None:
    """Check the sign of a number or of every component of an array."""
    given = np.asarray(value)
    if not np.all(np.isfinite(given)) or np.any(given < 0) or (not zero and np.any(given == 0)):
        raise ValueError(f"{label(part)}: {field} must be {'non-negative' if zero else 'positive'}, got {given}.")
