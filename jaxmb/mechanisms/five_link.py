"""A five-link suspension."""

from collections.abc import Mapping

from .. import spatial
from .._types import VectorLike
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from ._suspension import observer, placed, spring, tyre as tyre_of, wheel_inertia
from .mechanism import Mechanism, References, build, mechanism

_LINKS = ("lower_front", "lower_rear", "upper_front", "upper_rear", "tie_rod")
_POINTS = {
    "lower_front_inner": (0.16, 0.38, 0.22),
    "lower_front_outer": (0.05, 0.72, 0.2),
    "lower_rear_inner": (-0.14, 0.36, 0.23),
    "lower_rear_outer": (-0.05, 0.71, 0.2),
    "upper_front_inner": (0.12, 0.44, 0.5),
    "upper_front_outer": (0.03, 0.69, 0.52),
    "upper_rear_inner": (-0.18, 0.42, 0.48),
    "upper_rear_outer": (-0.04, 0.68, 0.51),
    "tie_rod_inner": (-0.2, 0.4, 0.28),
    "tie_rod_outer": (-0.15, 0.71, 0.26),
    "wheel": (0.0, 0.78, 0.32),
    "spring_top": (0.0, 0.48, 0.62),
    "spring_bottom": (0.0, 0.66, 0.25),
}


@mechanism()
def five_link(
    *,
    points: Mapping[str, VectorLike] | None = None,
    masses: tuple[float, float] = (16.0, 18.0),
    stiffness: float = 4e4,
    damping: float = 1.5e3,
    tyre: float = 2e5,
    speed: float = 2.0,
    gravity: float = 9.81,
) -> Mechanism:
    """The left wheel of a car at rest, on a carrier, five links and a spring, jounces on its tyre; x forward, y to the
    left, z up.

    Five massless rods with ball joints at their ends connect the carrier with the car; the wheel spins on the carrier.
    There are two degrees of freedom, travel and spin. Spring and tyre are free of force at the start.

    Source: data of this package. The reference values come from a model in the height of the wheel's centre, whose
    carrier solves the five equations of the rods.

    **Arguments:** `points`: positions [m] by name that replace defaults: `lower_front_inner` on the car and
    `lower_front_outer` on the carrier, likewise `lower_rear`, `upper_front`, `upper_rear` and `tie_rod`, `wheel`,
    `spring_top`, `spring_bottom` on the carrier; `masses` [kg] of carrier and wheel, both with their mass centres at
    `wheel`; `stiffness` [N/m] and `damping` [N s/m] of the spring; `tyre` [N/m], vertical stiffness; `speed` [m/s] of
    the wheel's centre at the start, upward; `gravity` [m/s²].

    **Labels:** `z`, `y` [m], travel of the wheel's centre, up and outward; `camber` [rad], top outward; `toe` [rad],
    front inward; `rate` [m/s], ż.
    """
    P = placed(_POINTS, points)
    carrier = spatial.Body(
        "carrier", mass=masses[0], inertia=spatial.box(masses[0], 0.2, 0.1, 0.4), position=P["wheel"]
    )
    wheel = spatial.Body("wheel", mass=masses[1], inertia=wheel_inertia(masses[1]), position=P["wheel"])
    rods = [
        spatial.Distance(name, "ground", "carrier", point_a=P[f"{name}_inner"], point_b=P[f"{name}_outer"] - P["wheel"])
        for name in _LINKS
    ]
    hub = spatial.Revolute("hub", "carrier", "wheel", point=P["wheel"], axis=(0.0, 1.0, 0.0))
    forces = [
        spring(carrier, P, stiffness, damping),
        tyre_of("wheel", tyre, P["wheel"][2]),
        Gravity((0.0, 0.0, -gravity)),
    ]
    return build(
        "five_link",
        Scene([carrier, wheel], joints=[*rods, hub], forces=forces),
        t1=0.2,
        observe=observer("carrier", P["wheel"]),
        description="Five-link suspension of a wheel, jouncing on its tyre.",
        references=References.load("five_link"),
        rates={"carrier.z": speed},
    )
