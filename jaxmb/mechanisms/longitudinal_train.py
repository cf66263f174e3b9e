"""Trains on a straight track in relative coordinates."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import planar
from .._types import State, VectorLike
from ..parts.fields import as_jax
from ..parts.planar.kinematics import PLANE
from ._relative import RelativeTrain, velocities
from .mechanism import Mechanism, build, mechanism
from .observe import columns
from .train import braking, check_train, davis, of_each, running_resistance


@mechanism()
def longitudinal_train(
    *,
    n: int = 4,
    coupler: Callable[..., planar.DraftGear] = planar.DraftGear,
    mass: VectorLike = 8e4,
    speed: VectorLike = 20.0,
    extension: VectorLike = 0.0,
    spacing: float = 13.0,
    grade: float = 0.0,
    resistance: VectorLike = (1200.0, 12.0, 1.5),
    pull: float = 0.0,
    brake: VectorLike = 8e4,
    brake_rise: float = 2.0,
    wave_speed: float = 250.0,
    transition_speed: float = 0.1,
    gravity: float = 9.81,
    t1: float = 3.0,
) -> Mechanism:
    """An emergency stop of a train of n vehicles on a straight track, in relative coordinates.

    Coordinates are the position `x1` of the leading vehicle and the extensions `y1`, `y2`, … of the couplers. Slack
    thus loses no digits in a long train, and tolerances are relative to the slack. A stop of 300 vehicles with a mean
    error of 500 N in the coupler forces takes rtol 1e-4 and 14000 steps. In positions along the track, 4 km long, it
    takes rtol 1e-7 and about as many steps; rtol 1e-6 leaves 5000 N. Otherwise as `train`, without pitch.

    Source: V. A. Lazaryan, L. A. Manashkin and A. V. Yurchenko, Soviet Applied Mechanics 10(6), 1974.

    **Arguments:**

    - `n` ≥ 1, the number of vehicles; `coupler(name, front, rear, free_length=)`: makes a draft gear.
    - `mass` [kg], `speed` [m/s] and `brake` [N], of all vehicles or of each, shape (n,).
    - `extension` [m] of all couplers or of each at the start, shape (n − 1,); `spacing` [m] of the vehicles without
        extension, for the delay of the brakes.
    - the others as in `train`.

    **Labels:** `x1` [m]; `y1`, … [m]; `v1`, `v2`, … [m/s] of the vehicles; `F1`, … [N], the tensions of the couplers.
    """
    check_train(n, spacing=spacing, brake_rise=brake_rise, wave_speed=wave_speed, transition_speed=transition_speed)
    mass, speed, brake = (
        as_jax(of_each(name, value, n)) for name, value in (("mass", mass), ("speed", speed), ("brake", brake))
    )
    extension = as_jax(of_each("extension", extension, n - 1))
    apart: Any = np.zeros((2, 3))
    gear = coupler("coupler", "front", "rear", free_length=spacing).resolve(PLANE, apart)
    numbers = {
        "resistance": davis(resistance) | {"transition_speed": transition_speed},
        "brake": {
            "force": brake,
            "start": spacing * np.arange(n) / wave_speed,
            "rise": brake_rise,
            "transition_speed": transition_speed,
        },
        "pull": {"force": pull},
    }
    system = RelativeTrain(
        mass=mass,
        couplers=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n - 1, *leaf.shape)), gear),
        law=_law,
        numbers=jax.tree.map(as_jax, numbers),
        slope=as_jax(gravity * np.sin(np.arctan(grade))),
        guess=State(jnp.append(0.0, extension), jnp.concatenate([speed[:1], speed[:-1] - speed[1:]])),
        length=as_jax(spacing),
    )
    return build(
        "longitudinal_train",
        system,
        t1=t1,
        observe=_observe,
        description=f"Emergency stop of a train of {n} vehicles along a straight track, in relative coordinates.",
    )


def _law(t, v, p):
    along = running_resistance(v, p["resistance"]) + braking(t, v, p["brake"])
    return along.at[0].add(p["pull"]["force"])


def _observe(trajectory):
    system = trajectory.system
    forces = jax.vmap(system.tensions)(trajectory.ys)
    speeds = jax.vmap(velocities)(trajectory.ys.u)
    observed = {name: trajectory[name] for name in system.coordinate_names()}
    vehicles = range(1, system.nq + 1)
    observed |= columns((f"v{k}" for k in vehicles), speeds)
    return observed | columns((f"F{k}" for k in vehicles[:-1]), forces)
