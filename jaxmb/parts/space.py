"""The common interface of the plane and space: poses, velocities and wrenches of one body.

A `pose` places a body, a `velocity` is its rate of motion, and a `wrench` does work on a velocity:

| | pose | velocity | wrench |
|---|---|---|---|
| plane | x, y [m], angle [rad] | ẋ, ẏ [m/s], angular rate [rad/s] | force [N], moment [N m] |
| space | r [m], Euler parameters | ṙ [m/s] world, ω′ [rad/s] body | force [N] world, moment [N m] body |
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..linalg.arrays import namespace
from .shapes import AbstractShape, marked_ball, wheel

Pose = Float[Array, "p"]
Velocity = Float[Array, "v"]
Wrench = Float[Array, "v"]
Point = Float[Array, "d"]


class AbstractSpace(abc.ABC):
    """Kinematics of one rigid body in the plane or in space; instances of one class are equal."""

    dimension: ClassVar[int]
    pose_size: ClassVar[int]
    velocity_size: ClassVar[int]
    ground: ClassVar[tuple[float, ...]]

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other)

    def __hash__(self) -> int:
        return hash(type(self))

    @abc.abstractmethod
    def point(self, pose: Pose, s: Point) -> Point:
        """World position [m] of the body-fixed point `s` [m]."""

    @abc.abstractmethod
    def point_velocity(self, pose: Pose, velocity: Velocity, s: Point) -> Point:
        """World velocity [m/s] of the body-fixed point `s` [m]."""

    @abc.abstractmethod
    def point_force(self, pose: Pose, s: Point, force_W: Point) -> Wrench:
        """Wrench of a force [N], in world axes, at the body-fixed point `s` [m]."""

    @abc.abstractmethod
    def force_at(self, pose: Pose, point_W: Point, force_W: Point) -> Wrench:
        """Wrench of a force [N] at a point [m] of the world, in world axes."""

    @abc.abstractmethod
    def turning(self, pose: Pose, velocity: Velocity) -> Float[Array, "r"]:
        """The angular velocity [rad/s], in world axes; one number in the plane."""

    @abc.abstractmethod
    def swept(self, omega: Float[Array, "r"], arm: Point) -> Point:
        """`ω × arm` [m/s], in world axes."""

    @abc.abstractmethod
    def moment(self, pose: Pose, moment_W: Float[Array, "r"]) -> Wrench:
        """Wrench of a moment [N m] in world axes, one number in the plane."""

    @abc.abstractmethod
    def direction(self, pose: Pose, v: Point) -> Point:
        """World components of a body-fixed direction."""

    @abc.abstractmethod
    def body_point(self, pose: Pose, point_W: Point) -> Point:
        """The body-fixed point [m] at a world position [m]."""

    @abc.abstractmethod
    def body_direction(self, pose: Pose, v_W: Point) -> Point:
        """Body components of a world direction."""

    @abc.abstractmethod
    def displaced(self, pose: Pose, origin: Point, turn: Float[Array, "r"]) -> Pose:
        """The pose of a frame at a body-fixed point [m], without prepared quantities, whose axes turn by a small vector
        [rad] in body axes: about its direction by `2 arctan(|turn| / 2)`.
        """

    @abc.abstractmethod
    def prepare(self, pose: Pose) -> Pose:
        """The pose with quantities that all parts on a body share (cosines), computed once."""

    @abc.abstractmethod
    def rates(self, pose: Pose, velocity: Velocity) -> Pose:
        """Rate of the pose, `N(pose) velocity`."""

    @abc.abstractmethod
    def moves(self, pose: Pose) -> Float[Array, "v p"]:
        """Rates of a prepared pose along each unit velocity."""

    @abc.abstractmethod
    def coordinate_moves(self, pose: Pose) -> Float[Array, "p p"]:
        """Rates of a prepared pose along unit rates of its coordinates."""

    @abc.abstractmethod
    def pull_back(self, pose: Pose, gradient: Pose) -> Wrench:
        """Wrench `Nᵀ g` that does the work of a gradient with respect to the pose."""

    @abc.abstractmethod
    def point_gradient(self, s: Point, weights: Point) -> Pose:
        """The derivative of `weights · point(pose, s)` by a prepared pose."""

    @abc.abstractmethod
    def normalize(self, pose: Pose) -> Pose:
        """The nearest pose with unit Euler parameters."""

    @abc.abstractmethod
    def placement(self, pose: Pose) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        """Position [m] and Euler parameters in space; the plane is z = 0."""

    def in_space(self, v: Point) -> Float[Array, "3"]:
        """The three components of a vector; the plane is z = 0."""
        xp = namespace(v)
        return xp.concatenate([v, xp.zeros(3 - self.dimension, v.dtype)])


# Shared by parts between two points: `part` has `point_a` and `point_b` [m], fixed in the first and the second body.


def both_points(space: AbstractSpace, part: Any, poses: Float[Array, "k p"]) -> Float[Array, "2 d"]:
    """World positions [m] of point A and point B."""
    return _of_both(space.point, part, poses[:2])


def separation(space: AbstractSpace, part: Any, poses: Float[Array, "k p"]) -> Point:
    """World vector [m] from point A to point B."""
    points = both_points(space, part, poses)
    return points[1] - points[0]


def _of_both(function, part, *rows):
    """`function(…, point)` of both bodies in one kernel, from rows of some arrays and points A and B."""
    xp = namespace(*rows, part.point_a, part.point_b)
    rows = *rows, xp.stack([part.point_a, part.point_b])
    return xp.stack([function(*x) for x in zip(*rows, strict=True)]) if xp is np else jax.vmap(function)(*rows)


def nearest_to_origin(point: Point, axis: Point) -> Point:
    """The point nearest to the origin on the line through a point along a unit vector."""
    return point - jnp.dot(point, axis) * axis


def separation_rate(
    space: AbstractSpace, part: Any, poses: Float[Array, "k p"], velocities: Float[Array, "k v"]
) -> Point:
    """Rate [m/s] of the world vector from point A to point B."""
    both = _of_both(space.point_velocity, part, poses[:2], velocities[:2])
    rate = both[1] - both[0]
    return with_drift(part, rate, lambda part: separation(space, part, poses))


def rate_of(
    space: AbstractSpace,
    part: Any,
    function: Callable[[Any, Float[Array, "k p"]], Array],
    poses: Float[Array, "k p"],
    velocities: Float[Array, "k v"],
) -> tuple[Array, Array]:
    """The value and the rate of `function(part, poses)`; the rate includes the rates of the part's numbers that are
    inputs.

    ```python
    class Rope(jaxmb.parts.AbstractPointPair, jaxmb.parts.AbstractForce):
        drag: jaxmb.parts.Number = jaxmb.parts.parameter(unit="N s/m", sign="positive")

        def length(self, space, poses):
            return jaxmb.rotations.norm(jaxmb.parts.separation(space, self, poses))

        def wrenches(self, space, poses, velocities, t):
            length, rate = jaxmb.parts.rate_of(space, self, lambda part, x: part.length(space, x), poses, velocities)
            along = jaxmb.parts.separation(space, self, poses) / length
            return jaxmb.parts.force_pair(space, self, poses, -self.drag * rate * along)

    rope = Rope("rope", "ground", "bar", drag=2.0, point_a=(0.0, 1.0), point_b=(0.5, 0.0))
    system = jaxmb.Scene([bar], joints=[pin], forces=[rope]).compile()
    ```
    """
    rates = jax.vmap(space.rates)(poses, velocities)
    value, rate = jax.jvp(lambda x: function(part, x), (poses,), (rates,))
    return value, with_drift(part, rate, lambda part: function(part, poses))


def with_drift(part: Any, rate: Array, function: Callable[[Any], Array]) -> Array:
    """The `rate` of `function(part)` due to the motion of the bodies, plus its rate due to inputs, such as a point that
    moves in its body.
    """
    if part.drift is None:
        return rate
    plain = part.with_fields(drift=None)
    moving = eqx.filter_jvp(function, (plain,), (part.drift,))[1]
    return rate if moving is None else rate + moving


def force_pair(space: AbstractSpace, part: Any, poses: Float[Array, "k p"], force_W: Point) -> Float[Array, "2 v"]:
    """Wrenches of `force_W` [N] on B at point B and of its reaction on A at point A."""
    forces = jnp.stack([-force_W, force_W])
    return _of_both(lambda pose, force, s: space.point_force(pose, s, force), part, poses[:2], forces)


def moment_pair(space: AbstractSpace, poses: Float[Array, "2 p"], moment_W: Float[Array, "r"]) -> Float[Array, "2 v"]:
    """Wrenches of `moment_W` [N m] on the second body and of its reaction on the first."""
    return jnp.stack([space.moment(poses[0], -moment_W), space.moment(poses[1], moment_W)])


def round_shapes(space: AbstractSpace, body: int, radius: Any, centre: Any) -> tuple[tuple[int, AbstractShape], ...]:
    """The shapes of a disc (in space of a ball), each with the index of its body; none for a point."""
    solid = wheel if space.dimension == 2 else marked_ball
    return tuple((body, shape) for shape in solid(radius, position=space.in_space(centre))) if radius > 0 else ()
