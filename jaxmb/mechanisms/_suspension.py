"""Parts that suspensions of a left wheel share: points by name, a spring, a tyre, observations."""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from .. import spatial
from .._types import VectorLike
from ..parts.functions import Force
from ..parts.names import unknown
from ..trajectory import Trajectory
from .observe import Observation, body_axis

# Radius and width [m] of the wheel.
_WHEEL = 0.3, 0.2

Points = dict[str, np.ndarray]


def placed(defaults: Mapping[str, VectorLike], points: Mapping[str, VectorLike] | None) -> Points:
    """Points by name, with `points` in the place of some `defaults`."""
    for name in points or {}:
        if name not in defaults:
            raise unknown("point", name, defaults)
    return {name: np.asarray(value, float) for name, value in {**defaults, **(points or {})}.items()}


def wheel_inertia(mass: float) -> Any:
    """Of a wheel that spins about y."""
    return spatial.cylinder(mass, *_WHEEL, "y")


def spring(body: Any, points: Points, stiffness: float, damping: float) -> spatial.SpringDamper:
    """A spring and damper between the car and a body at its mass centre's axes."""
    ends = {"point_a": points["spring_top"], "point_b": points["spring_bottom"] - np.asarray(body.position)}
    return spatial.SpringDamper("spring", "ground", body.name, stiffness=stiffness, damping=damping, **ends)


def tyre(body: str, stiffness: float, height: float) -> Force:
    """A vertical spring between the road and the mass centre of a body, free of force at a height."""
    return Force("tyre", body, _push, parameters={"stiffness": stiffness, "z": height}, potential=_pushed)


def _push(poses, velocities, t, p):
    return jnp.zeros((1, 6)).at[0, 2].set(p["stiffness"] * (p["z"] - poses[0, 2]))


def _pushed(poses, t, p):
    return 0.5 * p["stiffness"] * (p["z"] - poses[0, 2]) ** 2


def observer(body: str, wheel: np.ndarray) -> Callable[[Trajectory], Observation]:
    """Travel, camber and toe of the wheel on a body, from its position at the start."""

    def observe(trajectory):
        carrier, axle = trajectory[body], body_axis(trajectory, body, (0.0, 1.0, 0.0))
        return {
            "z": carrier.position[:, 2] - wheel[2],
            "y": carrier.position[:, 1] - wheel[1],
            "camber": -jnp.arcsin(axle[:, 2]),
            "toe": jnp.arctan2(axle[:, 0], axle[:, 1]),
            "rate": carrier.velocity[:, 2],
        }

    return observe
