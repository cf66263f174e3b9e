"""The planar four-bar linkage."""

import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import bar_angles


@mechanism()
def four_bar(
    *,
    lengths: tuple[float, float, float] = (1.0, 3.0, 2.5),
    base: float = 2.5,
    masses: tuple[float, float, float] = (1.0, 3.0, 2.5),
    angle: float = np.pi / 2,
    speed: float = 4.0,
    gravity: float = 9.81,
) -> Mechanism:
    """Crank, coupler and rocker, uniform slender bars, between ground pivots A = (0, 0) and D = (base, 0); y up.

    B joins crank and coupler, C coupler and rocker; C starts above the line from B to D. The reference values come from
    an independent model with one coordinate.

    **Arguments:** `lengths` [m] and `masses` [kg] of crank, coupler and rocker, shape (3,); `base` [m]; `angle` [rad]
    of the crank from the x axis and its `speed` [rad/s] at the start; `gravity` [m/s²].

    **Labels:** `crank`, `coupler`, `rocker` [rad], angles of the bars A→B, B→C, D→C from the x axis; `crank_rate`,
    `coupler_rate`, `rocker_rate` [rad/s].
    """
    crank, coupler, rocker = lengths
    A, D = np.zeros(2), np.array([base, 0.0])
    B = A + crank * np.array([np.cos(angle), np.sin(angle)])
    C = circles_meet(B, D, coupler, rocker)
    bar = lambda name, m, l, start, end: planar.Body(
        name,
        mass=m,
        inertia=planar.rod(m, l),
        position=(start + end) / 2,
        angle=np.arctan2(end[1] - start[1], end[0] - start[0]),
    )
    ends = [(A, B), (B, C), (D, C)]
    names = ("crank", "coupler", "rocker")
    bodies = [bar(*item, *pair) for *item, pair in zip(names, masses, lengths, ends, strict=True)]
    joints = [
        planar.Revolute("A", "ground", "crank", point_a=A, point_b=(-crank / 2, 0.0)),
        planar.Revolute("B", "crank", "coupler", point_a=(crank / 2, 0.0), point_b=(-coupler / 2, 0.0)),
        planar.Revolute("C", "coupler", "rocker", point_a=(coupler / 2, 0.0), point_b=(rocker / 2, 0.0)),
        planar.Revolute("D", "ground", "rocker", point_a=D, point_b=(-rocker / 2, 0.0)),
    ]
    return build(
        "four_bar",
        Scene(bodies, joints=joints, forces=[Gravity((0.0, -gravity))]),
        t1=10.0,
        observe=lambda trajectory: bar_angles(trajectory, "crank", "coupler", "rocker"),
        description="Planar four-bar linkage of uniform bars under gravity, crank started at 4 rad/s.",
        references=References.load("four_bar"),
        fix={"crank.angle": angle},
        rates={"crank.angle": speed},
    )


def circles_meet(B, D, coupler, rocker):
    """The intersection of circles about B and D to the left of the line from B to D, or the point nearest to both."""
    d = D - B
    distance = np.hypot(*d)
    along = (coupler**2 - rocker**2 + distance**2) / (2 * distance)
    across = np.sqrt(max(coupler**2 - along**2, 0.0))
    e = d / distance
    return B + along * e + across * np.array([-e[1], e[0]])
