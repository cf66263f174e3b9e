"""A ball that touches a surface: the rows of A of its gap and of its slip, and their biases, in closed form.

The ball is fixed in the last body of a contact, the surface in the first of two bodies or in the world. Its axes are
those of that body. See `AbstractSurfaceContact` for what the surface says of a point.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..parts.space import AbstractSpace
from ..parts.unilateral import AbstractSurfaceContact, axes_of, tangents_of


class Touch(NamedTuple):
    """Where and how a ball is near a surface.

    **Fields:** the ball's `centre` [m] in the world, and `seen` from the surface; the `gradient` of the gap there, in
    the axes of the surface; its `size`, None for one; the unit `normal` in these axes, and `outward` in the world; the
    `point` [m] of the ball in the world that is nearest to the surface.
    """

    centre: Float[Array, "d"]
    seen: Float[Array, "d"]
    gradient: Float[Array, "d"]
    size: Float[Array, ""] | None
    normal: Float[Array, "d"]
    outward: Float[Array, "d"]
    point: Float[Array, "d"]


class TouchRates(NamedTuple):
    """How a `Touch` changes: `normal`, the rate of its normal in the axes of the surface, None if it is constant there;
    `point`, the velocity [m/s] of its point.
    """

    normal: Float[Array, "d"] | None
    point: Float[Array, "d"]


def touch_at(space: AbstractSpace, part: AbstractSurfaceContact, x: Float[Array, "k p"]) -> Touch:
    """The touch at the poses of the bodies."""
    centre, radius = part.ball
    c = space.point(x[-1], centre)
    seen = space.body_point(x[0], c) if len(x) == 2 else c
    gradient, size = part.facing(seen)
    normal = gradient if size is None else gradient / size
    outward = space.direction(x[0], normal) if len(x) == 2 else normal
    return Touch(c, seen, gradient, size, normal, outward, c - radius * outward)


def gap_rows(space: AbstractSpace, part: AbstractSurfaceContact, x: Float[Array, "k p"], at: Touch):
    """The row of the gap, shape (1, k, v)."""
    force = at.outward if at.size is None else at.size * at.outward
    last = space.point_force(x[-1], part.ball[0], force)
    rows = [last] if len(x) == 1 else [-space.force_at(x[0], at.centre, force), last]
    return jnp.stack(rows)[None]


def gap_gradient(space: AbstractSpace, part: AbstractSurfaceContact, x: Float[Array, "k p"]) -> Float[Array, "k p"]:
    """The derivative of the gap by the prepared poses of the bodies."""
    at = touch_at(space, part, x)
    force = at.outward if at.size is None else at.size * at.outward
    last = space.point_gradient(part.ball[0], force)
    if len(x) == 1:
        return last[None]
    d = space.dimension
    turned = space.point_gradient(at.gradient, at.centre - x[0, :d])[d:]
    return jnp.stack([jnp.concatenate([-force, turned]), last])


def gap_motion(space: AbstractSpace, part: AbstractSurfaceContact, x, v, at: Touch) -> tuple[Any, Any, TouchRates]:
    """The rate of the gap, its second derivative without accelerations, and the rates of the touch."""
    d, (_, radius) = space.dimension, part.ball
    turning = space.turning(x[-1], v[-1])
    velocity = v[-1, :d] + space.swept(turning, at.centre - x[-1, :d])
    acceleration = space.swept(turning, velocity - v[-1, :d])
    along, of_surface = velocity, None
    if len(x) == 2:
        of_surface = space.turning(x[0], v[0])
        carried = space.swept(of_surface, at.centre - x[0, :d])
        relative = velocity - v[0, :d] - carried
        acceleration = acceleration - space.swept(of_surface, carried + 2 * relative)
        along, acceleration = (space.body_direction(x[0], w) for w in (relative, acceleration))
    rate, bias = jnp.dot(at.gradient, along), jnp.dot(at.gradient, acceleration)
    gradient = part.facing_rate(at.seen, along)
    normal = None
    if gradient is not None:
        bias = bias + jnp.dot(gradient, along)
        normal = gradient - at.normal * jnp.dot(at.normal, gradient)
        normal = normal if at.size is None else normal / at.size
    outward = normal
    if of_surface is not None:
        outward = space.swept(of_surface, at.outward)
        outward = outward if normal is None else outward + space.direction(x[0], normal)
    return rate, bias, TouchRates(normal, velocity if outward is None else velocity - radius * outward)


def slip_rows(space: AbstractSpace, pole: int, x: Float[Array, "k p"], at: Touch) -> Float[Array, "r k v"]:
    """The rows of the slip; `pole`: see `AbstractRigidContact.tangents`."""
    tangents = _in_world(space, x, tangents_of(at.normal, pole))
    force = lambda pose: jax.vmap(lambda w: space.force_at(pose, at.point, w))(tangents)
    return jnp.stack([force(x[0])] if len(x) == 1 else [-force(x[0]), force(x[1])], axis=1)


def slip_motion(space: AbstractSpace, pole: int, x, v, at: Touch, rates: TouchRates) -> tuple[Any, Any]:
    """The velocities of slip, and their derivatives without accelerations."""
    d = space.dimension
    tangents = _in_world(space, x, tangents_of(at.normal, pole))
    turn = None if rates.normal is None else _in_world(space, x, _tangent_rates(at.normal, rates.normal, pole))
    turning = space.turning(x[-1], v[-1])
    relative = v[-1, :d] + space.swept(turning, at.point - x[-1, :d])
    acceleration = space.swept(turning, rates.point - v[-1, :d])
    if len(x) == 2:
        of_surface = space.turning(x[0], v[0])
        relative = relative - v[0, :d] - space.swept(of_surface, at.point - x[0, :d])
        acceleration = acceleration - space.swept(of_surface, rates.point - v[0, :d])
        carried = jax.vmap(lambda w: space.swept(of_surface, w))(tangents)
        turn = carried if turn is None else turn + carried
    bias = tangents @ acceleration
    return tangents @ relative, bias if turn is None else bias + turn @ relative


def _in_world(space, x, vectors):
    return jax.vmap(lambda w: space.direction(x[0], w))(vectors) if len(x) == 2 else vectors


def _tangent_rates(normal, rate, pole):
    if not pole:
        return jnp.stack([rate[1], -rate[0]])[None]
    axes, upwards = axes_of(pole, normal.dtype)
    size = 1 + upwards @ normal
    along = (axes @ normal) / size
    slope = (axes @ rate - along * (upwards @ rate)) / size
    return -(slope[:, None] * (upwards + normal)[None] + along[:, None] * rate[None])
