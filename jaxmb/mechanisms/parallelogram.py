"""A parallelogram with redundant rockers."""

import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, build, mechanism
from .observe import columns


@mechanism()
def parallelogram(
    *,
    rockers: int = 3,
    offset: float = 0.0,
    rocker: float = 1.0,
    spacing: float = 1.0,
    masses: tuple[float, float] = (1.0, 2.0),
    angle: float = -np.pi / 3,
    speed: float = 1.0,
    gravity: float = 9.81,
) -> Mechanism:
    """Parallel rockers of equal length that carry a coupler: every rocker after the second is redundant; y up.

    It can move only because the rockers are exactly equal. With an `offset` of the last rocker's ground pin, three
    rockers lock.

    **Arguments:** `rockers` ≥ 2; `offset` [m] of the last ground pin along x; length of a `rocker` and `spacing` of the
    pins [m]; `masses` [kg] of one rocker and of the coupler, uniform rods, shape (2,); `angle` [rad] of the rockers
    from the x axis and their `speed` [rad/s] at the start; `gravity` [m/s²].

    **Labels:** `angle` [rad], `rate` [rad/s] of the first rocker; `x`, `y` [m] of the coupler's centre.
    """
    if rockers < 2:
        raise ValueError(f"parallelogram needs at least 2 rockers, got {rockers}.")
    along = rocker * np.array([np.cos(angle), np.sin(angle)])
    width = spacing * (rockers - 1)
    bodies = [
        planar.Body(
            "coupler", mass=masses[1], inertia=planar.rod(masses[1], width), position=along + np.array([width / 2, 0.0])
        )
    ]
    joints = []
    for k in range(rockers):
        name, x = f"rocker{k + 1}", spacing * k
        foot = np.array([x + (offset if k == rockers - 1 else 0.0), 0.0])
        bodies.append(
            planar.Body(
                name,
                mass=masses[0],
                inertia=planar.rod(masses[0], rocker),
                position=np.array([x, 0.0]) + along / 2,
                angle=angle,
            )
        )
        joints += [
            planar.Revolute(f"foot{k + 1}", "ground", name, point_a=foot, point_b=(-rocker / 2, 0.0)),
            planar.Revolute(f"head{k + 1}", name, "coupler", point_a=(rocker / 2, 0.0), point_b=(x - width / 2, 0.0)),
        ]
    return build(
        "parallelogram",
        Scene(bodies, joints=joints, forces=[Gravity((0.0, -gravity))]),
        t1=2.0,
        observe=_observe,
        description="Parallel rockers under a coupler, redundant beyond the second.",
        fix={"rocker1.angle": angle},
        rates={"rocker1.angle": speed},
    )


def _observe(trajectory):
    first, coupler = trajectory["rocker1"], trajectory["coupler"]
    return {"angle": first.angle, "rate": first.angular_velocity} | columns("xy", coupler.position)
