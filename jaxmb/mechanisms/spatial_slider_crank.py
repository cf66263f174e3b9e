"""The spatial slider-crank."""

import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import turn_about_x


@mechanism()
def spatial_slider_crank(
    *,
    crank: float = 0.08,
    rod: float = 0.3,
    centre: tuple[float, float] = (0.1, 0.12),
    masses: tuple[float, float, float] = (0.12, 0.5, 2.0),
    speed: float = 6.0,
    gravity: float = 9.81,
) -> Mechanism:
    """A crank that turns about an axis parallel to x, a rod with a ball joint B at the crank and a Cardan joint C at a
    slider on the x axis; z up.

    The crank's centre is A = (0, y, z); at the start B is above A and the rod points towards +x. One axis of the Cardan
    joint is the slide, the other is across it and the rod.

    Source: E. J. Haug, "Computer Aided Kinematics and Dynamics of Mechanical Systems", 1989, §10.2, with the masses of
    the test `sliderCrank3Dbenchmark` of EXUDYN. The reference values come from a model with one coordinate, checked by
    a model with four coordinates and three multipliers, in extended precision.

    **Arguments:** lengths of `crank` and `rod` [m]; `centre` [m], y and z of A, shape (2,); `masses` [kg] of crank, rod
    and slider, shape (3,); `speed` [rad/s] of the crank at the start; `gravity` [m/s²].

    **Labels:** `x` [m] and `x_dot` [m/s] of the slider; `cos`, `sin` of the crank's angle θ about x, zero at the start;
    `theta_dot` [rad/s].
    """
    A = np.array([0.0, *centre])
    B = A + np.array([0.0, 0.0, crank])
    C = np.array([np.sqrt(max(rod**2 - B @ B, 0.0)), 0.0, 0.0])
    x = np.array([1.0, 0.0, 0.0])
    along = (C - B) / np.linalg.norm(C - B)
    across = np.cross(along, x)
    across /= np.linalg.norm(across)
    third = np.cross(along, across)
    frame = np.stack([along, across, third], axis=1)
    bodies = [
        spatial.Body("crank", mass=masses[0], inertia=(1e-4, 1e-4, 1e-4), position=(A + B) / 2),
        spatial.Body(
            "rod",
            mass=masses[1],
            inertia=frame @ np.diag([4e-4, 4e-3, 4e-3]) @ frame.T,
            position=(B + C) / 2,
        ),
        spatial.Body("slider", mass=masses[2], inertia=(1e-4, 1e-4, 1e-4), position=C),
    ]
    joints = [
        spatial.Revolute("A", "ground", "crank", point=A, axis=x),
        spatial.Spherical("B", "crank", "rod", point=B),
        spatial.Universal("C", "rod", "slider", point=C, axis_a_W=across, axis_b_W=x),
        spatial.Prismatic("slide", "ground", "slider", point=C, axis=x),
    ]
    return build(
        "spatial_slider_crank",
        Scene(bodies, joints=joints, forces=[Gravity((0.0, 0.0, -gravity))]),
        t1=5.0,
        observe=_observe,
        description="Spatial slider-crank with a ball joint and a Cardan joint, under gravity.",
        references=References.load("spatial_slider_crank"),
        rates={"crank.wx": speed},
    )


def _observe(trajectory):
    slider = trajectory["slider"]
    observed = {"x": slider.position[:, 0], "x_dot": slider.velocity[:, 0]} | turn_about_x(trajectory, "crank")
    return observed | {"theta_dot": trajectory["crank"].angular_velocity[:, 0]}
