"""Observations of a motion: arrays by label, with time as their first axis."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import VectorLike
from ..linalg import rotations
from ..trajectory import Trajectory

Observation = dict[str, Array]


def columns(labels: Iterable[str], values: Float[Array, "times n"]) -> Observation:
    """The columns of an array by label."""
    return {label: values[:, k] for k, label in enumerate(labels)}


def bar_angles(trajectory: Trajectory, *bars: str) -> Observation:
    """The angles [rad] of planar bodies by name, each followed by its rate [rad/s], `name_rate`."""
    observed = {}
    for bar in bars:
        observed |= {bar: trajectory[bar].angle, f"{bar}_rate": trajectory[bar].angular_velocity}
    return observed


def body_axis(trajectory: Trajectory, body: str, axis: VectorLike) -> Float[Array, "times 3"]:
    """The direction in the world of an axis fixed in a spatial body."""
    return jax.vmap(lambda p: rotations.rotate(p, jnp.asarray(axis, float)))(trajectory[body].orientation)


def turn_about_x(trajectory: Trajectory, body: str) -> Observation:
    """`cos` and `sin` of the angle of a spatial body that turns about the x axis of the world."""
    e0, e1 = trajectory[body].orientation[:, 0], trajectory[body].orientation[:, 1]
    return {"cos": e0**2 - e1**2, "sin": 2 * e0 * e1}


def point_motion(trajectory: Trajectory, body: str, s: VectorLike) -> tuple[Array, Array]:
    """Position [m] and velocity [m/s] in the world, shape (times, d), of the point `s` [m] fixed in a body."""
    system = trajectory.system
    space, k = system.layout.space, system.body_names.index(body)
    s = jnp.asarray(s, float)

    def at(y):
        pose, velocity = system.poses(y.q)[k], system.velocities(y.u)[k]
        return space.point(pose, s), space.point_velocity(pose, velocity, s)

    return jax.vmap(at)(trajectory.ys)


def point_acceleration(trajectory: Trajectory, body: str, s: VectorLike) -> Array:
    """Acceleration [m/s²] in the world, shape (times, d), of the point `s` [m] fixed in a body."""
    system = trajectory.system
    space, k = system.layout.space, system.body_names.index(body)
    s = jnp.asarray(s, float)
    velocity = lambda q, u: space.point_velocity(system.poses(q)[k], system.velocities(u)[k], s)
    at = lambda y, qdot, udot: jax.jvp(velocity, (y.q, y.u), (qdot, udot))[1]
    return jax.vmap(at)(trajectory.ys, trajectory.rates, trajectory.accelerations)


def lagrangian_coordinates(trajectory: Trajectory) -> Observation:
    """The coordinates of a system from a Lagrangian by their names, and its velocities as `u0`, `u1`, …."""
    system, ys = trajectory.system, trajectory.ys
    return {name: trajectory[name] for name in system.coordinate_names()} | _numbered(ys.u)


def point_coordinates(trajectory: Trajectory, labels: Iterable[str]) -> Observation:
    """As `lagrangian_coordinates`, of point masses: their positions, one after the other, by label, and their
    velocities.
    """
    points = [trajectory[name] for name in trajectory.system.body_names]
    positions, velocities = jnp.hstack([p.position for p in points]), jnp.hstack([p.velocity for p in points])
    return columns(labels, positions) | _numbered(velocities)


def _numbered(velocities):
    return columns((f"u{k}" for k in range(velocities.shape[1])), velocities)
