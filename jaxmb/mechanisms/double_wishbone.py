"""A double wishbone suspension."""

from collections.abc import Mapping
from typing import Any, Literal

import equinox as eqx
import numpy as np

from .. import spatial
from .._types import VectorLike
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from ..states.assembly import assemble
from ._suspension import observer, placed, spring, tyre as tyre_of, wheel_inertia
from .mechanism import Mechanism, References, build, mechanism

_POINTS = {
    "lower_front": (0.14, 0.36, 0.24),
    "lower_rear": (-0.22, 0.36, 0.25),
    "lower_ball": (0.0, 0.74, 0.21),
    "upper_front": (0.11, 0.43, 0.51),
    "upper_rear": (-0.15, 0.43, 0.5),
    "upper_ball": (-0.02, 0.69, 0.53),
    "rack": (-0.12, 0.38, 0.29),
    "steering_arm": (-0.13, 0.7, 0.27),
    "wheel": (0.0, 0.78, 0.32),
    "spring_top": (0.0, 0.45, 0.62),
    "spring_bottom": (0.0, 0.6, 0.235),
}
_ARMS = ("lower", "upper")


@mechanism()
def double_wishbone(
    *,
    points: Mapping[str, VectorLike] | None = None,
    masses: tuple[float, float, float] = (4.0, 3.0, 30.0),
    stiffness: float = 4e4,
    damping: float = 1.5e3,
    tyre: float = 2e5,
    speed: float = 2.0,
    gravity: float = 9.81,
    joints: Literal["ideal", "bushings"] = "ideal",
    bushing: tuple[float, float] | None = None,
    bushing_damping: tuple[float, float] | None = None,
) -> Mechanism:
    """The left wheel of a car at rest, on a lower and an upper arm, a tie rod and a spring, jounces on its tyre; x
    forward, y to the left, z up.

    Ball joints connect the upright and its wheel with both arms; hinges, or bushings at their ends, connect the arms
    with the car; the massless tie rod ends at a fixed rack, whose place is the parameter `tie_rod.point_a`. With hinges
    there is one degree of freedom, with bushings there are eleven. Spring, tyre and bushings are free of force at the
    start.

    Source: data of this package. The reference values, for hinges, come from a model in the lower arm's angle.

    **Arguments:** `points`: positions [m] by name that replace defaults: `lower_front`, `lower_rear`, `lower_ball`,
    `upper_front`, `upper_rear`, `upper_ball`, `rack`, `steering_arm`, `wheel`, `spring_top`, `spring_bottom`, the
    latter on the lower arm; `masses` [kg] of lower arm, upper arm, and upright with wheel; `stiffness` [N/m] and
    `damping` [N s/m] of the spring; `tyre` [N/m], vertical stiffness; `speed` [m/s] of the wheel's centre at the start,
    upward; `gravity` [m/s²]; `joints` of arms and car; `bushing` [N/m, N m/rad], against shifts and turns in all
    directions, default 5·10⁶ and 20, and `bushing_damping` [N s/m, N m s/rad], default 2·10³ and 0.1.

    **Labels:** `z`, `y` [m], travel of the wheel's centre, up and outward; `camber` [rad], top outward; `toe` [rad],
    front inward; `rate` [m/s], ż.
    """
    if joints not in ("ideal", "bushings"):
        raise ValueError(f"The joints are ideal, bushings; got {joints!r}.")
    if joints == "ideal" and not (bushing is None and bushing_damping is None):
        raise ValueError(
            "Ideal joints have no bushings: leave out bushing and bushing_damping, or give joints='bushings'."
        )
    P = placed(_POINTS, points)
    bodies = [
        _arm("lower", masses[0], P),
        _arm("upper", masses[1], P),
        spatial.Body("upright", mass=masses[2], inertia=wheel_inertia(masses[2]), position=P["wheel"]),
    ]
    balls: list[Any] = [spatial.Spherical(f"{arm}_ball", arm, "upright", point=P[f"{arm}_ball"]) for arm in _ARMS]
    outer = P["steering_arm"] - P["wheel"]
    links = [*balls, spatial.Distance("tie_rod", "ground", "upright", point_a=P["rack"], point_b=outer)]
    hinges = [_hinge(arm, P) for arm in _ARMS]
    forces = [
        spring(bodies[0], P, stiffness, damping),
        tyre_of("upright", tyre, P["wheel"][2]),
        Gravity((0.0, 0.0, -gravity)),
    ]
    rates = {"upright.z": speed}
    if joints == "bushings":
        rigid = Scene(bodies, joints=[*hinges, *links]).compile()
        moving = np.asarray(assemble(rigid, rates=rates).u).reshape(len(bodies), 6)
        where = lambda body: (body.velocity, body.angular_velocity)
        bodies = [eqx.tree_at(where, body, (u[:3], u[3:])) for body, u in zip(bodies, moving, strict=True)]
        of = lambda pair: np.repeat(np.asarray(pair, float), 3)
        stiff, damped = of(bushing or (5e6, 20.0)), of(bushing_damping or (2e3, 0.1))
        forces += [
            spatial.Bushing(f"{arm}_{end}", "ground", arm, point=P[f"{arm}_{end}"], stiffness=stiff, damping=damped)
            for arm in _ARMS
            for end in ("front", "rear")
        ]
    return build(
        "double_wishbone",
        Scene(bodies, joints=[*hinges, *links] if joints == "ideal" else links, forces=forces),
        t1=0.2,
        observe=observer("upright", P["wheel"]),
        description="Double wishbone suspension of a wheel, on hinges or bushings, jouncing on its tyre.",
        references=References.load("double_wishbone"),
        rates=rates,
    )


def _arm(name, mass, P):
    """A triangular plate, with the inertia of a square plate."""
    place = (P[f"{name}_front"] + P[f"{name}_rear"] + P[f"{name}_ball"]) / 3
    return spatial.Body(name, mass=mass, inertia=spatial.box(mass, 0.3, 0.3, 0.03), position=place)


def _hinge(arm, P):
    front, rear = P[f"{arm}_front"], P[f"{arm}_rear"]
    along = front - rear
    return spatial.Revolute(f"{arm}_hinge", "ground", arm, point=front, axis=along / np.linalg.norm(along))
