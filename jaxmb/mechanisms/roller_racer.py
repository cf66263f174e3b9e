"""The roller racer, or Tennessee racer."""

from typing import Literal

from ..lagrangian.model import AbstractEquations
from ._wheeled import build_wheeled
from .mechanism import Mechanism, Model, mechanism


@mechanism(variants=("model",))
def roller_racer(
    *,
    mass: float = 2.0,
    inertia: float = 0.3,
    front_inertia: float = 0.05,
    pivot: float = 0.5,
    handle: float = 0.2,
    angle: float = 0.5,
    speed: float = 1.0,
    rate: float = 0.0,
    form: Literal["frame", "constraints", "connection"] = "frame",
    equations: AbstractEquations | None = None,
    model: Model = "lagrangian",
) -> Mechanism:
    """A racer of two platforms with a pin between them, each on an axle whose wheels do not slip sideways, coasting.

    The rear platform is balanced: its mass centre is on its axle. The front platform has inertia in rotation only.
    Coordinates: x, y [m] of the middle of the rear axle, its heading θ and the angle φ of the handlebar [rad].

    Source: P. S. Krishnaprasad and D. P. Tsakiris, Oscillations, SE(2)-snakes and motion control: a study of the roller
    racer, Dynamical Systems 16(4), 2001. Reference values from DOP853 on Hamel's equations.

    **Arguments:**

    - `mass` [kg] and `inertia` [kg m²] of the rear platform; `front_inertia` [kg m²].
    - `pivot` [m], the distance of the pin ahead of the rear axle; `handle` [m], of the front axle ahead of the pin.
    - `angle` φ [rad], `speed` along the heading [m/s] and turning `rate` [rad/s] at the start.
    - `form`: the velocities. `"frame"`: speed and turning rate, in a frame that satisfies the constraints;
        `"constraints"`: the coordinates' rates, with the constraints; `"connection"`: the rates of θ and φ, with a
        connection that is singular where the platforms are in line.
    - `equations`: the form of the equations, default `Projected()`.
    - `model`: from its Lagrangian, or as rigid bodies `rear` and `front`; part of the mass is then at the pin, on the
        front body.

    **Labels:** `x`, `y` [m], `theta`, `phi` [rad], and the velocities `u0`, `u1`, …: speed [m/s] and rate [rad/s].
    """
    parameters = {
        "mass": mass,
        "inertia": inertia,
        "ahead": 0.0,
        "front_mass": 0.0,
        "front_inertia": front_inertia,
        "front_ahead": 0.0,
        "pivot": pivot,
        "handle": handle,
    }
    return build_wheeled(
        "roller_racer",
        "Roller racer: two wheeled platforms with a pin, coasting (Krishnaprasad and Tsakiris).",
        parameters,
        (angle, speed, rate),
        form=form,
        equations=equations,
        model=model,
        as_bodies=_with_mass_in_front,
    )


def _with_mass_in_front(p):
    """An equivalent machine with part of the mass at the pin, as the front platform's. The rear platform's mass centre
    then lies behind its axle, and the common mass centre stays on it.
    """
    arm = p["mass"] * p["pivot"] ** 2
    ratio = p["inertia"] / (p["inertia"] + 2 * arm)
    rear = p["mass"] / (1 + ratio)
    return p | {
        "mass": rear,
        "front_mass": ratio * rear,
        "ahead": -ratio * p["pivot"],
        "front_ahead": -p["handle"],
        "inertia": p["inertia"] - ratio * arm,
    }
