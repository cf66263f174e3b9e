"""Trains: chains of vehicles on springs, coupled by draft gears, hinges or drawbars."""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import planar
from .._types import VectorLike
from ..bodies.scene import Scene
from ..parts.base import AbstractForce
from ..parts.fields import as_jax, as_parameter
from ..parts.forces import Gravity
from ..parts.functions import Force
from ..parts.smooth import sign, step
from .mechanism import Mechanism, References, build, mechanism


@mechanism()
def train(
    *,
    n: int = 4,
    coupler: Callable[..., Any] = planar.DraftGear,
    coupler_length: float | None = None,
    mass: VectorLike = 8e4,
    inertia: VectorLike = 1.3e6,
    reach: float = 6.0,
    coupler_height: float = -0.5,
    suspension: float = 5e6,
    suspension_damping: float = 1e5,
    wheelbase: float = 8.5,
    speed: VectorLike = 20.0,
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
    """An emergency stop of a train of n vehicles in a vertical plane: x along the track, forwards, y up, with pitch.

    Vehicle `car1` leads with its mass centre in the origin. Consecutive vehicles are coupled at points `reach` before
    and behind their mass centres, `coupler_height` above them, and rest on two vertical springs each. The brakes of a
    vehicle are applied when the pressure wave arrives from the head of the train, and rise to their force in
    `brake_rise`.

    Tolerances are relative to positions along the track: at 10 km an rtol of 1e-6 is a centimetre, half the slack of a
    coupler. Use smaller tolerances for long trains, or `longitudinal_train`.

    Source: after V. A. Lazaryan, L. A. Manashkin and A. V. Yurchenko, Soviet Applied Mechanics 10(6), 1974; the numbers
    describe a loaded four-axle wagon with a generic friction draft gear.

    **Arguments:**

    - `n` ≥ 1, the number of vehicles.
    - `coupler(name, front, rear, point_a=, point_b=)`: returns the part that couples two vehicles: a force
        (`planar.DraftGear`, `functools.partial(planar.DraftGear, slack=0.0)`, …) or a joint (`planar.Revolute`, a
        hinge; `planar.Distance`, a drawbar).
    - `coupler_length` [m], the distance of the coupled points at the start; default 0 for hinges, otherwise 1.
    - `mass` [kg] and `inertia` [kg m²], of all vehicles or of each, shape (n,).
    - `reach`, `coupler_height` [m]; `suspension` [N/m] and `suspension_damping` [N s/m] of each of the two springs,
        `wheelbase` [m] apart; with `suspension` zero there are none, and gravity acts along the track only.
    - `speed` [m/s], of all vehicles or of each, at the start; `grade`, the rise of the track over its length.
    - `resistance` (w₀ [N], w₁ [N s/m], w₂ [N s²/m²]) against each vehicle, `w₀ + w₁ |v| + w₂ v²`; 0 for
        none.
    - `pull` [N] on the leading vehicle.
    - `brake` [N], of all vehicles or of each, built up over `brake_rise` [s]; `wave_speed` [m/s].
    - `transition_speed` [m/s], the speed at which resistance and brakes have 76 % of their force.

    **Labels:** `x1`, `x2`, … [m], `pitch1`, … [rad], `v1`, … [m/s] of the vehicles; `F1`, … [N], the force of the
    couplers on the vehicles behind them, forwards: positive in draft, negative in buff.
    """
    check_train(n, brake_rise=brake_rise, wave_speed=wave_speed, transition_speed=transition_speed)
    if coupler_length is None:
        coupler_length = 0.0 if coupler is planar.Revolute else 1.0
    mass, inertia, speed, brake = (
        of_each(name, value, n)
        for name, value in (("mass", mass), ("inertia", inertia), ("speed", speed), ("brake", brake))
    )
    place = -(2 * reach + coupler_length) * np.arange(n)
    names = [f"car{k}" for k in range(1, n + 1)]
    cars = [
        planar.Body(name, mass=m, inertia=j, position=(x, 0.0), velocity=(v, 0.0))
        for name, m, j, x, v in zip(names, mass, inertia, place, speed, strict=True)
    ]
    # Numbers that all vehicles share are converted only once.
    shared = lambda kind, **numbers: {name: kind(value) for name, value in numbers.items()}
    ends = shared(as_parameter, point_a=(-reach, coupler_height), point_b=(reach, coupler_height))
    couplers = [
        coupler(f"coupler{k}", front, rear, **ends) for k, (front, rear) in enumerate(itertools.pairwise(names), 1)
    ]
    compliant = all(isinstance(part, AbstractForce) for part in couplers)

    forces: list[Any] = list(couplers) if compliant else []
    slope = np.arctan(grade)
    if suspension > 0 or grade:
        forces.append(Gravity((-gravity * np.sin(slope), -gravity * np.cos(slope) if suspension > 0 else 0.0)))
    if suspension > 0:
        spring = shared(
            as_parameter, stiffness=(0.0, suspension, 0.0), damping=(0.0, suspension_damping, 0.0), free_angle=0.0
        )
        ahead, behind = as_parameter((wheelbase / 2, 0.0)), as_parameter((-wheelbase / 2, 0.0))
        free = mass * gravity * np.cos(slope) / (2 * suspension)
        forces += [
            planar.Bushing(
                f"spring{k}{end}",
                "ground",
                name,
                point_a=(0.0, height),
                point_b=point,
                **spring,
            )
            for k, (name, height) in enumerate(zip(names, free, strict=True), 1)
            for end, point in (("a", ahead), ("b", behind))
        ]
    if np.any(resistance):
        numbers = shared(as_jax, **davis(resistance), transition_speed=transition_speed)
        forces += [Force(f"resistance{k}", name, _resistance, parameters=numbers) for k, name in enumerate(names, 1)]
    if np.any(brake):
        numbers = shared(as_jax, rise=brake_rise, transition_speed=transition_speed)
        forces += [
            Force(
                f"brake{k}",
                name,
                _brake,
                parameters={"force": b, "start": -x / wave_speed} | numbers,
            )
            for k, (name, b, x) in enumerate(zip(names, brake, place, strict=True), 1)
        ]
    if pull:
        forces.append(planar.PointForce("pull", "car1", force=(pull, 0.0)))
    return build(
        "train",
        Scene(cars, joints=[] if compliant else couplers, forces=forces),
        t1=t1,
        observe=_observe,
        description=f"Emergency stop of a train of {n} vehicles with pitch, brakes applied by a pressure wave.",
        references=References.load("train"),
    )


def of_each(name: str, value: VectorLike, n: int) -> np.ndarray:
    """A number for each of n vehicles."""
    value = np.asarray(value, float)
    if value.shape not in ((), (n,)):
        raise ValueError(f"train: {name} must be a number or one for each of {n} vehicles, got shape {value.shape}.")
    return np.broadcast_to(value, (n,))


def davis(resistance: VectorLike) -> dict[str, float]:
    """The three numbers of running resistance by name."""
    numbers = np.asarray(resistance, float)
    if not np.any(numbers):
        numbers = np.zeros(3)
    if numbers.shape != (3,):
        raise ValueError(f"train: resistance must be (w0, w1, w2), or 0 for none; got shape {numbers.shape}.")
    return dict(zip(("w0", "w1", "w2"), numbers.tolist(), strict=True))


def check_train(n: int, **positive: float) -> None:
    """Raise a `ValueError` for trains without vehicles, and for numbers that are not positive as required."""
    if n < 1:
        raise ValueError(f"A train needs n ≥ 1 vehicles, got {n}.")
    for name, value in positive.items():
        if not value > 0:
            raise ValueError(f"train: {name} must be positive, got {value}.")


def running_resistance(v, p):
    """The force [N] of running resistance at a speed [m/s]."""
    return -(p["w0"] + p["w1"] * jnp.abs(v) + p["w2"] * v**2) * sign(v, p["transition_speed"])


def braking(t, v, p):
    """The force [N] of the brakes at a time [s] and speed [m/s]."""
    return -p["force"] * step((t - p["start"]) / p["rise"]) * sign(v, p["transition_speed"])


def _resistance(poses, velocities, t, p):
    return _along(running_resistance(velocities[0, 0], p))


def _brake(poses, velocities, t, p):
    return _along(braking(t, velocities[0, 0], p))


def _along(force):
    return jnp.stack([force, jnp.zeros_like(force), jnp.zeros_like(force)])


def _observe(trajectory):
    n = trajectory.system.layout.bodies
    forces = coupler_forces(trajectory)
    observed = {}
    for k in range(n):
        car = trajectory[f"car{k + 1}"]
        observed |= {f"x{k + 1}": car.position[:, 0], f"pitch{k + 1}": car.angle, f"v{k + 1}": car.velocity[:, 0]}
    return observed | {f"F{k + 1}": forces[:, k] for k in range(n - 1)}


def coupler_forces(trajectory) -> jax.Array:
    """The longitudinal forces [N] of the couplers of a `train` on the vehicles behind them, shape (times, n − 1)."""
    system = trajectory.system

    def of_forces(t, y):
        now = system.kinematics(t, y.q, y.u)
        wrenches = [g.wrenches(now) for g in system.forces.groups if "coupler1" in g.group.names]
        return wrenches[0][:, 1, 0] if wrenches else jnp.zeros(0, y.q.dtype)

    def of_joints(t, y, multipliers):
        ((wrenches, _),) = system.constraints.wrenches(system.kinematics(t, y.q, y.u), multipliers)
        return wrenches[:, 1, 0]

    if not system.constraints.groups:
        return jax.vmap(of_forces)(trajectory.ts, trajectory.ys)
    return jax.vmap(of_joints)(trajectory.ts, trajectory.ys, trajectory.multipliers)
