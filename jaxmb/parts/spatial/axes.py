"""Directions and relative attitudes, shared by spatial joints, drivers and forces.

Quantities "in A" are components in the axes of the first body of the part.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from ...linalg import rotations as rot
from ...linalg.arrays import add_up, namespace
from ...linalg.roots import reciprocal_root
from ..elements import Product, perpendicular

Vector3 = Float[Array, "3"]
# The kind of elementary joint of a coordinate, by its quantity.
_KINDS = {"angle": "hinge", "length": "slide", "rotation": "ball"}

# Angles nearer to half a turn than 0.1 rad count as opposite, by their cosine plus one.
_OPPOSITE = 0.005


class ElementaryJoint(NamedTuple):
    """A `"hinge"`, `"slide"` or `"ball"` in a joint: the `name` and the `value` of its coordinate, a `point` [m] on it
    and its `axis` in the world, zero for a ball.
    """

    kind: str
    name: str
    point: Any
    axis: Any
    value: Any


def joints_through_b(space, part, poses: Float[Array, "2 p"], **axes: Any) -> list[ElementaryJoint]:
    """The elementary joints of a joint, all through its point B; their `axes` in the world are given by the names of
    its coordinates.
    """
    values, point = part.coordinates(space, jax.numpy.asarray(poses)), space.point(poses[1], part.point_b)
    kinds = {name: _KINDS[part.quantities[name]] for name in axes}
    return [ElementaryJoint(kinds[name], name, point, axis, values[name]) for name, axis in axes.items()]


def perpendiculars(axis: Vector3) -> Float[Array, "2 3"]:
    """Two directions that make a right-handed orthogonal triad `(u, v, axis)`, u of unit length.

    They are recomputed from `axis` at every use, so that derivatives with respect to `axis` are correct.
    """
    # The coordinate axis least parallel to `axis` (no fixed axis serves all): a choice without derivative.
    xp = namespace(axis)
    k = xp.argmin(abs(axis if xp is np else jax.lax.stop_gradient(axis)))
    u = rot.cross((np.arange(3) == k).astype(axis.dtype), axis)
    u = u * reciprocal_root((u * u).sum())
    return xp.stack([u, rot.cross(axis, u)])


def direction_in_a(space, poses: Float[Array, "k p"], v_b: Vector3) -> Vector3:
    """Components in A of a direction fixed in B."""
    return space.body_direction(poses[0], space.direction(poses[1], v_b))


def offset_in_a(space, part, poses: Float[Array, "k p"]) -> Vector3:
    """Components in A of `d`, from point A to point B [m]."""
    return space.body_point(poses[0], space.point(poses[1], part.point_b)) - part.point_a


def across(axis: Vector3, w: Vector3) -> Float[Array, "2"]:
    """The components `u·w`, `v·w` of a vector in A along the perpendiculars of an axis; zero if it is parallel."""
    return jax.numpy.sum(perpendiculars(axis) * w[None, :], axis=1)


def half_sine(sine: Float[Array, "n"], cosine: Float[Array, ""]) -> Float[Array, "n"]:
    """The vector `2 sin(angle / 2)` [rad, for small angles] in the direction of `sine`.

    Within 0.1 rad of half a turn its direction is arbitrary.

    A common factor of sine and cosine does not affect the result, which is zero if both are zero. The result vanishes
    with the angle, and there has the first and second derivatives of the sine. Half a turn away its length is two.
    """
    xp = namespace(sine, cosine)
    square = add_up([*(s * s for s in sine), cosine * cosine])
    defined = square > 0
    square = xp.where(defined, square, 1.0)
    scale = reciprocal_root(square)
    size = square * scale
    opposite = size + cosine < _OPPOSITE * size
    half = xp.where(opposite, size, size + cosine)
    # Near half a turn the direction of the sine is undetermined, and any direction leads back.
    away = 2.0 * (np.arange(sine.shape[0]) == 0) - sine * scale
    return xp.where(defined, xp.where(opposite, away, sine * reciprocal_root(0.5 * size * half)), 0.0)


def displacement_along(space, part, poses: Float[Array, "k p"]) -> Float[Array, ""]:
    """The component of `d` along `axis_a` [m]."""
    return rot.dot(part.axis_a, offset_in_a(space, part, poses))


def offset_rate_in_a(space, part, poses: Float[Array, "k p"], velocities: Float[Array, "k v"]) -> Vector3:
    """The rate of the components in A of `d` [m/s]."""
    held = space.body_point(poses[0], space.point(poses[1], part.point_b))
    ends = zip(poses, velocities, (held, part.point_b), strict=False)
    back, ahead = (space.point_velocity(pose, velocity, point) for pose, velocity, point in ends)
    return space.body_direction(poses[0], ahead - back)


def turning_rate(space, part, poses: Float[Array, "k p"], velocities: Float[Array, "k v"]) -> Float[Array, ""]:
    """The rate [rad/s] of the `angle` of bodies whose axes are parallel."""
    turning = direction_in_a(space, poses, velocities[1, 3:]) - velocities[0, 3:]
    return rot.dot(part.axis_a, turning)


def relative_orientation(poses: Float[Array, "k p"]) -> Float[Array, "4"]:
    """Euler parameters of B relative to A."""
    return rot.multiply(rot.conjugate(poses[0, 3:7]), poses[1, 3:7])


def rotation_error(part, poses: Float[Array, "k p"]) -> Vector3:
    """Twice the vector part of the rotation from `part.orientation` to the relative attitude [rad, for small turns]."""
    return 2.0 * rot.multiply(rot.conjugate(part.orientation), relative_orientation(poses))[1:]


def cosine_sine(space, part, poses: Float[Array, "k p"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Cosine and sine of the angle from `x_a` to `x_b` about `axis_a`, as products of direction components.

    Only the parts perpendicular to `axis_a` count. Cosine and sine have a common factor, 1 if `x_a` and `x_b` are
    perpendicular to `axis_a`.
    """
    x = direction_in_a(space, poses, part.x_b)
    y_a = rot.cross(part.axis_a, part.x_a)
    return rot.dot(rot.cross(y_a, part.axis_a), x), rot.dot(y_a, x)


