"""Ride comfort, suspension travel, wheel loads and track tension of a motion of `tracked_vehicle`.

```python
from jaxmb.mechanisms import ride
vehicle = jaxmb.mechanisms.tracked_vehicle(track="shoes")
motion = jaxmb.simulate(vehicle.system, vehicle.state, t1=0.02, saveat=np.linspace(0.0, 0.02, 3), rtol=1e-4)
ride.seat_acceleration(motion, (0.5, 0.4)), ride.vertical_rms(motion, (0.5, 0.4))
ride.arm_travel(motion), ride.wheel_loads(motion), ride.track_tension(motion)
```

`unit` is 1 for the leading carrier and 2 for the towed one.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import VectorLike
from ..linalg.rotations import norm
from ..system import parameters
from ..trajectory import Trajectory
from .observe import point_acceleration

__all__ = ["arm_travel", "seat_acceleration", "track_tension", "vertical_rms", "wheel_loads"]

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
    """Angles [rad] of the road arms in the hull from the middle between their stops; negative if wheels are higher."""
    p, values = PREFIXES[unit - 1], parameters(trajectory.system)
    hull = trajectory[f"{p}hull"].angle
    arms = [name for name in trajectory.system.body_names if name.startswith(f"{p}arm")]
    middle = [0.5 * (values[f"{p}stop{k}.lower"] + values[f"{p}stop{k}.upper"]) for k in range(1, len(arms) + 1)]
    return jnp.stack([trajectory[arm].angle - hull - angle for arm, angle in zip(arms, middle, strict=True)], axis=1)


def wheel_loads(trajectory: Trajectory) -> Float[Array, "times wheels"]:
    """Vertical forces [N] of the ground, or of a track's shoes, on the wheels, including damping; the leading carrier
    first.
    """
    rims = [name for name in trajectory.system.catalogue.force_names() if name.endswith("_rim") and "wheel" in name]
    if rims:
        return jnp.stack([trajectory.forces[name][..., 0, 1] for name in rims], axis=-1)
    return trajectory.forces["road"][:, :, 1]


def track_tension(trajectory: Trajectory, *, unit: int = 1) -> Float[Array, "times pins"]:
    """Forces [N] in the pins of a track of shoes, counter-clockwise: at the start from the front over the top.

    **Raises:** `ValueError` if the track has no shoes.
    """
    prefix = f"{PREFIXES[unit - 1]}pin"
    rows = [k for k, (name, _) in enumerate(trajectory.system.rows) if name.startswith(prefix)]
    if not rows:
        raise ValueError('track_tension needs the pins of shoes: tracked_vehicle(track="shoes").')
    forces = trajectory.multipliers[..., jnp.array(rows)]
    return norm(forces.reshape(*forces.shape[:-1], -1, 2))
