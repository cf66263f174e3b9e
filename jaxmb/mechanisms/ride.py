"""Ride comfort, suspension travel and wheel loads of a motion of `tracked_vehicle`.

`unit` is 1 for the leading carrier and 2 for the towed one.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import VectorLike
from ..system import parameters
from ..trajectory import Trajectory
from .observe import point_acceleration

PREFIXES = ("", "rear_")


def seat_acceleration(
    trajectory: Trajectory, seat: VectorLike = (0.5, 0.4), *, unit: int = 1
) -> Float[Array, "times 2"]:
    """Acceleration [m/s²] at the driver's seat, a point [m] of the hull; world axes, without gravity."""
    return point_acceleration(trajectory, f"{PREFIXES[unit - 1]}hull", seat)


def vertical_rms(trajectory: Trajectory, seat: VectorLike = (0.5, 0.4), *, unit: int = 1) -> Float[Array, ""]:
    """Root mean square over time of the vertical acceleration [m/s²] at the seat, by the trapezoidal rule between saved
    times.
    """
    square = seat_acceleration(trajectory, seat, unit=unit)[:, 1] ** 2
    return jnp.sqrt(jnp.trapezoid(square, trajectory.ts) / (trajectory.ts[-1] - trajectory.ts[0]))


def arm_travel(trajectory: Trajectory, *, unit: int = 1) -> Float[Array, "times wheels"]:
    """Angles [rad] of the road arms in the hull from the middle between their stops; wheels upwards are negative."""
    p, known = PREFIXES[unit - 1], parameters(trajectory.system)
    hull = trajectory[f"{p}hull"].angle
    arms = [name for name in trajectory.system.body_names if name.startswith(f"{p}arm")]
    middle = [0.5 * (known[f"{p}stop{k}.lower"] + known[f"{p}stop{k}.upper"]) for k in range(1, len(arms) + 1)]
    return jnp.stack([trajectory[arm].angle - hull - angle for arm, angle in zip(arms, middle, strict=True)], axis=1)


def wheel_loads(trajectory: Trajectory) -> Float[Array, "times wheels"]:
    """Vertical forces [N] of the ground on the wheels, those of the leading carrier first, damping included."""
    return trajectory.forces["road"][:, :, 1]
