"""Directions and relative attitudes that joints, drivers and forces in space share.

Quantities "in A" are components in the axes of the first body of the part.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ...linalg import rotations as rot
from ...linalg.arrays import namespace
from ..resolve import fill, label, unit, vector

Vector3 = Float[Array, "3"]


def perpendiculars(axis: Vector3) -> Float[Array, "2 3"]:
    """Two directions that make a right-handed orthogonal triad `(u, v, axis)`, u of unit length.

    They are worked out from `axis` wherever they are needed, so that derivatives with respect to `axis` are right.
    """
    # The coordinate axis least parallel to `axis` (no single one serves them all): a choice without derivative.
    xp = namespace(axis)
    k = xp.argmin(abs(axis if xp is np else jax.lax.stop_gradient(axis)))
    skew = rot.skew(axis)
    u = (skew * (np.arange(3) == k).astype(axis.dtype)[:, None]).sum(axis=0)
    u = u / xp.sqrt((u * u).sum())
    return xp.stack([u, (skew * u[None, :]).sum(axis=1)])


def direction_in_a(space, poses: Float[Array, "k p"], v_b: Vector3) -> Vector3:
    """Components in A of a direction fixed in B."""
    return space.body_direction(poses[0], space.direction(poses[1], v_b))


def shift_in_a(space, part, poses: Float[Array, "k p"]) -> Vector3:
    """Components in A of `d`, from point A to point B [m]."""
    return space.body_point(poses[0], space.point(poses[1], part.point_b)) - part.point_a


def relative_orientation(poses: Float[Array, "k p"]) -> Float[Array, "4"]:
    """Euler parameters of B relative to A."""
    return rot.multiply(rot.conjugate(poses[0, 3:7]), poses[1, 3:7])


def turn_vector(part, poses: Float[Array, "k p"]) -> Vector3:
    """Twice the vector part of the turn from `part.orientation` to the relative attitude [rad, for small turns]."""
    return 2.0 * rot.multiply(rot.conjugate(part.orientation), relative_orientation(poses))[1:]


def cosine_sine(space, part, poses: Float[Array, "k p"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cosine and sine of the angle from `x_a` to `x_b` about `axis_a`, as products of direction components.

    Only the parts perpendicular to `axis_a` count; the two have a common factor, which is 1 where `x_a` and `x_b` are
    perpendicular to it.
    """
    x = direction_in_a(space, poses, part.x_b)
    y_a = rot.cross(part.axis_a, part.x_a)
    return rot.cross(y_a, part.axis_a) @ x, y_a @ x


def angle(space, part, poses: Float[Array, "k p"]) -> Float[Array, ""]:
    """The angle [rad] from `x_a` to `x_b` about `axis_a`, in (−π, π]; zero where it is undefined."""
    c, s = cosine_sine(space, part, poses)
    defined, xp = c * c + s * s > 0, namespace(c, s)
    return xp.where(defined, xp.arctan2(s, xp.where(defined, c, 1.0)), 0.0)


def resolve_axis(part, space, poses: Float[Array, "k p"]):
    """Fill `axis_a` of a part from its world axis, or check it."""
    if (part.axis is None) == (part.axis_a is None):
        raise ValueError(
            f"{label(part)}: give axis_a (fixed in {part.bodies[0]!r}) or axis (world), and only one of them."
        )
    if part.axis is None:
        axis = unit(part, "axis_a", part.axis_a, 3)
    else:
        axis = space.body_direction(poses[0], unit(part, "axis", part.axis, 3))
    return eqx.tree_at(lambda p: (p.axis_a, p.axis), part, (axis, None), is_leaf=lambda x: x is None)


def resolve_references(part, space, poses: Float[Array, "k p"]):
    """Fill `x_a` and `x_b` so that the angle between them about `axis_a` is zero at the given poses, or check them."""
    if (part.x_a is None) != (part.x_b is None):
        raise ValueError(
            f"{label(part)}: give both x_a and x_b (body-fixed), or neither to measure from the given poses."
        )
    if part.x_a is None:
        x_a, _ = perpendiculars(part.axis_a)
        part = fill(part, "x_a", x_a)
        return fill(part, "x_b", space.body_direction(poses[1], space.direction(poses[0], x_a)))
    x_a, x_b = unit(part, "x_a", part.x_a, 3), unit(part, "x_b", part.x_b, 3)
    if abs(float(x_a @ part.axis_a)) > 1e-6:
        raise ValueError(f"{label(part)}: x_a must be perpendicular to axis_a, got {np.asarray(x_a)}.")
    return eqx.tree_at(lambda p: (p.x_a, p.x_b), part, (x_a, x_b))


def resolve_orientation(part, poses: Float[Array, "k p"]):
    """Fill `orientation`, Euler parameters of B relative to A, with that of the given poses, or check it."""
    if part.orientation is None:
        return fill(part, "orientation", rot.normalize(relative_orientation(poses)))
    return eqx.tree_at(lambda p: p.orientation, part, unit_euler(part, "orientation", part.orientation))


def unit_euler(part, field: str, value: Array) -> Float[Array, "4"]:
    """Check that Euler parameters are of unit length."""
    value = vector(part, field, value, 4)
    length = float(np.linalg.norm(value))
    if abs(length - 1.0) > 1e-6:
        raise ValueError(
            f"{label(part)}: {field} must be unit Euler parameters (e0, e1, e2, e3), scalar first, got "
            f"{np.asarray(value)} of length {length:.6g}; normalise them, or make them with rotations.from_axis_angle."
        )
    return value / length