def angle(space, part, poses: Float[Array, "k p"]) -> Float[Array, ""]:
    """The angle [rad] from `x_a` to `x_b` about `axis_a`, in (−π, π]; zero where it is undefined."""
    c, s = cosine_sine(space, part, poses)
    defined, xp = c * c + s * s > 0, namespace(c, s)
    return xp.where(defined, xp.arctan2(s, xp.where(defined, c, 1.0)), 0.0)


def turn_about(axis: Vector3, start: Vector3, end: Vector3) -> Float[Array, ""]:
    """The angle [rad] about an axis from one direction to another, both perpendicular to it, in (−π, π]."""
    return namespace(axis, start, end).arctan2(rot.cross(axis, start) @ end, start @ end)


def rotation_vector(part, poses: Float[Array, "k p"]) -> Vector3:
    """The rotation vector [rad], in A, of the shortest turn from `part.orientation` to the relative attitude."""
    turned = rot.multiply(relative_orientation(poses), rot.conjugate(part.orientation))
    return rot.rotation_vector(turned)


def measured_from_given_poses(part, space, poses: Float[Array, "k p"]):
    """Fill `x_a` and `x_b` so that the angle between them about `axis_a` is zero at the given poses, if None.

    If `axis_b` is not parallel to `axis_a` at these poses, B is first turned the shortest way to make it parallel.
    """
    axis_b = getattr(part, "axis_b", None)
    if (part.x_a is None) != (part.x_b is None):
        raise ValueError(
            f"{part.label}: give both x_a and x_b (body-fixed), or neither to measure from the given poses."
        )
    if part.x_a is None:
        x_a, _ = perpendiculars(part.axis_a)
        turn = None if axis_b is None else shortest_turn(part.axis_a, direction_in_a(space, poses, axis_b))
        turned = x_a if turn is None else rot.rotate(turn, x_a)
        return part.filled(x_a=x_a, x_b=space.body_direction(poses[1], space.direction(poses[0], turned)))
    for x, axis, names in ((part.x_a, part.axis_a, ("x_a", "axis_a")), (part.x_b, axis_b, ("x_b", "axis_b"))):
        if axis is not None and abs(float(x @ axis)) > 1e-6:
            raise ValueError(f"{part.label}: {names[0]} must be perpendicular to {names[1]}, got {np.asarray(x)}.")
    return part


def shortest_turn(start: Vector3, end: Vector3) -> Float[Array, "4"]:
    """Euler parameters of the shortest turn from a unit vector to the direction of another vector, both concrete;
    between opposite ones a half turn about the first of the `perpendiculars`.
    """
    size = rot.norm(end)
    turn: Any = np.append(size + start @ end, rot.cross(start, end))
    if not turn[0] > 1e-12 * size:
        turn = np.append(0.0, perpendiculars(start)[0])
    return rot.normalize(turn)


def parallel(part) -> tuple[Product, ...]:
    """The axes of a part in A and in B are parallel."""
    return tuple(perpendicular(x, part.axis_b, (part.axis_a, part.axis_b)) for x in perpendiculars(part.axis_a))


def aligned(part) -> tuple[Product, ...]:
    """The relative attitude is `part.orientation`."""
    in_a = rot.rotation_matrix(part.orientation).T
    unit = np.eye(3, dtype=in_a.dtype)
    # Their rates are the components of the angular velocity of B in A along the axes of B.
    return tuple(perpendicular(in_a[k], unit[j], (in_a[k], unit[k])) for k, j in ((2, 1), (0, 2), (1, 0)))


def with_given_orientation(part, poses: Float[Array, "k p"]):
    """Fill `orientation`, Euler parameters of B relative to A, from the given poses, if it is None."""
    return part if part.orientation is not None else part.filled(orientation=rot.normalize(relative_orientation(poses)))
