"""The rectangular Bricard linkage."""

import numpy as np

from .. import spatial
from ..bodies.scene import Scene
from ..parts.forces import Gravity
from .mechanism import Mechanism, References, build, mechanism
from .observe import columns, point_motion

_AXES = ("y", "z", "x", "y", "z", "x")


@mechanism()
def bricard(*, length: float = 1.0, mass: float = 1.0, section: float = 0.1, gravity: float = 9.81) -> Mechanism:
    """Six hinges P0 … P5 and five equal bars along the edges of a cube, a closed loop with one degree of freedom
    although the count of rows leaves none; y up, released from rest.

    Source: problem A04 of the IFToMM Library of Computational Benchmark Problems for multibody dynamics. The reference
    values were computed in two joint angles with the loop closed in closed form, in extended precision, and in all five
    joint angles.

    **Arguments:** `length` [m] and `mass` [kg] of a bar, `section` [m], edge of its square cross-section; `gravity`
    [m/s²].

    **Labels:** `x`, `y`, `z` [m] and `vx`, `vy`, `vz` [m/s] of the watched point, the hinge P2 between bars 2 and 3.
    """
    P = length * np.array([(0, 0, 0), (1, 0, 0), (1, -1, 0), (1, -1, 1), (0, -1, 1), (0, 0, 1)], dtype=float)
    bodies = []
    for k in range(1, 6):
        edges = np.full(3, section)
        edges[np.argmax(np.abs(P[k] - P[k - 1]))] = length
        inertia = spatial.box(mass, *edges)
        bodies.append(spatial.Body(f"bar{k}", mass=mass, inertia=inertia, position=(P[k] + P[k - 1]) / 2))
    chain = ["ground", *(f"bar{k}" for k in range(1, 6)), "ground"]
    joints = [
        spatial.Revolute(f"P{k}", chain[k], chain[k + 1], point=P[k], axis=np.eye(3)["xyz".index(_AXES[k])])
        for k in range(6)
    ]
    return build(
        "bricard",
        Scene(bodies, joints=joints, forces=[Gravity((0.0, -gravity, 0.0))]),
        t1=10.0,
        observe=lambda trajectory: _observe(trajectory, length),
        description="Rectangular Bricard linkage, an over-constrained spatial loop (IFToMM benchmark A04).",
        references=References.load("bricard"),
    )


def _observe(trajectory, length):
    point, speed = point_motion(trajectory, "bar2", (0.0, -0.5 * length, 0.0))
    return columns("xyz", point) | columns(("vx", "vy", "vz"), speed)
