"""A cart of two platforms with mass, each on wheels."""

from typing import Literal

from ..lagrangian.model import AbstractEquations
from ._wheeled import build_wheeled
from .mechanism import Mechanism, Model, mechanism


@mechanism(variants=("model",))
def nonholonomic_cart(
    *,
    mass: float = 2.0,
    inertia: float = 0.3,
    ahead: float = 0.15,
    front_mass: float = 0.5,
    front_inertia: float = 0.05,
    front_ahead: float = -0.05,
    pivot: float = 0.5,
    handle: float = 0.2,
    angle: float = 0.5,
    speed: float = 1.0,
    rate: float = 0.0,
    form: Literal["frame", "constraints", "connection"] = "frame",
    equations: AbstractEquations | None = None,
    model: Model = "lagrangian",
) -> Mechanism:
    """A cart of two platforms with a pin between them, each on an axle whose wheels do not slip sideways, coasting.

    As `roller_racer`, with mass centres off the axles: like Chaplygin's sleigh, it turns until it rolls straight on.

    Source: A. M. Bloch, Nonholonomic Mechanics and Control, Springer, 2015, on such systems; data of this package.
    Reference values from DOP853 on Hamel's equations.

    **Arguments:**

    - `mass` [kg], `inertia` [kg m²] and `ahead` [m], the distance of the mass centre ahead of the axle, of the rear
        platform; `front_mass`, `front_inertia` and `front_ahead` of the front platform.
    - `pivot` [m], the distance of the pin ahead of the rear axle; `handle` [m], of the front axle ahead of the pin.
    - `angle` φ [rad], `speed` along the heading [m/s] and turning `rate` [rad/s] at the start.
    - `form` and `equations` as in `roller_racer`; `model`: from its Lagrangian, or as rigid bodies `rear` and `front`.

    **Labels:** `x`, `y` [m], `theta`, `phi` [rad], and the velocities `u0`, `u1`, …: speed [m/s] and rate [rad/s].
    """
    parameters = {
        "mass": mass,
        "inertia": inertia,
        "ahead": ahead,
        "front_mass": front_mass,
        "front_inertia": front_inertia,
        "front_ahead": front_ahead,
        "pivot": pivot,
        "handle": handle,
    }
    return build_wheeled(
        "nonholonomic_cart",
        "Cart of two wheeled platforms with a pin, coasting.",
        parameters,
        (angle, speed, rate),
        form=form,
        equations=equations,
        model=model,
    )
