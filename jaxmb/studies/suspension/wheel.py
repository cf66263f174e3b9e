"""A wheel on its carrier: attitude, contact patch, steering axis. Axes: x forward, y to the left, z up."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._types import Coordinates, Scalar
from ...linalg.rotations import angular_velocity, cross, norm
from ...parts.space import separation

_UP = np.array([0.0, 0.0, 1.0])
# A spring that shortens by less than this part of travel is at its dead centre.
_MOVES = 1e-6


class Wheel(eqx.Module):
    """A wheel on its carrier.

    **Fields:** the `number` of the carrier among the bodies; `side`: 1 on the left, −1 on the right; the `centre` [m]
    in the axes at the carrier's mass centre; `axle`: the outward unit vector along the spin axis, in the same axes; the
    `radius` [m].
    """

    number: int = eqx.field(static=True)
    side: Float[Array, ""]
    centre: Float[Array, "3"]
    axle: Float[Array, "3"]
    radius: Float[Array, ""]

    def pose(self, system: Any, q: Coordinates) -> Float[Array, "7"]:
        """The pose of the carrier."""
        return system.poses(q)[self.number]

    def height(self, system: Any, q: Coordinates) -> Float[Array, ""]:
        """The height [m] of the wheel's centre."""
        return system.layout.space.point(self.pose(system, q), self.centre)[2]

    def attitude(self, system: Any, q: Coordinates) -> "Attitude":
        """Angles and contact patch."""
        space, pose = system.layout.space, self.pose(system, q)
        axle = space.direction(pose, self.axle)
        down = axle[2] * axle - _UP
        patch = space.point(pose, self.centre) + self.radius * down / norm(down)
        return Attitude(jnp.arctan2(axle[0], self.side * axle[1]), -jnp.arcsin(axle[2]), patch)

    def load(self, system: Any, q: Coordinates, load: Float[Array, "3"], lift: Scalar) -> Float[Array, "nu"]:
        """The generalized force of a load at the contact patch, a force along x and y [N] and a moment about z [N m],
        and of a vertical force `lift` [N] at the wheel's centre.
        """
        space, pose = system.layout.space, self.pose(system, q)
        patch = space.body_point(pose, self.attitude(system, q).patch)

        def power(u):
            velocity = system.velocities(u)[self.number]
            along, up = (space.point_velocity(pose, velocity, point) for point in (patch, self.centre))
            turning = space.turning(pose, velocity)
            return load[0] * along[0] + load[1] * along[1] + load[2] * turning[2] + lift * up[2]

        return jax.grad(power)(jnp.zeros(system.nu, q.dtype))

    def steering_axis(
        self, system: Any, q: Coordinates, rates: Float[Array, "7 2"], lengths: Float[Array, "springs 2"]
    ) -> "SteeringAxis":
        """The instantaneous screw axis of the carrier in steering.

        **Arguments:** derivatives of the carrier's pose (`rates`) and of the `lengths` of springs by travel and steer.
        """
        space, pose = system.layout.space, self.pose(system, q)
        turnings = jax.vmap(lambda rate: space.direction(pose, angular_velocity(pose[3:], rate)))(rates[3:].T)
        by_travel, by_steer = (Twist(turnings[k], rates[:3, k]) for k in range(2))
        travel = _travel_of_a_held_spring(_travel_of_a_rotation(by_travel, by_steer), lengths)
        turning, velocity = (steer - travel * rise for rise, steer in zip(by_travel, by_steer, strict=True))
        square = jnp.dot(turning, turning)
        turns = square > 0
        # The point of the axis that is nearest to the mass centre.
        point = pose[:3] + cross(turning, velocity) / jnp.where(turns, square, 1.0)
        upward = turning * jnp.where(turning[2] < 0, -1.0, 1.0)
        upward = jnp.where(turns, upward, _UP)
        patch = self.attitude(system, q).patch
        ground = point + upward * (patch - point)[2] / upward[2]
        outward = space.direction(pose, self.axle) * (1 - _UP)
        outward = outward / norm(outward)
        forward = self.side * cross(outward, jnp.asarray(_UP, q.dtype))
        return SteeringAxis(
            jnp.arctan2(-upward[0], upward[2]),
            jnp.arctan2(-self.side * upward[1], upward[2]),
            jnp.dot(patch - ground, outward),
            jnp.dot(ground - patch, forward),
        )


class Twist(NamedTuple):
    """Derivatives of a body's rotation (`turning`, a vector) and of its mass centre (`velocity`)."""

    turning: Float[Array, "3"]
    velocity: Float[Array, "3"]


def _travel_of_a_rotation(by_travel: Twist, by_steer: Twist) -> Float[Array, ""]:
    """The λ nearest to zero at which `by_steer − λ by_travel` is a rotation about an axis, without a shift along it:
    `(ω_s − λ ω_t) · (v_s − λ v_t) = 0`. If there is none, a continuous extension.
    """
    (turning_t, velocity_t), (turning_s, velocity_s) = by_travel, by_steer
    squared = jnp.dot(turning_t, velocity_t)
    linear = jnp.dot(turning_s, velocity_t) + jnp.dot(turning_t, velocity_s)
    constant = jnp.dot(turning_s, velocity_s)
    # The other root is large where travel hardly turns the carrier.
    root = jnp.sqrt(jnp.maximum(linear**2 - 4 * squared * constant, jnp.finfo(linear.dtype).tiny))
    return 2 * constant / (linear + jnp.where(linear < 0, -root, root))


def _travel_of_a_held_spring(free: Float[Array, ""], lengths: Float[Array, "springs 2"]) -> Float[Array, ""]:
    """The λ of `_travel_of_a_rotation` nearest to `free` at which a spring keeps its length; without springs, and where
    travel changes no length, `free`.
    """
    travel, off = free, jnp.full_like(free, jnp.inf)
    for by_travel, by_steer in lengths:
        moves = jnp.abs(by_travel) > _MOVES
        held = by_steer / jnp.where(moves, by_travel, 1.0)
        distance = jnp.where(moves, jnp.abs(held - free), jnp.inf)
        travel, off = jnp.where(distance < off, held, travel), jnp.minimum(distance, off)
    return travel


class Attitude(NamedTuple):
    """The `toe` and `camber` [rad] of a wheel, and its contact `patch` [m]: the lowest point of its circle."""

    toe: Float[Array, ""]
    camber: Float[Array, ""]
    patch: Float[Array, "3"]


class SteeringAxis(NamedTuple):
    """The `caster` and `kingpin_inclination` [rad] of a steering axis, its `scrub_radius` and `caster_trail` [m]; None
    without an axis.
    """

    caster: Float[Array, ""] | None
    kingpin_inclination: Float[Array, ""] | None
    scrub_radius: Float[Array, ""] | None
    caster_trail: Float[Array, ""] | None


class Spring(NamedTuple):
    """The place of a spring between two points: the numbers of its group of forces, and of the spring in the group; or
    of a coordinate of a joint; static.
    """

    group: int
    member: int
    coordinate: Any = None

    def length(self, system: Any, t: Scalar, q: Coordinates) -> Float[Array, ""]:
        """Its length [m], or the coordinate."""
        if self.coordinate is not None:
            return system.catalogue.joint_coordinate(self.coordinate, t, q)
        alone, space = system.forces.groups[self.group].group.only(self.member), system.layout.space

        def of_part(at, poses):
            part = at(t)
            return norm(separation(space, part, part.seen_poses(space, poses)))

        return alone.map(of_part, alone.gather(system.bodies.prepared_poses(q)))[0]
