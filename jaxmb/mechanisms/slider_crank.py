"""The planar slider-crank."""

import numpy as np

from .. import planar
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism


@mechanism()
def slider_crank(
    *,
    crank: float = 0.153,
    rod: float = 0.306,
    masses: tuple[float, float, float] = (0.038, 0.038, 0.076),
    inertias: tuple[float, float, float] = (7.4e-5, 5.9e-4, 2.7e-6),
    angle: float = 0.0,
    speed: float = 150.0,
    gravity: float = 9.81,
) -> Mechanism:
    """Crank, connecting rod and slider on the x axis, all mass centres in the middle, spun up and left alone; y up.

    Source: the data of P. Flores, R. Leine and C. Glocker, "Modeling and analysis of planar rigid multibody systems
    with translational clearance joints based on the non-smooth dynamics approach", Multibody Syst. Dyn. 23, 2010,
    without clearance. The reference values come from an independent model with one coordinate.

    **Arguments:** lengths of `crank` and `rod` [m]; `masses` [kg] and `inertias` [kg m²], about the mass centres, of
    crank, rod and slider, shape (3,); `angle` [rad] of the crank from the x axis and its `speed` [rad/s] at the start;
    `gravity` [m/s²].

    **Labels:** `crank`, `rod` [rad], angles of crank and rod from the x axis; `x` [m] of the slider; `crank_rate`,
    `rod_rate` [rad/s]; `x_dot` [m/s].
    """
    B = crank * np.array([np.cos(angle), np.sin(angle)])
    C = np.array([B[0] + np.sqrt(max(rod**2 - B[1] ** 2, 0.0)), 0.0])
    bodies = [
        planar.Body("crank", mass=masses[0], inertia=inertias[0], position=B / 2, angle=angle),
        planar.Body(
            "rod", mass=masses[1], inertia=inertias[1], position=(B + C) / 2, angle=np.arctan2(C[1] - B[1], C[0] - B[0])
        ),
        planar.Body("slider", mass=masses[2], inertia=inertias[2], position=C),
    ]
    joints = [
        planar.Revolute("A", "ground", "crank", point_a=(0.0, 0.0), point_b=(-crank / 2, 0.0)),
        planar.Revolute("B", "crank", "rod", point_a=(crank / 2, 0.0), point_b=(-rod / 2, 0.0)),
        planar.Revolute("C", "rod", "slider", point_a=(rod / 2, 0.0), point_b=(0.0, 0.0)),
        planar.Prismatic(
            "slide", "ground", "slider", point_a=(0.0, 0.0), point_b=(0.0, 0.0), axis_a=(1.0, 0.0), angle=0.0
        ),
    ]
    return build(
        "slider_crank",
        Scene(bodies, joints=joints, forces=[Gravity((0.0, -gravity))]),
        t1=0.2,
        observe=_observe,
        description="Planar slider-crank, spun up to 150 rad/s and left alone.",
        references=References.load("slider_crank"),
        fix={"crank.angle": angle},
        rates={"crank.angle": speed},
    )


def _observe(trajectory):
    crank, rod, slider = (trajectory[name] for name in ("crank", "rod", "slider"))
    return {
        "crank": crank.angle,
        "rod": rod.angle,
        "x": slider.position[:, 0],
        "crank_rate": crank.angular_velocity,
        "rod_rate": rod.angular_velocity,
        "x_dot": slider.velocity[:, 0],
    }
