"""A planar four-bar linkage built of spatial hinges."""

import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..linalg import rotations
from ..parts.forces import Gravity
from .four_bar import circles_meet
from .mechanism import Mechanism, build, mechanism
from .observe import columns, point_motion


@mechanism()
def spatial_loop(
    *,
    lengths: tuple[float, float, float] = (1.0, 3.0, 2.5),
    base: float = 2.5,
    masses: tuple[float, float, float] = (1.0, 3.0, 2.5),
    section: float = 0.1,
    angle: float = np.pi / 2,
    speed: float = 4.0,
    gravity: float = 9.81,
) -> Mechanism:
    """The linkage of `four_bar` in space, with four parallel hinges and a base that is a body welded to the ground.

    Spatial hinges hold the bars in their plane redundantly: of the 30 rows (26 of joints, 4 of Euler parameters) on 28
    coordinates, three follow from the others, which leaves one degree of freedom.

    Source: E. J. Haug, "Computer Aided Kinematics and Dynamics of Mechanical Systems", 1989, example 10.1.1 (the
    count).

    **Arguments:** as in `four_bar`; `section` [m], edge of the bars' square cross-section. y up, hinges along z.

    **Labels:** `x_B`, `y_B`, `x_C`, `y_C` [m], positions of the hinges B and C.
    """
    crank, coupler, rocker = lengths
    A, D = np.zeros(3), np.array([base, 0.0, 0.0])
    B = crank * np.array([np.cos(angle), np.sin(angle), 0.0])
    C = np.append(circles_meet(B[:2], D[:2], coupler, rocker), 0.0)
    z = (0.0, 0.0, 1.0)

    def bar(name, mass, length, start, end):
        turn = np.arctan2(end[1] - start[1], end[0] - start[0])
        return spatial.Body(
            name,
            mass=mass,
            inertia=spatial.box(mass, length, section, section),
            position=(start + end) / 2,
            orientation=rotations.from_axis_angle(z, turn),
        )

    bodies = [
        bar("base", 1.0, base, A, D),
        bar("crank", masses[0], crank, A, B),
        bar("coupler", masses[1], coupler, B, C),
        bar("rocker", masses[2], rocker, D, C),
    ]
    joints = [
        spatial.Fixed("weld", "ground", "base", point=A),
        spatial.Revolute("A", "base", "crank", point=A, axis=z),
        spatial.Revolute("B", "crank", "coupler", point=B, axis=z),
        spatial.Revolute("C", "coupler", "rocker", point=C, axis=z),
        spatial.Revolute("D", "base", "rocker", point=D, axis=z),
    ]
    return build(
        "spatial_loop",
        Scene(bodies, joints=joints, forces=[Gravity((0.0, -gravity, 0.0))]),
        t1=10.0,
        observe=lambda trajectory: _observe(trajectory, crank, rocker),
        description="Planar four-bar linkage of spatial hinges, with three redundant rows.",
        rates={"crank.wz": speed},
    )


def _observe(trajectory, crank, rocker):
    B, _ = point_motion(trajectory, "crank", (crank / 2, 0.0, 0.0))
    C, _ = point_motion(trajectory, "rocker", (rocker / 2, 0.0, 0.0))
    return columns(("x_B", "y_B"), B) | columns(("x_C", "y_C"), C)
