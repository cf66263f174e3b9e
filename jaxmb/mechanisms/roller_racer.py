"""The roller racer, or Tennessee racer."""

from typing import Literal

from ..lagrangian import AbstractEquations
from ._wheeled import observe_bodies, wheeled, wheeled_bodies
from .mechanism import Mechanism, Model, References, build, mechanism, observe_coordinates, of_bodies


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

    The rear platform is balanced: its mass centre is on its axle. The mass of the front one counts in rotation only.
    Coordinates: x, y [m] of the middle of the rear axle, its heading θ and the angle φ of the handlebar [rad].

    Source: P. S. Krishnaprasad and D. P. Tsakiris, Oscillations, SE(2)-snakes and motion control: a study of the roller
    racer, Dynamical Systems 16(4), 2001. Reference values from DOP853 on Hamel's equations.

    **Arguments:** `mass` [kg] and `inertia` [kg m²] of the rear platform, `front_inertia` [kg m²]; `pivot` [m], of the
    pin ahead of the rear axle; `handle` [m], of the front axle ahead of the pin; `angle` φ [rad], `speed` along the
    heading [m/s] and turning `rate` [rad/s] at the start; `form`: the velocities are speed and turning rate, in a frame
    that satisfies the constraints; or the coordinates' rates, with the constraints; or those of θ and φ, with a
    connection that is singular where the platforms are in line; `equations`: how they are written, default
    `Projected()`; `model`: from its Lagrangian, or as rigid bodies `rear` and `front`, the latter with some of the
    mass, in the pin, where it adds to the rear one's as if it were fixed to it.

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
    rigid = of_bodies(model, form=form == "frame", equations=equations is None)
    start = {"angle": angle, "speed": speed, "rate": rate}
    return build(
        "roller_racer",
        wheeled_bodies(_with_mass_in_front(parameters), **start)
        if rigid
        else wheeled(form, equations, parameters, **start),
        t1=5.0,
        observe=observe_bodies if rigid else observe_coordinates,
        description="Roller racer: two wheeled platforms with a pin, coasting (Krishnaprasad and Tsakiris).",
        references=References.load("roller_racer"),
    )


def _with_mass_in_front(p):
    """The same machine with a share of the mass in the pin: it moves with the rear platform, whose own mass centre
    goes as far behind its axle as the common one needs to stay there.
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
