"""The planar four-bar linkage with a stiff bushing in place of a pivot."""

import numpy as np

from .. import planar
from .four_bar import four_bar
from .mechanism import Mechanism, References, build, mechanism
from .observe import bar_angles, point_motion


@mechanism()
def stiff_four_bar(
    *,
    stiffness: float = 1e8,
    damping: float = 1e2,
    lengths: tuple[float, float, float] = (1.0, 3.0, 2.5),
    base: float = 2.5,
    masses: tuple[float, float, float] = (1.0, 3.0, 2.5),
    angle: float = np.pi / 2,
    speed: float = 4.0,
    gravity: float = 9.81,
) -> Mechanism:
    """The linkage of `four_bar` with the rocker's ground pivot D replaced by a bushing: three degrees of freedom.

    It starts in the state of the rigid linkage, so the bushing bears no force at first and oscillates about the force
    of the rigid pivot. With the default values the displacement stays below 10⁻⁶ m; the frequencies at the start are
    5.2·10³ and 1.13·10⁴ rad/s, with decay rates of 15 and 64 / s. As the stiffness grows the motion tends to the motion
    of `four_bar`. The reference values come from an independent model, an open chain of three bars.

    **Arguments:** `stiffness` [N/m] and `damping` [N s/m] of the bushing, the same in all directions of the plane, none
    in rotation; the others as in `four_bar`.

    **Labels:** as in `four_bar`, and `pivot_x`, `pivot_y` [m], displacement of the rocker's end from D, without
    reference values.
    """
    rigid = four_bar(lengths=lengths, base=base, masses=masses, angle=angle, speed=speed, gravity=gravity)
    foot = (-lengths[2] / 2, 0.0)
    bushing = planar.Bushing(
        "D",
        "ground",
        "rocker",
        stiffness=(stiffness, stiffness, 0.0),
        damping=(damping, damping, 0.0),
        point_a=(base, 0.0),
        point_b=foot,
    )
    coordinates, rates = rigid.system.coordinate_names(), rigid.system.rate_names()
    angles = [f"{name}.angle" for name in ("crank", "coupler", "rocker")]
    return build(
        "stiff_four_bar",
        rigid.scene.extended(forces=[bushing], without=["D"]),
        t1=1.0,
        observe=lambda trajectory: _observe(trajectory, foot, base),
        description="Planar four-bar linkage with a stiff, lightly damped bushing for a ground pivot, under gravity.",
        references=References.load("stiff_four_bar"),
        fix={name: float(rigid.state.q[coordinates[name][0]]) for name in angles},
        rates={name: float(rigid.state.u[rates[f"{name}_rate"][0]]) for name in angles},
    )


def _observe(trajectory, foot, base):
    end, _ = point_motion(trajectory, "rocker", foot)
    pivot = {"pivot_x": end[:, 0] - base, "pivot_y": end[:, 1]}
    return bar_angles(trajectory, "crank", "coupler", "rocker") | pivot
